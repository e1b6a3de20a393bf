//! Which blob holds the result of a computation, by the hash of what went into it.
//!
//! Results of one scan go with it. Those of several are files that readers asked for, with parameters of their own choice: of these each
//! project keeps the newest, and all together have a limit in bytes, or reading alone would fill the disk. What is gone is made again when
//! it is asked for.

use sqlx::Row;

use super::rows::count;
use super::{BlobId, FreshBlob, StorageError, Store, StoredBlob};
use crate::project::{ProjectId, ScanId, Timestamp};

/// Results of several scans that a project keeps.
const KEPT: u32 = 32;

/// With what a derived blob goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Owner {
    /// The project.
    pub project: ProjectId,
    /// The scan that it was made of; `None`: of several.
    pub scan: Option<ScanId>,
}

impl Store {
    /// The result of the computation with this key, if it is known and its file is there.
    pub async fn derived(&self, key: &blake3::Hash) -> Result<Option<StoredBlob>, StorageError> {
        let row = sqlx::query("SELECT blob, bytes FROM derived WHERE cache_key = ?")
            .bind(key.to_hex().as_str())
            .fetch_optional(&self.read)
            .await?;
        let Some(row) = row else { return Ok(None) };
        let stored = StoredBlob { id: BlobId::parse(row.try_get("blob")?)?, bytes: count(&row, "bytes")? };
        Ok(self.blobs.contains(stored.id).then_some(stored))
    }

    /// Remembers the result of a computation. If the owner is gone already, nothing is remembered.
    pub async fn remember(
        &self,
        key: &blake3::Hash,
        owner: Owner,
        stored: &FreshBlob,
    ) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query(
            "INSERT INTO derived (cache_key, project_id, scan_id, blob, bytes, created_ms)
               SELECT ?1, p.id, ?3, ?4, ?5, ?6 FROM projects p WHERE p.id = ?2
                 AND (?3 IS NULL OR EXISTS (SELECT 1 FROM scans WHERE id = ?3 AND forgotten_ms IS NULL))
               ON CONFLICT (cache_key) DO UPDATE SET project_id = excluded.project_id, scan_id = excluded.scan_id,
                 blob = excluded.blob, bytes = excluded.bytes, created_ms = excluded.created_ms",
        )
        .bind(key.to_hex().as_str())
        .bind(owner.project.to_string())
        .bind(owner.scan.map(|scan| scan.to_string()))
        .bind(stored.id.to_string())
        .bind(stored.bytes.cast_signed())
        .bind(Timestamp::now().0)
        .execute(&mut *tx)
        .await?;
        if owner.scan.is_none() {
            sqlx::query(
                "DELETE FROM derived WHERE project_id = ?1 AND scan_id IS NULL AND rowid NOT IN
                   (SELECT rowid FROM derived WHERE project_id = ?1 AND scan_id IS NULL
                      ORDER BY created_ms DESC, rowid DESC LIMIT ?2)",
            )
            .bind(owner.project.to_string())
            .bind(KEPT)
            .execute(&mut *tx)
            .await?;
        }
        tx.commit().await?;
        Ok(())
    }

    /// Forgets files that readers asked for, of any project, the oldest first, until the others have at most `bytes` together. The newest
    /// stays, however large it is: somebody is about to read it.
    pub async fn limit_exports(&self, bytes: u64) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query(
            "DELETE FROM derived WHERE rowid IN (SELECT id FROM
               (SELECT rowid AS id, sum(bytes) OVER newest AS together, row_number() OVER newest AS place
                  FROM derived WHERE scan_id IS NULL WINDOW newest AS (ORDER BY created_ms DESC, rowid DESC))
               WHERE place > 1 AND together > ?)",
        )
        .bind(i64::try_from(bytes).unwrap_or(i64::MAX))
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(())
    }

    /// Forgets all files that readers asked for. Returns how many there were.
    pub async fn forget_exports(&self) -> Result<u64, StorageError> {
        let any = sqlx::query("SELECT 1 FROM derived WHERE scan_id IS NULL LIMIT 1");
        if any.fetch_optional(&self.read).await?.is_none() {
            return Ok(0);
        }
        let mut tx = self.begin().await?;
        let gone = sqlx::query("DELETE FROM derived WHERE scan_id IS NULL").execute(&mut *tx).await?;
        tx.commit().await?;
        Ok(gone.rows_affected())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::{Name, ProjectSettings};
    use crate::storage::Seal;
    use crate::storage::testing::{Fixture, new_scan, project};

    #[tokio::test]
    async fn a_project_keeps_the_newest_files_that_readers_asked_for_and_others_keep_theirs() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let name = Name::parse("p").unwrap();
        let mut projects = Vec::new();
        for _ in 0..2 {
            projects.push(
                store.create_project(&name, &ProjectSettings::default(), Seal::none()).await.unwrap().id,
            );
        }
        let key = |n: u32| blake3::hash(&n.to_le_bytes());
        let remember = async |project, n: u32| {
            let fresh = store.blobs.put(&n.to_le_bytes()).unwrap();
            store.remember(&key(n), Owner { project, scan: None }, &fresh).await.unwrap();
        };
        remember(projects[0], 1000).await;
        for n in 0..KEPT + 5 {
            remember(projects[1], n).await;
        }
        assert!(store.derived(&key(1000)).await.unwrap().is_some());
        for n in 0..KEPT + 5 {
            assert_eq!(store.derived(&key(n)).await.unwrap().is_some(), n >= 5, "{n}");
        }
    }

    #[tokio::test]
    async fn files_that_readers_asked_for_have_a_limit_in_bytes_whatever_project_they_are_of() {
        let f = Fixture::new().await;
        let other = project(&f.store).await;
        let scan = f.store.admit_scan(&new_scan(other, 1, *f.blob("scan"))).await.unwrap().scan.id;
        let key = |name: &str| blake3::hash(name.as_bytes());
        let files =
            [("a", f.project, None), ("bb", other, None), ("cc", other, None), ("prep", other, Some(scan))];
        for (name, project, scan) in files {
            f.store.remember(&key(name), Owner { project, scan }, &f.blob(name)).await.unwrap();
        }
        let left = async || {
            let mut left = Vec::new();
            for (name, ..) in files {
                if f.store.derived(&key(name)).await.unwrap().is_some() {
                    left.push(name);
                }
            }
            left
        };
        f.store.limit_exports(5).await.unwrap();
        assert_eq!(left().await, ["a", "bb", "cc", "prep"]);
        f.store.limit_exports(4).await.unwrap();
        assert_eq!(left().await, ["bb", "cc", "prep"], "the oldest goes first");
        f.store.limit_exports(0).await.unwrap();
        assert_eq!(left().await, ["cc", "prep"], "somebody is about to read the newest");
        assert_eq!(f.store.forget_exports().await.unwrap(), 1);
        assert_eq!(left().await, ["prep"], "what belongs to a scan goes with the scan");
        assert_eq!(f.store.forget_exports().await.unwrap(), 0);
    }
}
