//! Rows of jobs as clients see them: made, listed, dismissed. Workers' side of the table is in `claims`.

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, Sqlite, Transaction};

use super::claims::free_members;
use super::quotas::Addition;
use super::rows::{count, json, parsed, word};
use super::{Page, Seal, StorageError, Store};
use crate::project::{Job, JobId, JobKind, JobState, KeyId, Lane, ProjectId, ScanId, Timestamp};

/// Which jobs to list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct JobFilter {
    /// Only those in this state.
    pub state: Option<JobState>,
    /// Only those of this kind.
    pub kind: Option<JobKind>,
}

impl Store {
    /// Accepts a job on a project's model, asked for with a key, and keeps the answer to the request for it.
    pub async fn create_job(
        &self,
        project: ProjectId,
        kind: JobKind,
        key: Option<KeyId>,
        seal: Seal<'_, Job>,
    ) -> Result<Job, StorageError> {
        let id = JobId::generate();
        let mut tx = self.begin().await?;
        let known = sqlx::query("SELECT 1 FROM projects WHERE id = ?")
            .bind(project.to_string())
            .fetch_optional(&mut *tx)
            .await?;
        if known.is_none() {
            return Err(StorageError::NoProject(project));
        }
        self.check_quotas(&mut tx, project, key, Addition { jobs: 1, ..Addition::default() }).await?;
        insert_job(&mut tx, id, project, None, kind, Lane::Map, Timestamp::now()).await?;
        charge_job(&mut tx, id, key).await?;
        let made = made(&mut tx, id).await?;
        seal.set(&mut tx, &made).await?;
        tx.commit().await?;
        self.announce([id]);
        self.ring();
        Ok(made)
    }

    /// One job.
    pub async fn job(&self, id: JobId) -> Result<Job, StorageError> {
        let row = sqlx::query("SELECT * FROM jobs WHERE id = ?")
            .bind(id.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(job).transpose()?.ok_or(StorageError::NoJob(id))
    }

    /// Jobs of a project, oldest first, each with its position in the list.
    pub async fn jobs(
        &self,
        project: ProjectId,
        filter: JobFilter,
        page: Page,
    ) -> Result<Vec<(i64, Job)>, StorageError> {
        let rows = sqlx::query(
            "SELECT * FROM jobs WHERE project_id = ?1 AND seq > ?2 AND (?3 IS NULL OR state = ?3)
               AND (?4 IS NULL OR kind = ?4) ORDER BY seq LIMIT ?5",
        )
        .bind(project.to_string())
        .bind(page.after.unwrap_or(0))
        .bind(filter.state.map(JobState::as_str))
        .bind(filter.kind.map(JobKind::as_str))
        .bind(page.limit)
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(|row| Ok((row.try_get("seq")?, job(row)?))).collect()
    }

    /// Dismisses a job that has not ended; what was deleted or decided stays so, and the model has to follow. Its worker, if any, finds that it no longer holds it. A scan whose
    /// registration is dismissed stays, unregistered.
    pub async fn dismiss_job(&self, id: JobId) -> Result<Job, StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        let done = sqlx::query(
            "UPDATE jobs SET state = 'dismissed', worker = NULL, leader = NULL, finished_ms = ?1, updated_ms = ?1,
               revision = revision + 1 WHERE id = ?2 AND state IN ('accepted', 'running') AND kind NOT IN ('removal', 'decision')",
        )
        .bind(now.0)
        .bind(id.to_string())
        .execute(&mut *tx)
        .await?;
        sqlx::query(
            "UPDATE scans SET state = 'dismissed' WHERE job_id = ?1 AND state IN ('received', 'ingested')
               AND EXISTS (SELECT 1 FROM jobs WHERE id = ?1 AND state = 'dismissed')",
        )
        .bind(id.to_string())
        .execute(&mut *tx)
        .await?;
        // Members of a batch that lost its leader are free again.
        free_members(&mut tx, id).await?;
        tx.commit().await?;
        let job = self.job(id).await?;
        if done.rows_affected() == 0 {
            return Err(StorageError::JobEnded(id));
        }
        self.announce([id]);
        self.ring();
        Ok(job)
    }
}

pub(super) async fn insert_job(
    tx: &mut Transaction<'static, Sqlite>,
    id: JobId,
    project: ProjectId,
    scan: Option<ScanId>,
    kind: JobKind,
    lane: Lane,
    now: Timestamp,
) -> Result<(), StorageError> {
    sqlx::query(
        "INSERT INTO jobs (id, project_id, scan_id, kind, lane, state, created_ms, updated_ms)
           VALUES (?, ?, ?, ?, ?, 'accepted', ?, ?)",
    )
    .bind(id.to_string())
    .bind(project.to_string())
    .bind(scan.map(|s| s.to_string()))
    .bind(kind.as_str())
    .bind(lane.as_str())
    .bind(now.0)
    .bind(now.0)
    .execute(&mut **tx)
    .await?;
    Ok(())
}

/// A job as the transaction has made it.
pub(super) async fn made(tx: &mut Transaction<'static, Sqlite>, id: JobId) -> Result<Job, StorageError> {
    job(&sqlx::query("SELECT * FROM jobs WHERE id = ?").bind(id.to_string()).fetch_one(&mut **tx).await?)
}

/// Notes on whose account a job is.
pub(super) async fn charge_job(
    tx: &mut Transaction<'static, Sqlite>,
    id: JobId,
    key: Option<KeyId>,
) -> Result<(), StorageError> {
    if let Some(key) = key {
        sqlx::query("UPDATE jobs SET key_id = ? WHERE id = ?")
            .bind(key.to_string())
            .bind(id.to_string())
            .execute(&mut **tx)
            .await?;
    }
    Ok(())
}

pub(super) fn job(row: &SqliteRow) -> Result<Job, StorageError> {
    let scan = match row.try_get::<Option<String>, _>("scan_id")? {
        Some(_) => Some(parsed::<ScanId>(row, "scan_id")?),
        None => None,
    };
    Ok(Job {
        id: parsed(row, "id")?,
        project: parsed(row, "project_id")?,
        scan,
        kind: parsed(row, "kind")?,
        state: word(row, "state", JobState::from_word)?,
        stage: row.try_get("stage")?,
        progress: count(row, "progress")?,
        attempt: count(row, "attempt")?,
        outcome: json(row, "outcome")?,
        fault: json(row, "fault")?,
        revision: count(row, "revision")?,
        created: Timestamp(row.try_get("created_ms")?),
        started: row.try_get::<Option<i64>, _>("started_ms")?.map(Timestamp),
        finished: row.try_get::<Option<i64>, _>("finished_ms")?.map(Timestamp),
        updated: Timestamp(row.try_get("updated_ms")?),
    })
}
