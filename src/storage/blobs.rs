//! Files named by the BLAKE3 hash of their bytes: `blobs/ab/cd/abcd…`.
//!
//! A blob is written to a temporary file beside its final place, synced, renamed, and the folders are synced: once
//! [`BlobWriter::finish`] returns, the bytes survive a power cut. Readers check the hash. A blob whose row is not yet
//! committed is pinned (see `pins`); which blobs are garbage is the rows' business (see `garbage`).

use std::fmt;
use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio::io::{AsyncReadExt, AsyncWriteExt};
use ulid::Ulid;

use super::StorageError;
use super::pins::{FreshBlob, Pin, Pins};

/// The name of a blob: the hash of its bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct BlobId(pub blake3::Hash);

impl BlobId {
    /// Reads a name from the database.
    pub fn parse(hex: &str) -> Result<Self, StorageError> {
        blake3::Hash::from_hex(hex)
            .map(Self)
            .map_err(|_| StorageError::BadRow { column: "blob", value: hex.chars().take(80).collect() })
    }
}

impl fmt::Display for BlobId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.0.to_hex().as_str())
    }
}

/// A blob that is safe on disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StoredBlob {
    /// Its name.
    pub id: BlobId,
    /// Its size.
    pub bytes: u64,
}

/// The folder of all blobs. Clones share it.
#[derive(Debug, Clone)]
pub struct BlobStore {
    root: Arc<Path>,
    pins: Arc<Pins>,
}

