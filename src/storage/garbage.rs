//! Collecting blobs that no row needs any more.
//!
//! Triggers note every blob that loses a reference, in the transaction that takes it. The collector looks whether
//! another row needs it while it holds the one write lock, so no row can appear meanwhile; a blob whose row is still to
//! be committed is pinned. What a crash leaves noted is looked at again;
//! files that it leaves unnoted are found by `orphans`.

use std::time::Duration;

use sqlx::Row;

use super::{BlobId, StorageError, Store, hold};
use crate::project::Timestamp;

/// Blobs looked at in one transaction.
const AT_ONCE: i64 = 64;

/// The SQL condition that a row needs the blob that `name` names. A deleted scan's upload is needed until the model holds the scan
/// no more, the engine's state until there is a newer one. Every table that names blobs is in here.
pub(super) fn needed(name: &str) -> String {
    format!(
        "EXISTS (SELECT 1 FROM scans s WHERE s.blob = {name} AND s.forgotten_ms IS NULL)
         OR EXISTS (SELECT 1 FROM versions v JOIN projects p ON p.id = v.project_id
                    WHERE v.snapshot = {name} AND v.number = p.head)
         OR EXISTS (SELECT 1 FROM versions v WHERE v.content = {name})
         OR EXISTS (SELECT 1 FROM uploads u WHERE u.blob = {name} AND u.scan_id IS NULL)
         OR EXISTS (SELECT 1 FROM derived d WHERE d.blob = {name})"
    )
}

