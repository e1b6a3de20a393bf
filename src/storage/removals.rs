//! Deleted scans until the model holds them no more: what is let go of then, and those whose removal came to nothing.
//!
//! A deletion is acknowledged before the model follows. If the job that is to see to it fails, whatever changes the model next leaves the
//! scan out (`Session` in `jobs`), and another job is made from time to time for projects where nothing else does.

use sqlx::{Row, Sqlite, Transaction};

use super::job_rows::insert_job;
use super::rows::parsed;
use super::{StorageError, Store};
use crate::project::{JobId, JobKind, Lane, ProjectId, ScanId, Timestamp};

/// The SQL condition that a scan `s` was deleted, is not forgotten, and no job is to see to it.
pub(super) const UNDONE: &str = "s.deleted_ms IS NOT NULL AND s.forgotten_ms IS NULL AND NOT EXISTS
    (SELECT 1 FROM jobs r WHERE r.scan_id = s.id AND r.kind = 'removal' AND r.state IN ('accepted', 'running'))";

impl Store {
    /// Deleted scans that the model may still hold although their removals have ended. Whatever publishes next leaves them out.
    pub async fn undone_removals(&self, project: ProjectId) -> Result<Vec<ScanId>, StorageError> {
        let query = format!("SELECT s.id FROM scans s WHERE s.project_id = ? AND {UNDONE}");
        let rows =
            sqlx::query(sqlx::AssertSqlSafe(query)).bind(project.to_string()).fetch_all(&self.read).await?;
        rows.iter().map(|row| parsed(row, "id")).collect()
    }

    /// Makes another job for each deletion, in any project, whose job failed. Returns how many.
    pub async fn queue_removals(&self) -> Result<usize, StorageError> {
        let now = Timestamp::now();
        let query = format!("SELECT s.id, s.project_id FROM scans s WHERE {UNDONE} ORDER BY s.rowid");
        let mut tx = self.begin().await?;
        let undone = sqlx::query(sqlx::AssertSqlSafe(query)).fetch_all(&mut *tx).await?;
        let mut jobs = Vec::with_capacity(undone.len());
        for row in &undone {
            let (job, project) = (JobId::generate(), parsed(row, "project_id")?);
            insert_job(&mut tx, job, project, Some(parsed(row, "id")?), JobKind::Removal, Lane::Map, now)
                .await?;
            jobs.push(job);
        }
        tx.commit().await?;
        if !jobs.is_empty() {
            self.announce(jobs);
            self.ring();
        }
        Ok(undone.len())
    }
}

/// Lets go of all that was kept for a deleted scan: the model holds it no more. Merged clouds and pictures of the project go too, because
/// older versions show it. Pairs stay if the same content came again and is in the model.
pub(super) async fn forget(
    tx: &mut Transaction<'static, Sqlite>,
    scan: ScanId,
    project: &str,
    now: Timestamp,
) -> Result<(), StorageError> {
    let scan = scan.to_string();
    let known = sqlx::query(
        "UPDATE scans SET forgotten_ms = COALESCE(forgotten_ms, ?) WHERE id = ? AND deleted_ms IS NOT NULL RETURNING content_key",
    )
    .bind(now.0)
    .bind(&scan)
    .fetch_optional(&mut **tx)
    .await?;
    let Some(row) = known else { return Ok(()) };
    sqlx::query("DELETE FROM derived WHERE project_id = ?1 AND (scan_id IS NULL OR scan_id = ?2)")
        .bind(project)
        .bind(&scan)
        .execute(&mut **tx)
        .await?;
    sqlx::query(
        "DELETE FROM pairs WHERE project_id = ?1 AND ?2 IN (a, b)
           AND NOT EXISTS (SELECT 1 FROM scans WHERE project_id = ?1 AND content_key = ?2 AND deleted_ms IS NULL
                           AND state IN ('registered', 'waiting'))",
    )
    .bind(project)
    .bind(row.try_get::<Vec<u8>, _>("content_key")?)
    .execute(&mut **tx)
    .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use serde_json::json;

    use crate::project::{Fault, JobKind, Lane, VersionNumber};
    use crate::storage::testing::{Fixture, new_scan};
    use crate::storage::{Claim, Publication, Retry};

    impl Fixture {
        async fn mapped(&self) -> Claim {
            self.store.claim(Lane::Map, "worker", Duration::from_mins(1), 1, false).await.unwrap().unwrap()
        }
    }

    #[tokio::test]
    async fn a_deletion_whose_job_failed_is_neither_forgotten_nor_left_undone() {
        let at = Fixture::new().await;
        let blob = at.blob("upload");
        let scan = at.store.admit_scan(&new_scan(at.project, 1, *blob)).await.unwrap().scan.id;
        drop(blob);
        at.store.delete_scan(at.project, scan).await.unwrap();
        assert!(at.store.undone_removals(at.project).await.unwrap().is_empty(), "a job is to see to it");
        let fault = Fault { code: "internal-error".to_owned(), detail: "for the test".to_owned() };
        at.store.fail(&at.mapped().await.lease, &fault, Retry::Never).await.unwrap();
        assert_eq!(at.store.undone_removals(at.project).await.unwrap(), [scan]);
        assert_eq!(at.store.queue_removals().await.unwrap(), 1);
        assert_eq!(at.store.queue_removals().await.unwrap(), 0, "one job is enough");
        let again = at.mapped().await;
        assert_eq!((again.job.kind, again.job.scan), (JobKind::Removal, Some(scan)));
        let publication = Publication {
            project: at.project,
            kind: JobKind::Removal,
            from: VersionNumber::EMPTY,
            version: None,
            pairs: Vec::new(),
            engine: "test".to_owned(),
            scans: Vec::new(),
            forgotten: vec![scan],
            outcomes: vec![(again.job.id, Ok(json!({})))],
        };
        at.store.publish(&again.lease, &publication).await.unwrap();
        assert!(at.store.undone_removals(at.project).await.unwrap().is_empty());
        assert_eq!(at.store.collect_garbage(Duration::ZERO).await.unwrap(), 1, "its upload goes");
    }
}
