//! The workers' side of the job table: claim, renew, give back, move on. What happens when it does not go well is in `setbacks`.
//!
//! A claim is a lease in the row: worker, attempt and a moment after which the worker is taken for dead. The attempt
//! grows with every claim and fences: whoever holds an older one changes nothing any more.

use std::time::Duration;

use sqlx::{Row, Sqlite, Transaction};

use super::job_rows::job;
use super::rows::{count, word};
use super::turns::{NEXT_TO_INGEST, may_be_mapped, next_to_map};
use super::{StorageError, Store};
use crate::project::{Job, JobId, JobKind, Lane, Timestamp};

/// Which claim a worker holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Lease {
    /// The job.
    pub job: JobId,
    /// The attempt that fences it.
    pub attempt: u32,
    /// Jobs that it leads as a batch, without itself.
    pub members: Vec<JobId>,
}

/// A job in a worker's hands.
#[derive(Debug, Clone, PartialEq)]
pub struct Claim {
    /// What every later change must show.
    pub lease: Lease,
    /// The job itself.
    pub job: Job,
    /// Further registrations of the same project that are mapped together with it.
    pub members: Vec<Job>,
    /// Whether a process died or did not end while it was at this job. It may be the cause.
    pub suspect: bool,
}

/// What decoding finds out about a scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measures {
    /// Finite points.
    pub points: u64,
    /// Whether they have colours.
    pub colored: bool,
    /// Diagonal of the box that holds the middle 96 % of each coordinate, metres.
    pub extent: f64,
    /// The resolution at which it alone would best be registered, metres.
    pub scale: f64,
}

/// The revision of a job (?1) that this attempt (?2) holds, and how many members its batch has.
const HELD: &str = "SELECT revision, lease_ms, (SELECT COUNT(*) FROM jobs WHERE leader = ?1 AND state = 'running') AS members FROM jobs
    WHERE id = ?1 AND attempt = ?2 AND worker IS NOT NULL AND state = 'running'";
/// The members of a batch.
const MEMBERS: &str = "SELECT * FROM jobs WHERE leader = ? AND state = 'running' ORDER BY seq";
/// Lets the members of a batch go.
const FREE_MEMBERS: &str = "UPDATE jobs SET leader = NULL WHERE leader = ?";

/// How a claimed job stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Held {
    /// Grows with every change of the job.
    pub revision: u64,
    /// When the claim ends unless it is renewed.
    pub until: Timestamp,
}

impl Store {
    /// Takes up the job of a lane whose turn it is, if any is ready. A registration in the map lane brings up to `batch - 1` others of
    /// its project with it, unless one of them failed before: then each goes alone. Those whose worker died before also go alone,
    /// unless suspects work in a process of their own (`isolated`), where they can do no harm; then suspects go together.
    pub async fn claim(
        &self,
        lane: Lane,
        worker: &str,
        lease: Duration,
        batch: u32,
        isolated: bool,
    ) -> Result<Option<Claim>, StorageError> {
        let now = Timestamp::now();
        let (next, turn) = match lane {
            Lane::Ingest => (NEXT_TO_INGEST.to_owned(), "ingest_turn"),
            Lane::Map => (next_to_map(), "map_turn"),
        };
        let mut tx = self.begin().await?;
        let row = sqlx::query(sqlx::AssertSqlSafe(format!(
            "UPDATE jobs SET state = 'running', worker = ?2, attempt = attempt + 1, lease_ms = ?3,
               started_ms = COALESCE(started_ms, ?1), updated_ms = ?1, revision = revision + 1
             WHERE seq = ({next}) RETURNING *"
        )))
        .bind(now.0)
        .bind(worker)
        .bind(now.plus(lease).0)
        .fetch_optional(&mut *tx)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let leader = job(&row)?;
        sqlx::query(sqlx::AssertSqlSafe(format!("UPDATE projects SET {turn} = ? WHERE id = ?")))
            .bind(now.0)
            .bind(leader.project.to_string())
            .execute(&mut *tx)
            .await?;
        let faults = row.try_get::<i64, _>("tries")? + row.try_get::<i64, _>("crashes")?;
        let lost = row.try_get::<i64, _>("losses")? > 0;
        let together = faults == 0 && (isolated || !lost) && batch > 1;
        let members = if lane == Lane::Map && leader.kind == JobKind::Registration && together {
            join_batch(&mut tx, &leader, lost, now, batch - 1).await?
        } else {
            Vec::new()
        };
        tx.commit().await?;
        let claim = claimed(leader, members, lost || row.try_get::<i64, _>("crashes")? > 0);
        self.announce(claim.lease.all());
        Ok(Some(claim))
    }

