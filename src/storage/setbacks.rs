//! What becomes of jobs that do not end well: failures that pass are tried again, ever later; a job that is the cause ends, and says
//! why, so that it cannot hold up its project.

use std::time::Duration;

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, Sqlite, Transaction};

use super::claims::{check, free};
use super::rows::{count, parsed, to_json};
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

/// A claim whose lease has run out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Overdue {
    job: JobId,
    attempt: u32,
    /// When it ran out; renewing it changes this.
    lease_ms: i64,
}

/// How often a job may fail for reasons that may pass.
const MAX_TRIES: i64 = 3;
/// How often a process that did nothing else may die of a job, or not end in time.
const MAX_CRASHES: i64 = 3;
/// How often the service may die while it is at a job alone, where jobs have no process of their own.
const MAX_LOSSES: i64 = 8;

/// Lets go of all members of batches whose leaders nobody holds.
pub(super) const STRAYS: &str = "UPDATE jobs SET leader = NULL WHERE leader IS NOT NULL AND NOT EXISTS
    (SELECT 1 FROM jobs l WHERE l.id = jobs.leader AND l.worker IS NOT NULL)";

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
            wait_until(&mut tx, lease.job, until).await?;
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
        count_against(&mut tx, lease, fault, counter, most, now).await?;
        tx.commit().await?;
        self.announce(lease.all());
        self.ring();
        Ok(())
    }

    /// Takes all claims back, at the start of the process: nobody can hold one then. Returns how many. Where suspects get a process of
    /// their own (`isolated`), it is that process whose death counts against a job, and not this one's, of which the job may be quite
    /// innocent.
    pub async fn reclaim(&self, isolated: bool) -> Result<usize, StorageError> {
        let mut tx = self.begin().await?;
        let held = sqlx::query("SELECT id FROM jobs WHERE worker IS NOT NULL").fetch_all(&mut *tx).await?;
        let held = held.iter().map(|row| parsed(row, "id")).collect::<Result<Vec<JobId>, _>>()?;
        for id in &held {
            lose(&mut tx, *id, isolated).await?;
        }
        self.reclaimed(tx, held).await
    }

    /// Claims whose lease has run out.
    pub async fn overdue(&self) -> Result<Vec<Overdue>, StorageError> {
        let rows =
            sqlx::query("SELECT id, attempt, lease_ms FROM jobs WHERE worker IS NOT NULL AND lease_ms < ?")
                .bind(Timestamp::now().0)
                .fetch_all(&self.read)
                .await?;
        let overdue = |row: &SqliteRow| {
            Ok(Overdue {
                job: parsed(row, "id")?,
                attempt: count(row, "attempt")?,
                lease_ms: row.try_get("lease_ms")?,
            })
        };
        rows.iter().map(overdue).collect()
    }

    /// Takes claims back that were overdue when somebody looked, and that nobody has renewed since. Returns how many. Their workers have
    /// fallen silent while this process lives: where jobs have processes of their own (`isolated`), that counts against a job as a
    /// crash does.
    pub async fn reclaim_silent(&self, silent: &[Overdue], isolated: bool) -> Result<usize, StorageError> {
        if silent.is_empty() {
            return Ok(0);
        }
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        let mut changed = Vec::new();
        for Overdue { job, attempt, lease_ms } in silent {
            let same = sqlx::query(
                "SELECT 1 FROM jobs WHERE id = ? AND attempt = ? AND lease_ms = ? AND worker IS NOT NULL",
            )
            .bind(job.to_string())
            .bind(i64::from(*attempt))
            .bind(lease_ms)
            .fetch_optional(&mut *tx)
            .await?;
            if same.is_none() {
                continue;
            }
            if isolated {
                let members = sqlx::query("SELECT id FROM jobs WHERE leader = ?").bind(job.to_string());
                let members = members.fetch_all(&mut *tx).await?;
                let members = members.iter().map(|row| parsed(row, "id")).collect::<Result<_, _>>()?;
                let lease = Lease { job: *job, attempt: *attempt, members };
                free(&mut tx, &lease).await?;
                count_against(&mut tx, &lease, &fell_silent(), "crashes", MAX_CRASHES, now).await?;
                changed.extend(lease.all());
            } else {
                lose(&mut tx, *job, false).await?;
                changed.push(*job);
            }
        }
        self.reclaimed(tx, changed).await
    }

    async fn reclaimed(
        &self,
        mut tx: Transaction<'static, Sqlite>,
        jobs: Vec<JobId>,
    ) -> Result<usize, StorageError> {
        // Members must never wait for a leader that nobody holds.
        sqlx::query(STRAYS).execute(&mut *tx).await?;
        tx.commit().await?;
        let n = jobs.len();
        self.announce(jobs);
        if n > 0 {
            self.ring();
        }
        Ok(n)
    }
}

/// Takes a claim back whose worker is dead. It is a loss for the job and its batch, and too many of them end a job that was alone, unless
/// suspects get a process of their own (`isolated`).
async fn lose(tx: &mut Transaction<'static, Sqlite>, id: JobId, isolated: bool) -> Result<(), StorageError> {
    let now = Timestamp::now();
    let members = sqlx::query("UPDATE jobs SET leader = NULL, losses = losses + 1 WHERE leader = ?")
        .bind(id.to_string())
        .execute(&mut **tx)
        .await?
        .rows_affected();
    let row = sqlx::query(
        "UPDATE jobs SET worker = NULL, lease_ms = NULL, losses = losses + 1 WHERE id = ? RETURNING losses",
    )
    .bind(id.to_string())
    .fetch_one(&mut **tx)
    .await?;
    let losses: i64 = row.try_get("losses")?;
    let wait = if losses > 2 && !isolated { backoff(losses - 1) } else { Duration::ZERO };
    wait_until(tx, id, now.plus(wait)).await?;
    if members == 0 && !isolated && losses >= MAX_LOSSES {
        let detail = format!("its worker died {losses} times while it was at this job");
        end_failed(tx, id, &Fault { code: "worker-lost".to_owned(), detail }, now).await?;
    }
    Ok(())
}

/// Counts a failure against a job that nobody holds any more, or against each of a batch. One that was alone ends when it has failed
/// `most` times, and otherwise waits.
async fn count_against(
    tx: &mut Transaction<'static, Sqlite>,
    lease: &Lease,
    fault: &Fault,
    counter: &'static str,
    most: i64,
    now: Timestamp,
) -> Result<(), StorageError> {
    let alone = lease.members.is_empty();
    for id in lease.all() {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!(
            "UPDATE jobs SET {counter} = {counter} + 1 WHERE id = ? RETURNING {counter} AS n"
        )))
        .bind(id.to_string())
        .fetch_one(&mut **tx)
        .await?;
        let n: i64 = row.try_get("n")?;
        if alone && n >= most {
            end_failed(tx, id, fault, now).await?;
        } else if alone {
            wait_until(tx, id, now.plus(backoff(n))).await?;
        }
    }
    Ok(())
}

async fn wait_until(
    tx: &mut Transaction<'static, Sqlite>,
    id: JobId,
    until: Timestamp,
) -> Result<(), StorageError> {
    sqlx::query("UPDATE jobs SET not_before_ms = ? WHERE id = ?")
        .bind(until.0)
        .bind(id.to_string())
        .execute(&mut **tx)
        .await?;
    Ok(())
}

/// Why a job fails whose process lives and does nothing.
fn fell_silent() -> Fault {
    let detail = "the process that worked on it alone fell silent for longer than its lease, again and again"
        .to_owned();
    Fault { code: "worker-lost".to_owned(), detail }
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
