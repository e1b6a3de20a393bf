//! Reading blobs: every byte is hashed on the way, and what does not have its hash is noted (see `ledger`).

use std::fs::{self, File};
use std::io::{self, Read};
use std::sync::Arc;

use sqlx::Row;

use super::garbage::needed;
use super::ledger::{Ledger, Stamp};
use super::{BlobId, BlobStore, Finding, StorageError, Store};

/// Bytes that are read at once to be hashed.
const PIECE: usize = 1 << 20;

/// Reads a blob and hashes what it reads.
#[derive(Debug)]
pub struct BlobReader {
    id: BlobId,
    file: File,
    stamp: Stamp,
    hasher: blake3::Hasher,
    ledger: Arc<Ledger>,
}

impl Read for BlobReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.file.read(buffer);
        match &read {
            Ok(n) => {
                self.hasher.update(buffer.get(..*n).unwrap_or_default());
            }
            // A disk that cannot give the bytes back has lost them as well as one that changes them.
            Err(e) if e.kind() != io::ErrorKind::Interrupted => {
                self.ledger.damaged(self.id, Finding::Altered);
            }
            Err(_) => {}
        }
        read
    }
}

impl BlobReader {
    /// Reads what is left and compares the hash with the name.
    pub fn verify(mut self) -> Result<(), StorageError> {
        let mut piece = vec![0; PIECE];
        loop {
            match self.read(&mut piece) {
                Ok(0) => break,
                Ok(_) => {}
                Err(e) if e.kind() == io::ErrorKind::Interrupted => {}
                Err(e) => return Err(self.lost(&e)),
            }
        }
        let found = self.hasher.finalize();
        if found == self.id.0 {
            self.ledger.sound(self.id, self.stamp);
            return Ok(());
        }
        self.ledger.damaged(self.id, Finding::Altered);
        Err(StorageError::DamagedBlob { expected: self.id.to_string(), found: found.to_hex().to_string() })
    }
}

impl BlobReader {
    /// Bytes that the disk does not give back are lost as well as altered ones.
    fn lost(&self, error: &io::Error) -> StorageError {
        StorageError::DamagedBlob { expected: self.id.to_string(), found: format!("nothing: {error}") }
    }
}

impl BlobStore {
    /// Opens a blob for reading from its beginning; [`BlobReader::verify`] at the end tells whether it is sound.
    pub fn reader(&self, id: BlobId) -> Result<BlobReader, StorageError> {
        let (file, stamp) = self.open_file(id)?;
        Ok(BlobReader { id, file, stamp, hasher: blake3::Hasher::new(), ledger: Arc::clone(&self.ledger) })
    }

    /// Reads a whole blob into memory and checks it. Blocks.
    pub fn get(&self, id: BlobId) -> Result<Vec<u8>, StorageError> {
        let mut bytes = Vec::new();
        let mut reader = self.reader(id)?;
        reader.read_to_end(&mut bytes).map_err(|e| reader.lost(&e))?;
        reader.verify()?;
        Ok(bytes)
    }

    /// Checks that a blob is sound. A file that was found so lately, and did not change since, is not read again. Blocks.
    pub fn verify(&self, id: BlobId) -> Result<(), StorageError> {
        let (_, stamp) = self.open_file(id)?;
        if self.ledger.knows(id, stamp) { Ok(()) } else { self.reader(id)?.verify() }
    }

    /// Like [`Self::verify`], for those who wait: however many do, the file is read once, and few are read at a time.
    pub async fn check(&self, id: BlobId) -> Result<(), StorageError> {
        if self.is_known_sound(id) {
            return Ok(());
        }
        let blobs = self.clone();
        self.checks.found(id, move || blobs.verify(id)).await
    }

    /// Whether the blob's file was found or made sound lately, and did not change since.
    pub(super) fn is_known_sound(&self, id: BlobId) -> bool {
        fs::metadata(self.path(id)).is_ok_and(|metadata| self.ledger.knows(id, Stamp::of(&metadata)))
    }

    /// Notes that the bytes of a blob mean nothing to this program, although they have their hash.
    pub fn note_unreadable(&self, id: BlobId) {
        self.ledger.damaged(id, Finding::Altered);
    }

    fn open_file(&self, id: BlobId) -> Result<(File, Stamp), StorageError> {
        match File::open(self.path(id)).and_then(|file| Ok((Stamp::of(&file.metadata()?), file))) {
            Ok((stamp, file)) => Ok((file, stamp)),
            Err(e) if e.kind() == io::ErrorKind::NotFound => {
                self.ledger.damaged(id, Finding::Missing);
                Err(StorageError::MissingBlob(id.to_string()))
            }
            Err(e) => Err(StorageError::io("opening a blob")(e)),
        }
    }
}

impl Store {
    /// Whether a row needs this blob now. If none does, its file may go at any moment, and it is no damage if it has gone.
    pub async fn is_needed(&self, id: BlobId) -> Result<bool, StorageError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("SELECT {} AS needed", needed("?1"))))
            .bind(id.to_string())
            .fetch_one(&self.read)
            .await?;
        Ok(row.try_get("needed")?)
    }
}
