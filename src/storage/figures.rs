//! Counts over the whole data directory, for an operator's eyes, and whether it can be written.

use sqlx::Row;

use super::rows::{count, parsed, word};
use super::{StorageError, Store};
use crate::project::{JobId, JobKind, JobState, Lane, Timestamp};

/// How much there is of what.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Figures {
    /// Jobs that wait or run, by lane and state.
    pub jobs: Vec<(Lane, JobState, u64)>,
    /// Scans that were not deleted, by state.
    pub scans: Vec<(String, u64)>,
    /// Bytes of their uploads.
    pub scan_bytes: u64,
    /// Projects.
    pub projects: u64,
    /// Projects whose model is not empty.
    pub models: u64,
    /// Versions of models that can be read.
    pub versions: u64,
    /// Messages to webhooks that wait to be sent.
    pub deliveries: u64,
    /// Resumable uploads that are neither complete nor expired.
    pub open_uploads: u64,
    /// Bytes of them that have come.
    pub open_upload_bytes: u64,
}

/// A job that has ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EndedJob {
    /// The job.
    pub id: JobId,
    /// What it did.
    pub kind: JobKind,
    /// How it ended.
    pub state: JobState,
    /// When it was accepted.
    pub created: Timestamp,
    /// When a worker took it up first, if one did.
    pub started: Option<Timestamp>,
    /// When it ended.
    pub finished: Timestamp,
}

impl Store {
    /// How much there is of what, now.
    pub async fn figures(&self) -> Result<Figures, StorageError> {
        let jobs = sqlx::query(
            "SELECT lane, state, COUNT(*) AS n FROM jobs WHERE state IN ('accepted', 'running') GROUP BY lane, state",
        )
        .fetch_all(&self.read)
        .await?;
        let scans = sqlx::query(
            "SELECT state, COUNT(*) AS n, SUM(bytes) AS bytes FROM scans WHERE deleted_ms IS NULL GROUP BY state",
        )
        .fetch_all(&self.read)
        .await?;
        let rest = sqlx::query(
            "SELECT (SELECT COUNT(*) FROM projects) AS projects, (SELECT COUNT(*) FROM projects WHERE head > 0) AS models,
               (SELECT COUNT(*) FROM versions) AS versions,
               (SELECT COUNT(*) FROM deliveries WHERE state = 'pending') AS deliveries,
               u.n AS open_uploads, u.bytes AS open_upload_bytes
               FROM (SELECT COUNT(*) AS n, COALESCE(SUM(received), 0) AS bytes FROM uploads
                     WHERE scan_id IS NULL AND expires_ms > ?) u",
        )
        .bind(Timestamp::now().0)
        .fetch_one(&self.read)
        .await?;
        let mut figures = Figures {
            projects: count(&rest, "projects")?,
            models: count(&rest, "models")?,
            versions: count(&rest, "versions")?,
            deliveries: count(&rest, "deliveries")?,
            open_uploads: count(&rest, "open_uploads")?,
            open_upload_bytes: count(&rest, "open_upload_bytes")?,
            ..Figures::default()
        };
        for row in &jobs {
            let lane = word(row, "lane", Lane::from_word)?;
            figures.jobs.push((lane, word(row, "state", JobState::from_word)?, count(row, "n")?));
        }
        for row in &scans {
            figures.scans.push((row.try_get("state")?, count(row, "n")?));
            figures.scan_bytes += count::<u64>(row, "bytes")?;
        }
        Ok(figures)
    }

    /// Jobs that have ended since a moment, the first to end first, at most `limit`.
    pub async fn jobs_ended_since(
        &self,
        since: Timestamp,
        limit: u32,
    ) -> Result<Vec<EndedJob>, StorageError> {
        let rows = sqlx::query(
            "SELECT id, kind, state, created_ms, started_ms, finished_ms FROM jobs
               WHERE finished_ms IS NOT NULL AND finished_ms >= ? ORDER BY finished_ms, id LIMIT ?",
        )
        .bind(since.0)
        .bind(limit)
        .fetch_all(&self.read)
        .await?;
        let ended = rows.iter().map(|row| {
            Ok(EndedJob {
                id: parsed(row, "id")?,
                kind: parsed(row, "kind")?,
                state: word(row, "state", JobState::from_word)?,
                created: Timestamp(row.try_get("created_ms")?),
                started: row.try_get::<Option<i64>, _>("started_ms")?.map(Timestamp),
                finished: Timestamp(row.try_get("finished_ms")?),
            })
        });
        ended.collect()
    }

    /// Commits a small change, as everything does that is acknowledged: fails if that cannot be done.
    pub async fn probe(&self) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query("INSERT INTO probe (id, at_ms) VALUES (1, ?1) ON CONFLICT (id) DO UPDATE SET at_ms = ?1")
            .bind(Timestamp::now().0)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(())
    }
}
