//! Which blob holds the result of a computation, by the hash of what went into it.
//!
//! Results of one scan go with it. Those of several are files that readers asked for, with parameters of their own choice: of these each
//! project keeps the newest, or reading alone would fill the disk. What is gone is made again when it is asked for.

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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::{Name, ProjectSettings};
    use crate::storage::Seal;

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
}
