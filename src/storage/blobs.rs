//! Files named by the BLAKE3 hash of their bytes: `blobs/ab/cd/abcd…`.
//!
//! A blob is written to a temporary file beside its final place, synced, renamed, and the folders are synced: once
//! [`BlobWriter::finish`](super::BlobWriter::finish) returns, the bytes survive a power cut. Readers check the hash (see `blob_reader`). A blob whose row
//! is not yet committed is pinned (see `pins`); which blobs are garbage is the rows' business (see `garbage`).

use std::collections::HashSet;
use std::fmt;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio::io::AsyncReadExt;
use ulid::Ulid;

use super::StorageError;
use super::blob_writer::Partial;
use super::checks::Checks;
use super::ledger::{Ledger, Stamp};
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
    pub(super) ledger: Arc<Ledger>,
    pub(super) checks: Arc<Checks>,
    /// Folders whose names are known to be synced.
    folders: Arc<Mutex<HashSet<[u8; 2]>>>,
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
        Ok(Self::beside(root))
    }

    /// The folder `root` of a backup: nothing is made or thrown away.
    #[must_use]
    pub fn read_only(root: &Path) -> Self {
        Self::beside(root)
    }

    /// Opens the folder `root`, which another process may be writing to: nothing is thrown away.
    pub(super) fn beside(root: &Path) -> Self {
        Self {
            root: root.into(),
            pins: Arc::default(),
            ledger: Arc::default(),
            checks: Arc::default(),
            folders: Arc::default(),
        }
    }

    /// The folder.
    pub(super) fn root(&self) -> &Path {
        &self.root
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
        let partial = Partial::new(path);
        write(&mut file)?;
        file.sync_all().map_err(StorageError::io("syncing a blob"))?;
        drop(file);
        // What was written is hashed from the file: a writer may seek back to fill in a header.
        let mut hasher = blake3::Hasher::new();
        let written = File::open(partial.path()).map_err(StorageError::io("reading a blob back"))?;
        let bytes = io::copy(&mut io::BufReader::with_capacity(1 << 16, written), &mut hasher)
            .map_err(StorageError::io("reading a blob back"))?;
        let id = BlobId(hasher.finalize());
        let pin = self.settle(partial, id)?;
        Ok(FreshBlob::new(StoredBlob { id, bytes }, pin))
    }

    /// Makes a synced file of this file system a blob; the file moves. `stored` is what it holds. Blocks.
    pub(super) fn adopt(&self, file: &Path, stored: StoredBlob) -> Result<FreshBlob, StorageError> {
        let pin = self.place(stored.id, |place| fs::rename(file, place))?;
        Ok(FreshBlob::new(stored, pin))
    }

    /// Keeps a blob that is there from being collected.
    pub(super) fn hold(&self, stored: StoredBlob) -> FreshBlob {
        FreshBlob::new(stored, Pin::new(&self.pins, stored.id))
    }

    /// The first bytes of a blob, at most `limit`. They are not checked.
    pub async fn head(&self, id: BlobId, limit: usize) -> Result<Vec<u8>, StorageError> {
        let mut head = Vec::new();
        let file = tokio::fs::File::open(self.path(id)).await.map_err(StorageError::io("opening a blob"))?;
        file.take(limit as u64).read_to_end(&mut head).await.map_err(StorageError::io("reading a blob"))?;
        Ok(head)
    }

    pub(super) fn temporary(&self) -> PathBuf {
        self.root.join("partial").join(Ulid::generate().to_string())
    }

    /// Deletes the files of those blobs that nobody has pinned and that are not younger than `age`; returns which. What cannot be deleted is
    /// logged and stays. Blocks.
    pub(super) fn remove_unpinned(&self, ids: &[BlobId], age: Duration) -> Vec<BlobId> {
        let mut removed = Vec::with_capacity(ids.len());
        for id in ids {
            let pins = self.pins.lock();
            let path = self.path(*id);
            if pins.holds(*id) || is_younger(&path, age) {
                continue;
            }
            match fs::remove_file(path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => {
                    tracing::error!(blob = %id, %error, "a file that nothing needs any more cannot be deleted");
                }
                _ => {
                    self.ledger.forget(*id);
                    removed.push(*id);
                }
            }
        }
        removed
    }

    /// Blobs whose pins went since the last call.
    pub(super) fn take_released(&self) -> Vec<BlobId> {
        self.pins.take_released()
    }

    /// The folder of a blob. It is made if needed, and its name and that of the folder above it are synced.
    fn folder(&self, id: BlobId) -> Result<PathBuf, StorageError> {
        let place = self.path(id);
        let folders: Vec<&Path> = place.ancestors().skip(1).take(3).collect();
        let &[inner, middle, root] = folders.as_slice() else { return Ok(place) };
        let [first, second, ..] = *id.0.as_bytes();
        let known = |known: &HashSet<[u8; 2]>| known.contains(&[first, second]);
        if !known(&self.folders.lock().unwrap_or_else(PoisonError::into_inner)) {
            fs::create_dir_all(inner).map_err(StorageError::io("making a folder of blobs"))?;
            sync_folder(middle)?;
            sync_folder(root)?;
            // Only now may others rely on it.
            self.folders.lock().unwrap_or_else(PoisonError::into_inner).insert([first, second]);
        }
        Ok(inner.to_owned())
    }

    /// Gives a synced temporary file its place.
    pub(super) fn settle(&self, partial: Partial, id: BlobId) -> Result<Pin, StorageError> {
        self.place(id, |place| partial.keep_as(place))
    }

    /// Pins the blob, has a synced file moved to its place, and syncs its folder. An equal blob that is there already is replaced, which
    /// repairs it if it was damaged.
    fn place(&self, id: BlobId, moved: impl FnOnce(&Path) -> io::Result<()>) -> Result<Pin, StorageError> {
        let pin = Pin::new(&self.pins, id);
        let place = self.path(id);
        let inner = self.folder(id)?;
        moved(&place).map_err(StorageError::io("naming a blob"))?;
        sync_folder(&inner)?;
        let metadata = fs::metadata(&place).map_err(StorageError::io("naming a blob"))?;
        self.ledger.sound(id, Stamp::of(&metadata));
        Ok(pin)
    }
}

/// Whether a file was written within the last `age`; one that seems to come from the future was not.
fn is_younger(path: &Path, age: Duration) -> bool {
    let written = fs::metadata(path).and_then(|m| m.modified());
    age > Duration::ZERO && written.is_ok_and(|at| at.elapsed().is_ok_and(|old| old < age))
}

fn sync_folder(folder: &Path) -> Result<(), StorageError> {
    File::open(folder)
        .and_then(|folder| folder.sync_all())
        .map_err(StorageError::io("syncing a folder of blobs"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn bytes_that_arrive_in_pieces_are_found_under_their_hash() {
        let dir = tempfile::tempdir().unwrap();
        let store = BlobStore::open(dir.path()).unwrap();
        let mut writer = store.writer();
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
        let mut writer = store.writer();
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
        assert_eq!((store.remove_unpinned(&[id], Duration::ZERO), store.take_released()), (vec![], vec![]));
        drop(second);
        assert_eq!(store.take_released(), [id]);
        assert_eq!(store.remove_unpinned(&[id], Duration::ZERO), [id]);
        assert!(!store.contains(id));
        assert_eq!(
            store.remove_unpinned(&[id], Duration::ZERO),
            [id],
            "a file that is gone already is no error"
        );
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
