//! Rows of uploads that arrive in several requests: announcement, progress, the scan at the end, forgetting.

use std::time::Duration;

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::quotas::Addition;
use super::rows::{count, json, parsed, to_json, word};
use super::upload_files::blocking;
use super::{Admission, FreshBlob, NewScan, Page, Seal, StorageError, Store, StoredBlob};
use crate::project::{KeyId, Name, NewUpload, ProjectId, ScanId, Timestamp, Upload, UploadEnd, UploadId};

/// How long after its expiry an upload is remembered, so that its client is told what happened to it.
const REMEMBERED: Duration = Duration::from_hours(24);

impl Store {
    /// Notes an upload that was announced, and keeps the answer to the announcement. It expires at `expires` unless something comes.
    pub async fn create_upload(
        &self,
        new: NewUpload,
        expires: Timestamp,
        seal: Seal<'_, Upload>,
    ) -> Result<Upload, StorageError> {
        let (id, created) = (UploadId::generate(), Timestamp::now());
        let mut tx = self.begin().await?;
        let known = sqlx::query("SELECT 1 FROM projects WHERE id = ?").bind(new.project.to_string());
        if known.fetch_optional(&mut *tx).await?.is_none() {
            return Err(StorageError::NoProject(new.project));
        }
        let more = Addition { bytes: new.length, scans: 1, jobs: 1, uploads: 1, announced: None };
        self.check_quotas(&mut tx, new.project, new.sender, more).await?;
        sqlx::query(
            "INSERT INTO uploads (id, project_id, name, interpretation, metadata, length, created_ms, expires_ms, key_id)
             VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
        )
        .bind(id.to_string())
        .bind(new.project.to_string())
        .bind(new.name.as_str())
        .bind(to_json(&new.interpretation)?)
        .bind(&new.metadata)
        .bind(new.length.cast_signed())
        .bind(created.0)
        .bind(expires.0)
        .bind(new.sender.map(|key| key.to_string()))
        .execute(&mut *tx)
        .await?;
        let made = Upload { id, announced: new, received: 0, blob: None, end: None, created, expires };
        seal.set(&mut tx, &made).await?;
        tx.commit().await?;
        Ok(made)
    }

    /// One upload, expired or not.
    pub async fn upload(&self, id: UploadId) -> Result<Upload, StorageError> {
        let row = sqlx::query("SELECT * FROM uploads WHERE id = ?")
            .bind(id.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(upload).transpose()?.ok_or(StorageError::NoUpload(id))
    }

    /// Uploads of a project that are neither complete nor expired, oldest first, each with its position in the list.
    pub async fn open_uploads(
        &self,
        project: ProjectId,
        page: Page,
    ) -> Result<Vec<(i64, Upload)>, StorageError> {
        let rows = sqlx::query(
            "SELECT rowid AS position, * FROM uploads WHERE project_id = ? AND scan_id IS NULL AND expires_ms > ?
               AND rowid > ? ORDER BY rowid LIMIT ?",
        )
        .bind(project.to_string())
        .bind(Timestamp::now().0)
        .bind(page.after.unwrap_or(0))
        .bind(page.limit)
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(|row| Ok((row.try_get("position")?, upload(row)?))).collect()
    }

    /// Notes that the first `received` bytes are synced, fewer than all, and when the rest is given up. What has expired stays so: its
    /// file may be gone. [`StorageError::NoUpload`] then, as for one that has ended.
    pub async fn advance_upload(
        &self,
        id: UploadId,
        received: u64,
        expires: Timestamp,
    ) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        let done = sqlx::query(
            "UPDATE uploads SET received = ?, expires_ms = ?, blob = NULL
               WHERE id = ? AND scan_id IS NULL AND expires_ms > ?",
        )
        .bind(received.cast_signed())
        .bind(expires.0)
        .bind(id.to_string())
        .bind(Timestamp::now().0)
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        if done.rows_affected() == 0 { Err(StorageError::NoUpload(id)) } else { Ok(()) }
    }

    /// Turns the synced file of a complete upload into a blob. The row names it first: if the process dies on the way,
    /// [`Store::held_upload`] finds it.
    pub async fn settle_upload(&self, id: UploadId, stored: StoredBlob) -> Result<FreshBlob, StorageError> {
        let mut tx = self.begin().await?;
        let done =
            sqlx::query("UPDATE uploads SET blob = ? WHERE id = ? AND scan_id IS NULL AND expires_ms > ?")
                .bind(stored.id.to_string())
                .bind(id.to_string())
                .bind(Timestamp::now().0)
                .execute(&mut *tx)
                .await?;
        tx.commit().await?;
        if done.rows_affected() == 0 {
            return Err(StorageError::NoUpload(id));
        }
        let (blobs, file) = (self.blobs.clone(), self.uploads.path(id));
        blocking("naming a blob", move || blobs.adopt(&file, stored)).await
    }

    /// Pins a blob that a complete upload became before its scan could be acknowledged, if it is there.
    #[must_use]
    pub fn held_upload(&self, stored: StoredBlob) -> Option<FreshBlob> {
        // Pinned before the look, so that it cannot go between the two.
        let fresh = self.blobs.hold(stored);
        self.blobs.contains(stored.id).then_some(fresh)
    }