impl BlobStore {
    /// Opens the folder `root`, makes it if needed, and throws away what interrupted writes left behind.
    pub fn open(root: &Path) -> Result<Self, StorageError> {
        let partial = root.join("partial");
        match fs::remove_dir_all(&partial) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => {
                return Err(StorageError::io("clearing partial blobs")(e));
            }
            _ => {}
        }
        fs::create_dir_all(&partial).map_err(StorageError::io("making the folder of blobs"))?;
        Ok(Self { root: root.into(), pins: Arc::default() })
    }

    /// Where a blob is or would be.
    #[must_use]
    pub fn path(&self, id: BlobId) -> PathBuf {
        let hex = id.0.to_hex();
        let (a, rest) = hex.split_at(2);
        self.root.join(a).join(&rest[..2]).join(hex.as_str())
    }

    /// Whether the blob's file is there.
    #[must_use]
    pub fn contains(&self, id: BlobId) -> bool {
        self.path(id).is_file()
    }

    /// Begins a blob that arrives in pieces, on the async side.
    pub async fn writer(&self) -> Result<BlobWriter, StorageError> {
        let path = self.temporary();
        let file = tokio::fs::File::create_new(&path).await.map_err(StorageError::io("beginning a blob"))?;
        let partial = Partial { path, kept: false };
        Ok(BlobWriter { store: self.clone(), file, partial, hasher: blake3::Hasher::new(), bytes: 0 })
    }

    /// Stores bytes that are in memory. Blocks.
    pub fn put(&self, bytes: &[u8]) -> Result<FreshBlob, StorageError> {
        self.put_with(|file| io::Write::write_all(file, bytes).map_err(StorageError::io("writing a blob")))
    }

    /// Stores what `write` writes to the file that it is given. Blocks.
    pub fn put_with<E: From<StorageError>>(
        &self,
        write: impl FnOnce(&mut File) -> Result<(), E>,
    ) -> Result<FreshBlob, E> {
        let path = self.temporary();
        let mut file = File::create_new(&path).map_err(StorageError::io("beginning a blob"))?;
        let partial = Partial { path, kept: false };
        write(&mut file)?;
        file.sync_all().map_err(StorageError::io("syncing a blob"))?;
        drop(file);
        // What was written is hashed from the file: a writer may seek back to fill in a header.
        let mut hasher = blake3::Hasher::new();
        let written = File::open(&partial.path).map_err(StorageError::io("reading a blob back"))?;
        let bytes = io::copy(&mut io::BufReader::with_capacity(1 << 16, written), &mut hasher)
            .map_err(StorageError::io("reading a blob back"))?;
        let id = BlobId(hasher.finalize());
        let pin = self.settle(partial, id)?;
        Ok(FreshBlob::new(StoredBlob { id, bytes }, pin))
    }

    /// Makes a synced file of this file system a blob; the file moves. `stored` is what it holds. Blocks.
    pub(super) fn adopt(&self, file: &Path, stored: StoredBlob) -> Result<FreshBlob, StorageError> {
        Ok(FreshBlob::new(stored, self.place(file, stored.id)?))
    }

    /// Keeps a blob that is there from being collected.
    pub(super) fn hold(&self, stored: StoredBlob) -> FreshBlob {
        FreshBlob::new(stored, Pin::new(&self.pins, stored.id))
    }

    /// Reads a whole blob into memory and checks it. Blocks.
    pub fn get(&self, id: BlobId) -> Result<Vec<u8>, StorageError> {
        let mut bytes = Vec::new();
        let mut reader = self.reader(id)?;
        reader.read_to_end(&mut bytes).map_err(StorageError::io("reading a blob"))?;
        reader.verify()?;
        Ok(bytes)
    }

    /// Opens a blob for reading from its beginning; [`BlobReader::verify`] at the end tells whether it is sound.
    pub fn reader(&self, id: BlobId) -> Result<BlobReader, StorageError> {
        match File::open(self.path(id)) {
            Ok(file) => Ok(BlobReader { id, file, hasher: blake3::Hasher::new() }),
            Err(e) if e.kind() == io::ErrorKind::NotFound => Err(StorageError::MissingBlob(id.to_string())),
            Err(e) => Err(StorageError::io("opening a blob")(e)),
        }
    }

    /// The first bytes of a blob, at most `limit`. They are not checked.
    pub async fn head(&self, id: BlobId, limit: usize) -> Result<Vec<u8>, StorageError> {
        let mut head = Vec::new();
        let file = tokio::fs::File::open(self.path(id)).await.map_err(StorageError::io("opening a blob"))?;
        file.take(limit as u64).read_to_end(&mut head).await.map_err(StorageError::io("reading a blob"))?;
        Ok(head)
    }

    fn temporary(&self) -> PathBuf {
        self.root.join("partial").join(Ulid::generate().to_string())
    }

    /// Deletes the files of those blobs that nobody has pinned; returns which. Blocks.
    pub(super) fn remove_unpinned(&self, ids: &[BlobId]) -> Result<Vec<BlobId>, StorageError> {
        let mut removed = Vec::with_capacity(ids.len());
        for id in ids {
            let pins = self.pins.lock();
            if pins.holds(*id) {
                continue;
            }
            match fs::remove_file(self.path(*id)) {
                Err(e) if e.kind() != io::ErrorKind::NotFound => {
                    return Err(StorageError::io("deleting a blob")(e));
                }
                _ => removed.push(*id),
            }
        }
        Ok(removed)
    }

    /// Blobs whose pins went since the last call.
    pub(super) fn take_released(&self) -> Vec<BlobId> {
        self.pins.take_released()
    }

    fn settle(&self, mut partial: Partial, id: BlobId) -> Result<Pin, StorageError> {
        let pin = self.place(&partial.path, id)?;
        partial.kept = true;
        Ok(pin)
    }

    /// Pins the blob, moves a synced file to its place and syncs the folders on the way. An equal blob that is there
    /// already is replaced, which repairs it if it was damaged.
    fn place(&self, from: &Path, id: BlobId) -> Result<Pin, StorageError> {
        let pin = Pin::new(&self.pins, id);
        let place = self.path(id);
        let folders: Vec<&Path> = place.ancestors().skip(1).take(3).collect();
        if let Some(inner) = folders.first() {
            fs::create_dir_all(inner).map_err(StorageError::io("making a folder of blobs"))?;
        }
        fs::rename(from, &place).map_err(StorageError::io("naming a blob"))?;
        for folder in folders {
            File::open(folder)
                .and_then(|folder| folder.sync_all())
                .map_err(StorageError::io("syncing a folder of blobs"))?;
        }
        Ok(pin)
    }
}

/// A temporary file that disappears unless it is kept.
#[derive(Debug)]
struct Partial {
    path: PathBuf,
    kept: bool,
}

