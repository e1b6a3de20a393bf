//! Which blob holds the result of a computation, by the hash of what went into it.

use sqlx::Row;

use super::rows::count;
use super::{BlobId, FreshBlob, StorageError, Store, StoredBlob};
use crate::project::{ProjectId, ScanId, Timestamp};

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
        tx.commit().await?;
        Ok(())
    }
}
