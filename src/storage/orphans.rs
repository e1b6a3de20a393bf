//! Files that no row names: what a crash leaves between storing a blob and committing its row.
//!
//! The folder of blobs is walked from time to time, and what nothing needs is noted for the collector, which looks again.

use std::fs::{self, DirEntry};
use std::io;
use std::path::Path;
use std::time::{Duration, SystemTime};

use sqlx::Row;

use super::garbage::needed;
use super::{BlobId, StorageError, Store};

/// Blobs asked about in one query.
const AT_ONCE: usize = 500;

impl Store {
    /// Notes files of blobs that no row needs and that are at least so old, for the collector. Returns how many.
    pub async fn note_orphans(&self, age: Duration) -> Result<usize, StorageError> {
        let root = self.blobs.root().to_owned();
        let found = tokio::task::spawn_blocking(move || walk(&root, SystemTime::now().checked_sub(age)))
            .await
            .map_err(|e| StorageError::io("walking the blobs")(io::Error::other(e)))?
            .map_err(StorageError::io("walking the blobs"))?;
        let mut noted = 0;
        for part in found.chunks(AT_ONCE) {
            let names: Vec<String> = part.iter().map(ToString::to_string).collect();
            let orphans = sqlx::query(sqlx::AssertSqlSafe(format!(
                "SELECT j.value AS blob FROM json_each(?) j WHERE NOT ({})",
                needed("j.value")
            )))
            .bind(super::rows::to_json(&names)?)
            .fetch_all(&self.read)
            .await?;
            if orphans.is_empty() {
                continue;
            }
            let mut tx = self.begin().await?;
            for row in &orphans {
                sqlx::query("INSERT OR IGNORE INTO garbage VALUES (?)")
                    .bind(row.try_get::<String, _>("blob")?)
                    .execute(&mut *tx)
                    .await?;
            }
            tx.commit().await?;
            noted += orphans.len();
        }
        Ok(noted)
    }
}

/// Names of all blobs whose files were written before a moment; of all if it is `None`.
fn walk(root: &Path, before: Option<SystemTime>) -> io::Result<Vec<BlobId>> {
    let mut found = Vec::new();
    for file in files(root)? {
        let Some(id) = file.file_name().to_str().and_then(|name| BlobId::parse(name).ok()) else { continue };
        match file.metadata().and_then(|m| m.modified()) {
            Ok(written) if before.is_none_or(|before| written <= before) => found.push(id),
            Ok(_) => {}
            // The collector was faster.
            Err(e) if e.kind() == io::ErrorKind::NotFound => {}
            Err(e) => return Err(e),
        }
    }
    Ok(found)
}

/// Everything in the folders `xx/yy/` below the folder of blobs.
pub(super) fn files(root: &Path) -> io::Result<Vec<DirEntry>> {
    let mut level = vec![root.to_owned()];
    for _ in 0..2 {
        let mut next = Vec::new();
        for folder in &level {
            for entry in fs::read_dir(folder)? {
                let entry = entry?;
                if entry.file_name().len() == 2 && entry.file_type()?.is_dir() {
                    next.push(entry.path());
                }
            }
        }
        level = next;
    }
    let mut found = Vec::new();
    for folder in &level {
        for entry in fs::read_dir(folder)? {
            found.push(entry?);
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::storage::testing::project;
    use crate::storage::{Hold, Owner};

    #[tokio::test]
    async fn what_a_crash_left_without_a_row_is_found_at_the_next_start_and_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let project = project(&store).await;
        let needed = store.blobs.put(b"needed").unwrap();
        store.remember(&blake3::hash(b"key"), Owner { project, scan: None }, &needed).await.unwrap();
        let orphan = store.blobs.put(b"its row never came").unwrap().id;
        fs::write(store.blobs.path(orphan).with_file_name("a stranger"), "not ours").unwrap();
        store.close().await;
        drop((needed, store));
        let store = Store::open(dir.path()).await.unwrap();
        assert_eq!(store.note_orphans(Duration::from_hours(1)).await.unwrap(), 0, "too young");
        assert_eq!(store.note_orphans(Duration::ZERO).await.unwrap(), 1);
        assert_eq!(store.collect_garbage(Duration::ZERO).await.unwrap(), 1);
        assert!(!store.blobs.contains(orphan));
        assert_eq!(store.note_orphans(Duration::ZERO).await.unwrap(), 0);
        assert_eq!(store.blobs.get(BlobId(blake3::hash(b"needed"))).unwrap(), b"needed");
    }

    #[tokio::test]
    async fn a_fresh_blob_outlives_the_walk_and_a_hold_outlives_the_collector() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let fresh = store.blobs.put(b"its row comes").unwrap();
        store.note_orphans(Duration::ZERO).await.unwrap();
        assert_eq!(store.collect_garbage(Duration::ZERO).await.unwrap(), 0);
        let (id, hold) = (fresh.id, Hold::take(dir.path()).unwrap());
        drop(fresh);
        assert_eq!(store.collect_garbage(Duration::ZERO).await.unwrap(), 0);
        assert!(store.blobs.contains(id));
        drop(hold);
        assert_eq!(store.collect_garbage(Duration::ZERO).await.unwrap(), 1);
    }
}