    /// Acknowledges a complete upload: its scan and job as for any other, and the upload's end, in one transaction.
    pub async fn admit_upload(
        &self,
        id: UploadId,
        new: &NewScan,
        expires: Timestamp,
    ) -> Result<Admission, StorageError> {
        let mut tx = self.begin().await?;
        let admitted = self.admit(&mut tx, new, Some(id), Timestamp::now()).await?;
        let done = sqlx::query(
            "UPDATE uploads SET received = length, scan_id = ?, job_id = ?, duplicate = ?, expires_ms = ?
             WHERE id = ? AND scan_id IS NULL",
        )
        .bind(admitted.scan.to_string())
        .bind(admitted.job.to_string())
        .bind(admitted.duplicate)
        .bind(expires.0)
        .bind(id.to_string())
        .execute(&mut *tx)
        .await?;
        if done.rows_affected() == 0 {
            return Err(StorageError::NoUpload(id));
        }
        tx.commit().await?;
        self.admitted(new.project, admitted).await
    }

    /// Forgets an upload and its bytes. A scan that it became stays.
    pub async fn delete_upload(&self, id: UploadId) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        let done =
            sqlx::query("DELETE FROM uploads WHERE id = ?").bind(id.to_string()).execute(&mut *tx).await?;
        tx.commit().await?;
        let files = self.uploads.clone();
        blocking("deleting an upload", move || files.remove(id)).await?;
        if done.rows_affected() == 0 { Err(StorageError::NoUpload(id)) } else { Ok(()) }
    }

    /// Deletes the bytes of uploads that have expired by `now` or that no row knows, and the rows that have been expired
    /// for a day. What cannot be deleted is tried again the next time. Returns how many files went.
    pub(super) async fn forget_uploads(&self, now: Timestamp) -> Result<usize, StorageError> {
        let files = self.uploads.clone();
        let mut removed = 0;
        for id in blocking("listing uploads", move || files.ids()).await? {
            let needed = match self.upload(id).await {
                Ok(upload) => upload.end.is_none() && upload.expires > now,
                Err(StorageError::NoUpload(_)) => false,
                Err(error) => return Err(error),
            };
            if !needed {
                let files = self.uploads.clone();
                match blocking("deleting an upload", move || files.remove(id)).await {
                    Ok(()) => removed += 1,
                    Err(error) => {
                        tracing::error!(upload = %id, %error, "the bytes of an upload cannot be deleted");
                    }
                }
            }
        }
        let before = now.0.saturating_sub(i64::try_from(REMEMBERED.as_millis()).unwrap_or(i64::MAX));
        let old = sqlx::query("SELECT 1 FROM uploads WHERE expires_ms < ? LIMIT 1").bind(before);
        if old.fetch_optional(&self.read).await?.is_some() {
            let mut tx = self.begin().await?;
            sqlx::query("DELETE FROM uploads WHERE expires_ms < ?").bind(before).execute(&mut *tx).await?;
            tx.commit().await?;
        }
        Ok(removed)
    }
}

fn upload(row: &SqliteRow) -> Result<Upload, StorageError> {
    let end = match row.try_get::<Option<String>, _>("scan_id")? {
        None => None,
        Some(_) => Some(UploadEnd {
            scan: parsed::<ScanId>(row, "scan_id")?,
            job: parsed(row, "job_id")?,
            duplicate: row.try_get("duplicate")?,
        }),
    };
    Ok(Upload {
        id: parsed(row, "id")?,
        announced: NewUpload {
            project: parsed::<ProjectId>(row, "project_id")?,
            name: word(row, "name", |text| Name::parse(text).ok())?,
            interpretation: json(row, "interpretation")?.unwrap_or_default(),
            metadata: row.try_get("metadata")?,
            length: count(row, "length")?,
            sender: match row.try_get::<Option<String>, _>("key_id")? {
                Some(_) => Some(parsed::<KeyId>(row, "key_id")?),
                None => None,
            },
        },
        received: count(row, "received")?,
        blob: row.try_get("blob")?,
        end,
        created: Timestamp(row.try_get("created_ms")?),
        expires: Timestamp(row.try_get("expires_ms")?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::Interpretation;
    use crate::storage::testing::project;

    #[tokio::test]
    async fn what_expired_or_was_deleted_leaves_no_bytes_and_at_last_no_row() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let name = Name::parse("test").unwrap();
        let doomed = project(&store).await;
        let other = project(&store).await;
        let new = |project| NewUpload {
            project,
            name: name.clone(),
            interpretation: Interpretation::default(),
            metadata: String::new(),
            length: 10,
            sender: None,
        };
        let now = Timestamp::now();
        let (soon, late) = (now.plus(Duration::from_secs(1)), now.plus(Duration::from_hours(1)));
        let orphan = store.create_upload(new(doomed), late, Seal::none()).await.unwrap().id;
        let expired = store.create_upload(new(other), soon, Seal::none()).await.unwrap().id;
        let alive = store.create_upload(new(other), late, Seal::none()).await.unwrap().id;
        for id in [orphan, expired, alive] {
            let mut file = store.uploads.at(id, 0).await.unwrap();
            file.write(b"12345").await.unwrap();
            file.sync().await.unwrap();
        }
        let gone = now.plus(Duration::ZERO);
        let late_for = store.create_upload(new(other), gone, Seal::none()).await.unwrap().id;
        let advanced = store.advance_upload(late_for, 5, late).await;
        assert!(
            matches!(advanced, Err(StorageError::NoUpload(id)) if id == late_for),
            "what expired stays so"
        );
        store.delete_project(doomed).await.unwrap();
        assert_eq!(store.forget_uploads(now.plus(Duration::from_mins(1))).await.unwrap(), 2);
        assert_eq!(store.uploads.ids().unwrap(), [alive]);
        assert!(store.upload(expired).await.is_ok(), "its client is told that it expired");
        store.forget_uploads(soon.plus(REMEMBERED + Duration::from_millis(1))).await.unwrap();
        assert!(matches!(store.upload(expired).await, Err(StorageError::NoUpload(_))));
        assert!(store.upload(alive).await.is_ok());
    }
}