impl Drop for Partial {
    fn drop(&mut self) {
        if !self.kept {
            // Nobody can be told, and the next start clears the folder.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// A blob that is arriving. Dropping it forgets what has arrived.
#[derive(Debug)]
pub struct BlobWriter {
    store: BlobStore,
    file: tokio::fs::File,
    partial: Partial,
    hasher: blake3::Hasher,
    bytes: u64,
}

impl BlobWriter {
    /// Appends a piece.
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), StorageError> {
        self.hasher.update(piece);
        self.bytes += piece.len() as u64;
        self.file.write_all(piece).await.map_err(StorageError::io("writing a blob"))
    }

    /// Bytes so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Makes the blob safe: file and folders are synced when this returns.
    pub async fn finish(mut self) -> Result<FreshBlob, StorageError> {
        self.file.flush().await.map_err(StorageError::io("writing a blob"))?;
        self.file.sync_all().await.map_err(StorageError::io("syncing a blob"))?;
        let stored = StoredBlob { id: BlobId(self.hasher.finalize()), bytes: self.bytes };
        let Self { store, partial, .. } = self;
        let pin = tokio::task::spawn_blocking(move || store.settle(partial, stored.id))
            .await
            .map_err(|e| StorageError::io("naming a blob")(io::Error::other(e)))??;
        Ok(FreshBlob::new(stored, pin))
    }
}

/// Reads a blob and hashes what it reads.
#[derive(Debug)]
pub struct BlobReader {
    id: BlobId,
    file: File,
    hasher: blake3::Hasher,
}

impl Read for BlobReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n = self.file.read(buffer)?;
        self.hasher.update(buffer.get(..n).unwrap_or_default());
        Ok(n)
    }
}

impl BlobReader {
    /// Reads what is left and compares the hash with the name.
    pub fn verify(mut self) -> Result<(), StorageError> {
        io::copy(&mut self.file, &mut self.hasher).map_err(StorageError::io("reading a blob"))?;
        let found = self.hasher.finalize();
        if found == self.id.0 {
            Ok(())
        } else {
            let found = found.to_hex().to_string();
            Err(StorageError::DamagedBlob { expected: self.id.to_string(), found })
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn bytes_that_arrive_in_pieces_are_found_under_their_hash() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let mut writer = store.writer().await.unwrap();
        writer.write(b"one ").await.unwrap();
        writer.write(b"two").await.unwrap();
        let stored = writer.finish().await.unwrap();
        assert_eq!(*stored, StoredBlob { id: BlobId(blake3::hash(b"one two")), bytes: 7 });
        assert_eq!(store.get(stored.id).unwrap(), b"one two");
        assert_eq!(*store.put(b"one two").unwrap(), *stored);
    }

    #[tokio::test]
    async fn an_abandoned_write_leaves_no_file() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let mut writer = store.writer().await.unwrap();
        writer.write(&vec![1; 100_000]).await.unwrap();
        drop(writer);
        assert_eq!(fs::read_dir(dir.path().join("partial")).unwrap().count(), 0);
    }

    #[test]
    fn a_damaged_blob_is_noticed_and_repaired_by_the_same_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let stored = store.put(b"precious").unwrap();
        fs::write(store.path(stored.id), b"precioux").unwrap();
        assert!(matches!(store.get(stored.id), Err(StorageError::DamagedBlob { .. })));
        store.put(b"precious").unwrap();
        assert_eq!(store.get(stored.id).unwrap(), b"precious");
    }

    #[test]
    fn a_pinned_blob_is_not_removed_and_a_released_one_is_reported() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let (first, second) = (store.put(b"needed").unwrap(), store.put(b"needed").unwrap());
        let id = first.id;
        drop(first);
        assert_eq!((store.remove_unpinned(&[id]).unwrap(), store.take_released()), (vec![], vec![]));
        drop(second);
        assert_eq!(store.take_released(), [id]);
        assert_eq!(store.remove_unpinned(&[id]).unwrap(), [id]);
        assert!(!store.contains(id));
        assert_eq!(store.remove_unpinned(&[id]).unwrap(), [id], "a file that is gone already is no error");
    }

    #[test]
    fn a_missing_blob_is_named() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let id = BlobId(blake3::hash(b"nothing"));
        let Err(StorageError::MissingBlob(name)) = store.get(id) else { panic!("it should be missing") };
        assert_eq!(name, id.to_string());
    }
}