    /// What another process has claimed, for the process that works on it. [`StorageError::Fenced`] if it is no longer so.
    pub async fn held(&self, id: JobId, attempt: u32) -> Result<(Lane, Claim), StorageError> {
        let row = sqlx::query(
            "SELECT * FROM jobs WHERE id = ? AND attempt = ? AND worker IS NOT NULL AND state = 'running'",
        )
        .bind(id.to_string())
        .bind(i64::from(attempt))
        .fetch_optional(&self.read)
        .await?
        .ok_or(StorageError::Fenced { job: id, attempt })?;
        let members = sqlx::query(MEMBERS).bind(id.to_string()).fetch_all(&self.read).await?;
        let members = members.iter().map(job).collect::<Result<_, _>>()?;
        let lane =
            word(&row, "lane", |word| [Lane::Ingest, Lane::Map].into_iter().find(|l| l.as_str() == word))?;
        Ok((lane, claimed(job(&row)?, members, true)))
    }

    /// Keeps a claim alive and shows progress. [`StorageError::Fenced`] when the claim is no longer held whole.
    pub async fn renew(
        &self,
        lease: &Lease,
        duration: Duration,
        stage: Option<&str>,
        progress: u8,
    ) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        let mut changed = Vec::new();
        sqlx::query("UPDATE jobs SET lease_ms = ? WHERE id = ?")
            .bind(now.plus(duration).0)
            .bind(lease.job.to_string())
            .execute(&mut *tx)
            .await?;
        for id in lease.all() {
            let done = sqlx::query(
                "UPDATE jobs SET stage = COALESCE(?1, stage), progress = MAX(progress, ?2), updated_ms = ?3,
                   revision = revision + 1
                 WHERE id = ?4 AND (COALESCE(?1, stage) IS NOT stage OR ?2 > progress)",
            )
            .bind(stage)
            .bind(i64::from(progress.min(99)))
            .bind(now.0)
            .bind(id.to_string())
            .execute(&mut *tx)
            .await?;
            if done.rows_affected() > 0 {
                changed.push(id);
            }
        }
        tx.commit().await?;
        self.announce(changed);
        Ok(())
    }

    /// How a job stands that is still held by this claim, with its whole batch; `None` if it is not.
    pub async fn holds(&self, lease: &Lease) -> Result<Option<Held>, StorageError> {
        let row = sqlx::query(HELD)
            .bind(lease.job.to_string())
            .bind(i64::from(lease.attempt))
            .fetch_optional(&self.read)
            .await?;
        let Some(row) = row else { return Ok(None) };
        let whole = row.try_get::<i64, _>("members")? == lease.members.len() as i64;
        let until = Timestamp(row.try_get::<Option<i64>, _>("lease_ms")?.unwrap_or_default());
        Ok(if whole { Some(Held { revision: count(&row, "revision")?, until }) } else { None })
    }

    /// Tells listeners of jobs that another process has changed and still holds: there is nothing new to claim.
    pub fn relay(&self, jobs: impl IntoIterator<Item = JobId>) {
        self.announce(jobs);
    }

    /// Tells listeners of jobs that another process has let go of, ended or moved on, and wakes idle workers.
    pub fn relay_freed(&self, jobs: impl IntoIterator<Item = JobId>) {
        self.announce(jobs);
        self.ring();
    }

    /// Gives a claim back untouched, as at a shutdown. A claim that is no longer held needs no giving back, but
    /// members of its batch may still point at it.
    pub async fn release(&self, lease: &Lease) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        let held = free(&mut tx, lease).await?;
        tx.commit().await?;
        if held {
            self.ring();
        }
        Ok(())
    }

    /// Keeps what decoding has found out about the scan of a registration.
    pub async fn record_measures(&self, lease: &Lease, measures: Measures) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        sqlx::query(
            "UPDATE scans SET points = ?, colored = ?, extent = ?, scale = ? WHERE id = (SELECT scan_id FROM jobs WHERE id = ?)",
        )
        .bind(measures.points.cast_signed())
        .bind(measures.colored)
        .bind(measures.extent)
        .bind(measures.scale)
        .bind(lease.job.to_string())
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(())
    }

    /// Ends the ingest stage of a registration: the scan is prepared and waits for the mapper.
    pub async fn finish_ingest(&self, lease: &Lease) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        sqlx::query(
            "UPDATE jobs SET lane = 'map', worker = NULL, lease_ms = NULL, tries = 0, waits = 0, losses = 0, crashes = 0,
               stage = 'queued',
               updated_ms = ?, revision = revision + 1 WHERE id = ?",
        )
        .bind(now.0)
        .bind(lease.job.to_string())
        .execute(&mut *tx)
        .await?;
        sqlx::query("UPDATE scans SET state = 'ingested' WHERE id = (SELECT scan_id FROM jobs WHERE id = ?)")
            .bind(lease.job.to_string())
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        self.announce([lease.job]);
        self.ring();
        Ok(())
    }
}

