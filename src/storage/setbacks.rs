//! What becomes of jobs that do not end well: failures that pass are tried again, ever later; a job that is the cause ends, and says
//! why, so that it cannot hold up its project.

use std::time::Duration;

use sqlx::{Row, Sqlite, Transaction};

use super::claims::{check, free};
use super::rows::{parsed, to_json};
use super::{Lease, StorageError, Store};
use crate::project::{Fault, JobId, Standing, Timestamp};

/// Whether a job that failed is tried again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Retry {
    /// Every attempt would meet the same.
    Never,
    /// It may pass, or be a fault of the job.
    AFewTimes,
    /// It is not the job's doing, such as a full disk: until it passes.
    UntilItPasses,
}

/// How often a job may fail for reasons that may pass.
const MAX_TRIES: i64 = 3;
/// How often a process that did nothing else may die of a job, or not end in time.
const MAX_CRASHES: i64 = 3;
/// How often the service may die while it is at a job alone, where jobs have no process of their own.
const MAX_LOSSES: i64 = 8;

/// How long the n-th retry waits.
fn backoff(n: i64) -> Duration {
    Duration::from_millis(500 << n.clamp(0, 6))
}

impl Store {
    /// Ends a job with a fault. If it may pass, the job goes back to its queue first, and members of its batch go back at once, each
    /// to be tried alone. What is not their doing counts against none of them: they wait together.
    pub async fn fail(&self, lease: &Lease, fault: &Fault, retry: Retry) -> Result<(), StorageError> {
        match retry {
            Retry::Never => self.set_back(lease, fault, "tries", 0).await,
            Retry::AFewTimes => self.set_back(lease, fault, "tries", MAX_TRIES).await,
            Retry::UntilItPasses => self.put_off(lease).await,
        }
    }

    /// The process that did nothing but this job has died, or did not end in time. A batch is tried again one by one; a job that was
    /// alone is the cause, and ends when it has done this a few times.
    pub async fn crashed(&self, lease: &Lease, fault: &Fault) -> Result<(), StorageError> {
        self.set_back(lease, fault, "crashes", MAX_CRASHES).await
    }

    /// Gives a claim back for a moment: its process could not begin.
    pub async fn postpone(&self, lease: &Lease) -> Result<(), StorageError> {
        let until = Timestamp::now().plus(Duration::from_secs(1));
        let mut tx = self.begin().await?;
        if free(&mut tx, lease).await? {
            sqlx::query("UPDATE jobs SET not_before_ms = ? WHERE id = ?")
                .bind(until.0)
                .bind(lease.job.to_string())
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        Ok(())
    }

    /// Gives a claim back until what is in its way may have passed, ever later.
    async fn put_off(&self, lease: &Lease) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        free(&mut tx, lease).await?;
        let row = sqlx::query("SELECT waits FROM jobs WHERE id = ?").bind(lease.job.to_string());
        let until = now.plus(backoff(row.fetch_one(&mut *tx).await?.try_get::<i64, _>("waits")? + 1));
        for id in lease.all() {
            sqlx::query("UPDATE jobs SET waits = waits + 1, not_before_ms = ? WHERE id = ?")
                .bind(until.0)
                .bind(id.to_string())
                .execute(&mut *tx)
                .await?;
        }
        tx.commit().await?;
        self.announce(lease.all());
        self.ring();
        Ok(())
    }

    async fn set_back(
        &self,
        lease: &Lease,
        fault: &Fault,
        counter: &'static str,
        most: i64,
    ) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        free(&mut tx, lease).await?;
        let alone = lease.members.is_empty();
        for id in lease.all() {
            let row = sqlx::query(sqlx::AssertSqlSafe(format!(
                "UPDATE jobs SET {counter} = {counter} + 1 WHERE id = ? RETURNING {counter} AS n"
            )))
            .bind(id.to_string())
            .fetch_one(&mut *tx)
            .await?;
            let n: i64 = row.try_get("n")?;
            if alone && n >= most {
                end_failed(&mut tx, id, fault, now).await?;
            } else if alone {
                sqlx::query("UPDATE jobs SET not_before_ms = ? WHERE id = ?")
                    .bind(now.plus(backoff(n)).0)
                    .bind(id.to_string())
                    .execute(&mut *tx)
                    .await?;
            }
        }
        tx.commit().await?;
        self.announce(lease.all());
        self.ring();
        Ok(())
    }

    /// Takes claims back whose worker is dead: `all` of them at the start of the process (nobody can hold one then), and later those
    /// whose lease ran out. Returns how many. Where suspects get a process of their own (`isolated`), it is that process whose death
    /// counts against a job, and not this one's, of which the job may be quite innocent.
    pub async fn reclaim(&self, all: bool, isolated: bool) -> Result<usize, StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        let rows = sqlx::query(
            "SELECT id, losses, (SELECT COUNT(*) FROM jobs m WHERE m.leader = jobs.id) AS members FROM jobs
               WHERE worker IS NOT NULL AND (?1 OR lease_ms < ?2)",
        )
        .bind(all)
        .bind(now.0)
        .fetch_all(&mut *tx)
        .await?;
        let mut changed = Vec::new();
        for row in &rows {
            let id: JobId = parsed(row, "id")?;
            let losses = row.try_get::<i64, _>("losses")? + 1;
            let alone = row.try_get::<i64, _>("members")? == 0;
            let wait = if losses > 2 && !isolated { backoff(losses - 1) } else { Duration::ZERO };
            sqlx::query(
                "UPDATE jobs SET worker = NULL, lease_ms = NULL, losses = losses + 1, not_before_ms = ?2 WHERE id = ?1",
            )
            .bind(id.to_string())
            .bind(now.plus(wait).0)
            .execute(&mut *tx)
            .await?;
            sqlx::query("UPDATE jobs SET leader = NULL, losses = losses + 1 WHERE leader = ?")
                .bind(id.to_string())
                .execute(&mut *tx)
                .await?;
            if alone && !isolated && losses >= MAX_LOSSES {
                let detail = format!("its worker died {losses} times while it was at this job");
                end_failed(&mut tx, id, &Fault { code: "worker-lost".to_owned(), detail }, now).await?;
            }
            changed.push(id);
        }
        // Members must never wait for a leader that nobody holds.
        sqlx::query(
            "UPDATE jobs SET leader = NULL WHERE leader IS NOT NULL AND NOT EXISTS
               (SELECT 1 FROM jobs l WHERE l.id = jobs.leader AND l.worker IS NOT NULL)",
        )
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        let n = changed.len();
        self.announce(changed);
        if n > 0 {
            self.ring();
        }
        Ok(n)
    }
}

/// Puts a job, and the scan that it would have registered, into their failed states.
async fn end_failed(
    tx: &mut Transaction<'static, Sqlite>,
    id: JobId,
    fault: &Fault,
    now: Timestamp,
) -> Result<(), StorageError> {
    sqlx::query(
        "UPDATE jobs SET state = 'failed', fault = ?1, worker = NULL, leader = NULL, finished_ms = ?2, updated_ms = ?2,
           revision = revision + 1 WHERE id = ?3 AND state IN ('accepted', 'running')",
    )
    .bind(to_json(fault)?)
    .bind(now.0)
    .bind(id.to_string())
    .execute(&mut **tx)
    .await?;
    sqlx::query(
        "UPDATE scans SET state = 'failed', standing = ?1 WHERE job_id = ?2 AND state IN ('received', 'ingested')",
    )
    .bind(to_json(&Standing::Failed(fault.clone()))?)
    .bind(id.to_string())
    .execute(&mut **tx)
    .await?;
    Ok(())
}
