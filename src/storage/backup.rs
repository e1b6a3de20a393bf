//! Copies of a data directory: made while the service runs, and put back.
//!
//! The database is copied by SQLite itself, which gives one moment of it (`VACUUM INTO`). The files that it names never change, and
//! none is deleted meanwhile ([`Hold`](super::Hold)), so they are linked where that can be, and copied otherwise. Every one is read
//! and compared with its hash. Uploads that are not complete are left out. The database gets its name last: a copy that was interrupted is not taken for one.

use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use sqlx::sqlite::{SqliteConnectOptions, SqlitePool, SqlitePoolOptions};

use super::folders::make_private;
use super::references::{Reference, references};
use super::store::DATABASE;
use super::{BlobId, BlobStore, StorageError, Store};

/// What was copied.
#[derive(Debug, Default)]
pub struct Copied {
    /// Files.
    pub blobs: usize,
    /// Their bytes.
    pub bytes: u64,
    /// How many of the files are links to those of the source, which take no space.
    pub linked: usize,
    /// What could not be copied, because its file is missing or damaged.
    pub missing: Vec<(Reference, StorageError)>,
}

/// Whether files may be links to those of the source.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sharing {
    /// Linked where both are on one file system.
    Links,
    /// Always copied: what damages one does not damage the other.
    Copies,
}

/// Copies a data directory, which another process may be serving, to a directory that is empty or not there.
pub async fn backup(data: &Path, to: &Path, sharing: Sharing) -> Result<Copied, StorageError> {
    let source = Store::open_beside(data).await?;
    let partial = prepare(to)?;
    sqlx::query("VACUUM INTO ?").bind(partial.to_string_lossy().as_ref()).execute(&source.read).await?;
    let copied = finish(source.blobs.clone(), to, partial, sharing).await;
    source.close().await;
    copied
}

/// Makes a data directory, which must be empty or not there, from a copy.
pub async fn restore(copy: &Path, data: &Path, sharing: Sharing) -> Result<Copied, StorageError> {
    let database = copy.join(DATABASE);
    if !database.is_file() {
        return Err(StorageError::NoData(copy.to_owned()));
    }
    let partial = prepare(data)?;
    fs::copy(&database, &partial).map_err(StorageError::io("copying the database"))?;
    finish(BlobStore::beside(&copy.join("blobs")), data, partial, sharing).await
}

/// Makes the directory and says where the database goes until all else is there.
fn prepare(to: &Path) -> Result<PathBuf, StorageError> {
    make_private(to)?;
    fs::create_dir_all(to.join("blobs")).map_err(StorageError::io("making the directory of the copy"))?;
    let there: Vec<_> = fs::read_dir(to)
        .and_then(|entries| entries.map(|e| Ok(e?.file_name())).collect::<io::Result<_>>())
        .map_err(StorageError::io("looking into the directory of the copy"))?;
    let used = fs::read_dir(to.join("blobs")).map_or(true, |mut entries| entries.next().is_some());
    if there.len() > 1 || used {
        return Err(StorageError::NotEmpty(to.to_owned()));
    }
    Ok(to.join("cairn.sqlite.partial"))
}

/// Copies the files that the copied database names, and gives it its name.
async fn finish(
    source: BlobStore,
    to: &Path,
    partial: PathBuf,
    sharing: Sharing,
) -> Result<Copied, StorageError> {
    let options = SqliteConnectOptions::new().filename(&partial);
    let database: SqlitePool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await?;
    // The bytes of uploads that are not complete stay behind, for they change: who goes on with one is told that it is not there.
    let forgotten = sqlx::query("DELETE FROM uploads WHERE scan_id IS NULL").execute(&database).await;
    let all = references(&database).await;
    database.close().await;
    forgotten?;
    let (all, to) = (all?, to.to_owned());
    tokio::task::spawn_blocking(move || {
        let copied = copy_blobs(&source, &to.join("blobs"), all, sharing)?;
        let name = |e| StorageError::io("finishing the copy")(e);
        File::open(&partial).and_then(|file| file.sync_all()).map_err(name)?;
        fs::rename(&partial, to.join(DATABASE)).map_err(name)?;
        sync_folder(&to)?;
        if let Some(parent) = to.parent().filter(|p| !p.as_os_str().is_empty()) {
            sync_folder(parent)?;
        }
        Ok(copied)
    })
    .await
    .map_err(|e| StorageError::io("copying blobs")(io::Error::other(e)))?
}