impl Store {
    /// Deletes the files of blobs that no row needs any more, unless a [`Hold`](super::Hold) keeps them or they are younger than `age`:
    /// another process that works for this one may be about to commit their rows. What cannot be deleted stays noted and is tried again
    /// the next time. Returns how many went.
    pub async fn collect_garbage(&self, age: Duration) -> Result<usize, StorageError> {
        let now = Timestamp::now();
        self.forget_uploads(now).await?;
        self.forget_answers(now).await?;
        self.note_released().await?;
        let noted = format!(
            "SELECT g.rowid AS position, g.blob, ({}) AS needed FROM garbage g WHERE g.rowid > ? ORDER BY g.rowid LIMIT ?",
            needed("g.blob")
        );
        let (mut collected, mut after) = (0, 0);
        loop {
            // A backup or another process that needs files to stay: they are looked at again later.
            let Some(_turn) = hold::turn(&self.data)? else { return Ok(collected) };
            let mut tx = self.begin().await?;
            let rows = sqlx::query(sqlx::AssertSqlSafe(noted.as_str()))
                .bind(after)
                .bind(AT_ONCE)
                .fetch_all(&mut *tx)
                .await?;
            let Some(last) = rows.last() else { return Ok(collected) };
            after = last.try_get("position")?;
            let (mut settled, mut unneeded) = (Vec::new(), Vec::new());
            for row in &rows {
                let id = BlobId::parse(row.try_get("blob")?)?;
                if row.try_get("needed")? { settled.push(id) } else { unneeded.push(id) }
            }
            let blobs = self.blobs.clone();
            let removed = tokio::task::spawn_blocking(move || blobs.remove_unpinned(&unneeded, age))
                .await
                .map_err(|e| StorageError::io("deleting blobs")(std::io::Error::other(e)))?;
            collected += removed.len();
            for id in settled.iter().chain(&removed) {
                sqlx::query("DELETE FROM garbage WHERE blob = ?")
                    .bind(id.to_string())
                    .execute(&mut *tx)
                    .await?;
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

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::project::{JobKind, Lane, ProjectId, Scan, UploadId, VersionNumber};
    use crate::storage::testing::{Fixture, new_scan, project};
    use crate::storage::{Claim, NewVersion, Owner, Publication, Seal};

    impl Fixture {
        async fn uploaded_to(&self, project: ProjectId, text: &str) -> Scan {
            let blob = self.blob(text);
            let new = new_scan(project, u128::from(blob.bytes), *blob);
            self.store.admit_scan(&new).await.unwrap().scan
        }

        /// Collects, then says which of the texts are still there.
        async fn left(&self, texts: &[&str]) -> Vec<bool> {
            self.store.collect_garbage(Duration::ZERO).await.unwrap();
            let there = |text: &&str| self.store.blobs.contains(BlobId(blake3::hash(text.as_bytes())));
            texts.iter().map(there).collect()
        }

        async fn mapping(&self) -> Claim {
            self.store.claim(Lane::Map, "worker", Duration::from_mins(1), 1, false).await.unwrap().unwrap()
        }

        async fn publish(&self, claim: &Claim, from: u32, version: Option<(&str, &str)>) {
            let blobs = version.map(|(snapshot, content)| (self.blob(snapshot), self.blob(content)));
            let version = blobs.as_ref().map(|(snapshot, content)| NewVersion {
                snapshot: snapshot.id,
                content: content.id,
                resolution: 0.1,
                components: 0,
                registered: 0,
                waiting: 0,
            });
            let publication = Publication {
                project: claim.job.project,
                kind: claim.job.kind,
                from: VersionNumber(from),
                version,
                pairs: Vec::new(),
                engine: "test".to_owned(),
                scans: Vec::new(),
                forgotten: claim
                    .job
                    .scan
                    .filter(|_| claim.job.kind == JobKind::Removal)
                    .into_iter()
                    .collect(),
                outcomes: vec![(claim.job.id, Ok(json!({})))],
            };
            self.store.publish(&claim.lease, &publication).await.unwrap();
        }
    }

    #[tokio::test]
    async fn what_a_deleted_project_alone_needed_goes_and_the_rest_stays() {
        let f = Fixture::new().await;
        let (doomed, other) = (f.project, project(&f.store).await);
        f.uploaded_to(doomed, "shared").await;
        f.uploaded_to(other, "shared").await;
        let scan = f.uploaded_to(doomed, "its own").await;
        let prepared = f.blob("prepared");
        let owner = Owner { project: doomed, scan: Some(scan.id) };
        f.store.remember(&blake3::hash(b"key"), owner, &prepared).await.unwrap();
        drop(prepared);
        let texts = ["shared", "its own", "prepared"];
        assert_eq!(f.left(&texts).await, [true, true, true]);
        f.store.delete_project(doomed).await.unwrap();
        assert_eq!(f.left(&texts).await, [true, false, false]);
    }

    #[tokio::test]
    async fn an_upload_stays_until_the_model_holds_its_deleted_scan_no_more() {
        let f = Fixture::new().await;
        let project = f.project;
        let scan = f.uploaded_to(project, "upload").await;
        f.store.delete_scan(project, scan.id).await.unwrap();
        assert_eq!(f.left(&["upload"]).await, [true]);
        let removal = f.mapping().await;
        assert_eq!(removal.job.kind, JobKind::Removal);
        f.publish(&removal, 0, None).await;
        assert_eq!(f.left(&["upload"]).await, [false]);
    }

    #[tokio::test]
    async fn only_the_newest_version_keeps_the_state_of_the_engine() {
        let f = Fixture::new().await;
        let project = f.project;
        for from in 0..2 {
            f.store.create_job(project, JobKind::Rebuild, None, Seal::none()).await.unwrap();
            let claim = f.mapping().await;
            let blobs = [["state 1", "content 1"], ["state 2", "content 2"]][from as usize];
            f.publish(&claim, from, Some((blobs[0], blobs[1]))).await;
        }
        let texts = ["state 1", "content 1", "state 2", "content 2"];
        assert_eq!(f.left(&texts).await, [false, true, true, true]);
    }

    #[tokio::test]
    async fn a_fresh_blob_stays_while_its_row_is_to_come_and_goes_if_none_came() {
        let f = Fixture::new().await;
        let fresh = f.blob("fresh");
        f.store.blobs.put(b"fresh").unwrap();
        assert_eq!(f.left(&["fresh"]).await, [true]);
        drop(fresh);
        assert_eq!(f.left(&["fresh"]).await, [false]);
    }

    #[tokio::test]
    async fn a_file_that_cannot_be_deleted_keeps_no_other_and_goes_when_it_can() {
        let f = Fixture::new().await;
        let texts = ["first", "second", "third"];
        let ids = texts.map(|text| f.blob(text).id);
        // A folder in its place cannot be deleted as a file, whoever the tests run as.
        let stuck = f.store.blobs.path(ids[1]);
        std::fs::remove_file(&stuck).unwrap();
        std::fs::create_dir(&stuck).unwrap();
        f.left(&texts).await;
        let there = || ids.map(|id| f.store.blobs.path(id).exists());
        assert_eq!(there(), [false, true, false]);
        std::fs::remove_dir(&stuck).unwrap();
        std::fs::write(&stuck, "second").unwrap();
        f.left(&texts).await;
        assert_eq!(there(), [false; 3]);
    }

    #[tokio::test]
    async fn an_upload_that_cannot_be_deleted_keeps_nothing_else() {
        let f = Fixture::new().await;
        let stuck = f.store.uploads.path(UploadId::generate());
        std::fs::create_dir(&stuck).unwrap();
        drop(f.blob("unneeded"));
        assert_eq!(f.left(&["unneeded"]).await, [false]);
        assert!(stuck.exists());
    }
}
