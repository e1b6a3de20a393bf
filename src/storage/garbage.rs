//! Collecting blobs that no row needs any more.
//!
//! Triggers note every blob that loses a reference, in the transaction that takes it. The collector looks whether
//! another row needs it while it holds the one write lock, so no row can appear meanwhile; a blob whose row is still to
//! be committed is pinned. What a crash leaves noted is looked at again.

use sqlx::Row;

use super::{BlobId, StorageError, Store};

/// Blobs looked at in one transaction.
const AT_ONCE: i64 = 64;

/// A noted blob, and whether a row needs it. A deleted scan's upload is needed until the model holds the scan no more,
/// the engine's state until there is a newer one.
const NOTED: &str = "
    SELECT g.rowid AS position, g.blob,
           EXISTS (SELECT 1 FROM scans s WHERE s.blob = g.blob AND s.forgotten_ms IS NULL)
           OR EXISTS (SELECT 1 FROM versions v JOIN projects p ON p.id = v.project_id
                      WHERE v.snapshot = g.blob AND v.number = p.head)
           OR EXISTS (SELECT 1 FROM versions v WHERE v.content = g.blob)
           OR EXISTS (SELECT 1 FROM derived d WHERE d.blob = g.blob) AS needed
    FROM garbage g WHERE g.rowid > ? ORDER BY g.rowid LIMIT ?";

impl Store {
    /// Deletes the files of blobs that no row needs any more. Returns how many.
    pub async fn collect_garbage(&self) -> Result<usize, StorageError> {
        self.note_released().await?;
        let (mut collected, mut after) = (0, 0);
        loop {
            let mut tx = self.begin().await?;
            let rows = sqlx::query(NOTED).bind(after).bind(AT_ONCE).fetch_all(&mut *tx).await?;
            let Some(last) = rows.last() else { return Ok(collected) };
            after = last.try_get("position")?;
            let (mut settled, mut unneeded) = (Vec::new(), Vec::new());
            for row in &rows {
                let id = BlobId::parse(row.try_get("blob")?)?;
                if row.try_get("needed")? { settled.push(id) } else { unneeded.push(id) }
            }
            let blobs = self.blobs.clone();
            let removed = tokio::task::spawn_blocking(move || blobs.remove_unpinned(&unneeded))
                .await
                .map_err(|e| StorageError::io("deleting blobs")(std::io::Error::other(e)))??;
            collected += removed.len();
            for id in settled.iter().chain(&removed) {
                sqlx::query("DELETE FROM garbage WHERE blob = ?").bind(id.to_string()).execute(&mut *tx).await?;
            }
            tx.commit().await?;
        }
    }

    /// Notes blobs that were stored but may never have got a row, because what stored them failed afterwards.
    async fn note_released(&self) -> Result<(), StorageError> {
        let released = self.blobs.take_released();
        if released.is_empty() {
            return Ok(());
        }
        let mut tx = self.begin().await?;
        for id in released {
            sqlx::query("INSERT OR IGNORE INTO garbage VALUES (?)")
                .bind(id.to_string())
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        Ok(())
    }
}