fn copy_blobs(
    source: &BlobStore,
    to: &Path,
    all: Vec<Reference>,
    sharing: Sharing,
) -> Result<Copied, StorageError> {
    let target = BlobStore::beside(to);
    let mut copied = Copied::default();
    let mut folders = BTreeSet::from([to.to_owned()]);
    for reference in all {
        let place = target.path(reference.blob);
        if place.exists() {
            continue;
        }
        if let Err(error) = source.verify(reference.blob) {
            copied.missing.push((reference, error));
            continue;
        }
        for folder in place.ancestors().skip(1).take(2) {
            folders.insert(folder.to_owned());
        }
        if let Some(folder) = place.parent() {
            fs::create_dir_all(folder).map_err(StorageError::io("making a folder of the copy"))?;
        }
        let (bytes, linked) = copy_one(source, reference.blob, &place, sharing)?;
        copied.blobs += 1;
        copied.bytes += bytes;
        copied.linked += usize::from(linked);
    }
    for folder in &folders {
        sync_folder(folder)?;
    }
    Ok(copied)
}

/// Copies one file, synced; returns its size and whether it is a link.
fn copy_one(
    source: &BlobStore,
    id: BlobId,
    place: &Path,
    sharing: Sharing,
) -> Result<(u64, bool), StorageError> {
    let from = source.path(id);
    let failed = |e| StorageError::io("copying a blob")(e);
    if sharing == Sharing::Links && fs::hard_link(&from, place).is_ok() {
        return Ok((fs::metadata(place).map_err(failed)?.len(), true));
    }
    let mut file = File::create_new(place).map_err(failed)?;
    let mut reader = source.reader(id)?;
    let bytes = io::copy(&mut reader, &mut file).map_err(failed)?;
    reader.verify()?;
    file.sync_all().map_err(failed)?;
    Ok((bytes, false))
}

fn sync_folder(folder: &Path) -> Result<(), StorageError> {
    File::open(folder).and_then(|f| f.sync_all()).map_err(StorageError::io("syncing a folder of the copy"))
}

