//! Which blob holds the result of a computation, by the hash of what went into it.

use sqlx::Row;

use super::rows::count;
use super::{BlobId, StorageError, Store, StoredBlob};
use crate::project::Timestamp;

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

    /// Remembers the result of a computation.
    pub async fn remember(&self, key: &blake3::Hash, stored: StoredBlob) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query("INSERT OR REPLACE INTO derived VALUES (?, ?, ?, ?)")
            .bind(key.to_hex().as_str())
            .bind(stored.id.to_string())
            .bind(stored.bytes.cast_signed())
            .bind(Timestamp::now().0)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(())
    }
}