impl Lease {
    /// The job and the members of its batch.
    pub fn all(&self) -> impl Iterator<Item = JobId> {
        std::iter::once(self.job).chain(self.members.iter().copied())
    }
}

fn claimed(leader: Job, members: Vec<Job>, suspect: bool) -> Claim {
    let lease =
        Lease { job: leader.id, attempt: leader.attempt, members: members.iter().map(|m| m.id).collect() };
    Claim { lease, job: leader, members, suspect }
}

/// Puts further registrations that are ready under the leader: those that are as suspect as it is (`lost`).
async fn join_batch(
    tx: &mut Transaction<'static, Sqlite>,
    leader: &Job,
    lost: bool,
    now: Timestamp,
    limit: u32,
) -> Result<Vec<Job>, StorageError> {
    let may_be_mapped = may_be_mapped();
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE jobs SET state = 'running', leader = ?2, attempt = attempt + 1,
           started_ms = COALESCE(started_ms, ?1), updated_ms = ?1, revision = revision + 1
         WHERE seq IN (SELECT j.seq FROM jobs j JOIN scans s ON s.id = j.scan_id
                       WHERE j.project_id = ?3 AND j.kind = 'registration' AND {may_be_mapped}
                         AND j.tries = 0 AND j.crashes = 0 AND (j.losses > 0) = ?5 ORDER BY j.seq LIMIT ?4) RETURNING *"
    )))
    .bind(now.0)
    .bind(leader.id.to_string())
    .bind(leader.project.to_string())
    .bind(limit)
    .bind(lost)
    .fetch_all(&mut **tx)
    .await?;
    rows.iter().map(job).collect()
}

/// Whether a lease still holds the job and every member.
pub(super) async fn check(tx: &mut Transaction<'static, Sqlite>, lease: &Lease) -> Result<(), StorageError> {
    let row = sqlx::query(HELD)
        .bind(lease.job.to_string())
        .bind(i64::from(lease.attempt))
        .fetch_optional(&mut **tx)
        .await?;
    match row {
        Some(row) if row.try_get::<i64, _>("members")? == lease.members.len() as i64 => Ok(()),
        _ => Err(StorageError::Fenced { job: lease.job, attempt: lease.attempt }),
    }
}

/// Lets go of a job and its members, if this attempt still holds it.
pub(super) async fn free(tx: &mut Transaction<'static, Sqlite>, lease: &Lease) -> Result<bool, StorageError> {
    let done = sqlx::query(
        "UPDATE jobs SET worker = NULL, lease_ms = NULL WHERE id = ? AND attempt = ? AND worker IS NOT NULL",
    )
    .bind(lease.job.to_string())
    .bind(i64::from(lease.attempt))
    .execute(&mut **tx)
    .await?;
    let held = done.rows_affected() > 0;
    if held {
        free_members(tx, lease.job).await?;
    }
    Ok(held)
}

/// Lets the members of a batch go whose leader nobody holds any more.
pub(super) async fn free_members(
    tx: &mut Transaction<'static, Sqlite>,
    leader: JobId,
) -> Result<(), StorageError> {
    sqlx::query(FREE_MEMBERS).bind(leader.to_string()).execute(&mut **tx).await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::Row as _;

    use super::*;
    use crate::storage::setbacks::STRAYS;
    use crate::storage::testing::Fixture;

    #[tokio::test]
    async fn watching_a_claim_takes_no_longer_the_more_jobs_there_ever_were() {
        let at = Fixture::new().await;
        let removals = format!("SELECT 1 FROM scans s WHERE {}", crate::storage::removals::UNDONE);
        for query in [HELD, MEMBERS, FREE_MEMBERS, STRAYS, &removals, "DELETE FROM jobs WHERE scan_id = ?"] {
            let explained = format!("EXPLAIN QUERY PLAN {query}");
            let rows = sqlx::query(sqlx::AssertSqlSafe(explained)).fetch_all(&at.store.read).await.unwrap();
            for step in rows.iter().map(|row| row.get::<String, _>("detail")) {
                let narrow = step.starts_with("SEARCH")
                    || ["jobs_of_leader", "scans_to_be_forgotten"].iter().any(|index| step.contains(index));
                assert!(narrow || step.contains("SUBQUERY"), "{query}: {step}");
            }
        }
    }
}