impl BlobStore {
    /// Puts the file of a blob back from another store, if it is sound there. Returns whether it is.
    pub fn take_from(&self, other: &Self, id: BlobId) -> Result<bool, StorageError> {
        let mut reader = match other.reader(id) {
            Ok(reader) => reader,
            Err(StorageError::MissingBlob(_)) => return Ok(false),
            Err(error) => return Err(error),
        };
        let stored = self.put_with(|file| {
            io::copy(&mut reader, file).map(|_| ()).map_err(StorageError::io("copying a blob"))
        })?;
        Ok(stored.id == id)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::project::{Interpretation, Name, NewUpload, ProjectId, Timestamp};
    use crate::storage::testing::{new_scan, project};
    use crate::storage::{Page, Seal};

    const ALL: Page = Page { after: None, limit: 100 };

    async fn scan(store: &Store, project: ProjectId, text: &str) -> BlobId {
        let blob = store.blobs.put(text.as_bytes()).unwrap();
        let new = new_scan(project, u128::from(blob.bytes), *blob);
        store.admit_scan(&new).await.unwrap();
        blob.id
    }

    async fn filled(data: &Path) -> (Store, ProjectId) {
        let store = Store::open(data).await.unwrap();
        let project = project(&store).await;
        scan(&store, project, "first").await;
        (store, project)
    }

    #[tokio::test]
    async fn a_backup_of_a_store_in_use_is_one_moment_of_it_and_can_be_restored() {
        let dir = tempfile::tempdir().unwrap();
        let [data, copy, again] = ["data", "copy", "again"].map(|name| dir.path().join(name));
        let (store, project) = filled(&data).await;
        for sharing in [Sharing::Links, Sharing::Copies] {
            let _ = fs::remove_dir_all(&copy);
            let copied = backup(&data, &copy, sharing).await.unwrap();
            assert_eq!((copied.blobs, copied.bytes, copied.missing.len()), (1, 5, 0));
            assert_eq!(copied.linked, usize::from(sharing == Sharing::Links));
        }
        scan(&store, project, "later").await;
        store.delete_project(project).await.unwrap();
        store.collect_garbage(Duration::ZERO).await.unwrap();
        assert!(matches!(backup(&data, &copy, Sharing::Links).await, Err(StorageError::NotEmpty(_))));
        restore(&copy, &again, Sharing::Copies).await.unwrap();
        let restored = Store::open(&again).await.unwrap();
        let scans = restored.scans(project, ALL).await.unwrap();
        assert_eq!(scans.len(), 1);
        assert_eq!(restored.blobs.get(BlobId::parse(&scans[0].blob).unwrap()).unwrap(), b"first");
        assert!(restored.integrity().await.unwrap().is_empty());
    }

    #[tokio::test]
    async fn uploads_that_are_not_complete_stay_behind_and_short_ones_are_told_by_a_check() {
        let dir = tempfile::tempdir().unwrap();
        let [data, copy, again] = ["data", "copy", "again"].map(|name| dir.path().join(name));
        let (store, project) = filled(&data).await;
        let new = NewUpload {
            project,
            name: Name::parse("scan").unwrap(),
            interpretation: Interpretation::default(),
            metadata: String::new(),
            length: 10,
            sender: None,
        };
        let expires = Timestamp::now().plus(Duration::from_mins(1));
        let upload = store.create_upload(new, expires, Seal::none()).await.unwrap();
        let mut file = store.uploads.at(upload.id, 0).await.unwrap();
        file.write(b"seven b").await.unwrap();
        file.sync().await.unwrap();
        store.advance_upload(upload.id, 7, expires).await.unwrap();
        assert_eq!(store.integrity().await.unwrap(), [""; 0]);

        backup(&data, &copy, Sharing::Links).await.unwrap();
        restore(&copy, &again, Sharing::Copies).await.unwrap();
        let restored = Store::open(&again).await.unwrap();
        assert!(matches!(restored.upload(upload.id).await, Err(StorageError::NoUpload(_))));
        assert_eq!(restored.integrity().await.unwrap(), [""; 0]);

        file.cut(4).await.unwrap();
        let told = store.integrity().await.unwrap();
        let expected = format!("an upload has 4 of the 7 bytes that were acknowledged: {}", upload.id);
        assert_eq!(told, [expected]);
    }

    #[tokio::test]
    async fn what_is_damaged_is_named_and_the_rest_is_copied() {
        let dir = tempfile::tempdir().unwrap();
        let [data, copy] = ["data", "copy"].map(|name| dir.path().join(name));
        let (store, project) = filled(&data).await;
        let bad = scan(&store, project, "second").await;
        fs::write(store.blobs.path(bad), "spoiled").unwrap();
        let copied = backup(&data, &copy, Sharing::Links).await.unwrap();
        assert_eq!(copied.blobs, 1);
        assert_eq!(copied.missing.iter().map(|(r, _)| r.blob).collect::<Vec<_>>(), [bad]);
    }

    #[tokio::test]
    async fn a_copy_that_was_interrupted_is_not_restored() {
        let dir = tempfile::tempdir().unwrap();
        let copy = dir.path().join("copy");
        fs::create_dir_all(copy.join("blobs")).unwrap();
        fs::write(copy.join("cairn.sqlite.partial"), "half of it").unwrap();
        let restored = restore(&copy, &dir.path().join("data"), Sharing::Copies).await;
        assert!(matches!(restored, Err(StorageError::NoData(_))), "{restored:?}");
    }
}
