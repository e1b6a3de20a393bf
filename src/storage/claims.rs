//! The workers' side of the job table: claim, renew, give back, move on, fail.
//!
//! A claim is a lease in the row: worker, attempt and a moment after which the worker is taken for dead. The attempt
//! grows with every claim and fences: whoever holds an older one changes nothing any more.

use std::time::Duration;

use sqlx::{Row, Sqlite, Transaction};

use super::job_rows::job;
use super::rows::{parsed, to_json};
use super::{StorageError, Store};
use crate::project::{Fault, Job, JobId, JobKind, Lane, Timestamp};

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

/// How often a job may fail for reasons that may pass.
const MAX_TRIES: i64 = 3;
/// How often a job's worker may die while it is alone with it: then the job is taken for the cause.
const MAX_LOSSES: i64 = 8;

/// The oldest job that may be mapped now. Mapping is serial in a project. A registration waits for removals before
/// it, and, from the ninth scan on, until the first eight are decoded, because these decide the resolution. What
/// works on the whole model waits for everything that was accepted before it.
const READY_TO_MAP: &str = "
    SELECT j.seq FROM jobs j LEFT JOIN scans s ON s.id = j.scan_id
    WHERE j.lane = 'map' AND j.state IN ('accepted', 'running') AND j.worker IS NULL AND j.leader IS NULL
      AND j.not_before_ms <= ?1
      AND NOT EXISTS (SELECT 1 FROM jobs h
                      WHERE h.project_id = j.project_id AND h.lane = 'map' AND h.worker IS NOT NULL)
      AND CASE j.kind
        WHEN 'removal' THEN 1
        WHEN 'registration' THEN
          NOT EXISTS (SELECT 1 FROM jobs r WHERE r.project_id = j.project_id AND r.kind = 'removal'
                      AND r.state IN ('accepted', 'running') AND r.seq < j.seq)
          AND NOT EXISTS (SELECT 1 FROM jobs i JOIN scans f ON f.id = i.scan_id
                      WHERE i.project_id = j.project_id AND i.lane = 'ingest' AND i.state IN ('accepted', 'running')
                      AND f.arrival < s.arrival
                      AND 8 > (SELECT COUNT(*) FROM scans e WHERE e.project_id = j.project_id
                               AND e.arrival < f.arrival AND e.deleted_ms IS NULL
                               AND e.state NOT IN ('failed', 'dismissed'))
                      AND 8 <= (SELECT COUNT(*) FROM scans e WHERE e.project_id = j.project_id
                               AND e.arrival < s.arrival AND e.deleted_ms IS NULL
                               AND e.state NOT IN ('failed', 'dismissed')))
        ELSE NOT EXISTS (SELECT 1 FROM jobs e WHERE e.project_id = j.project_id
                         AND e.state IN ('accepted', 'running') AND e.seq < j.seq)
      END
    ORDER BY j.seq";

const READY_TO_INGEST: &str = "
    SELECT j.seq FROM jobs j
    WHERE j.lane = 'ingest' AND j.state IN ('accepted', 'running') AND j.worker IS NULL AND j.not_before_ms <= ?1
    ORDER BY j.seq";

impl Store {
    /// Takes up the oldest job of a lane that is ready, if any. A registration in the map lane brings up to `batch - 1`
    /// others of its project with it, unless one of them has failed or lost a worker before: then each goes alone.
    pub async fn claim(
        &self,
        lane: Lane,
        worker: &str,
        lease: Duration,
        batch: u32,
    ) -> Result<Option<Claim>, StorageError> {
        let now = Timestamp::now();
        let ready = match lane {
            Lane::Ingest => READY_TO_INGEST,
            Lane::Map => READY_TO_MAP,
        };
        let mut tx = self.begin().await?;
        let row = sqlx::query(sqlx::AssertSqlSafe(format!(
            "UPDATE jobs SET state = 'running', worker = ?2, attempt = attempt + 1, lease_ms = ?3,
               started_ms = COALESCE(started_ms, ?1), updated_ms = ?1, revision = revision + 1
             WHERE seq = ({ready} LIMIT 1) RETURNING *"
        )))
        .bind(now.0)
        .bind(worker)
        .bind(now.plus(lease).0)
        .fetch_optional(&mut *tx)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let leader = job(&row)?;
        let fresh = row.try_get::<i64, _>("tries")? == 0 && row.try_get::<i64, _>("losses")? == 0;
        let members = if lane == Lane::Map && leader.kind == JobKind::Registration && fresh && batch > 1 {
            join_batch(&mut tx, &leader, now, batch - 1).await?
        } else {
            Vec::new()
        };
        tx.commit().await?;
        let lease = Lease {
            job: leader.id,
            attempt: leader.attempt,
            members: members.iter().map(|m| m.id).collect(),
        };
        self.announce(lease.all());
        Ok(Some(Claim { lease, job: leader, members }))
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
            "UPDATE jobs SET lane = 'map', worker = NULL, lease_ms = NULL, tries = 0, losses = 0, stage = 'queued',
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

    /// Ends a job with a fault. If it may pass (`retry`) the job goes back to its queue a few times first, and
    /// members of its batch go back at once, each to be tried alone.
    pub async fn fail(&self, lease: &Lease, fault: &Fault, retry: bool) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        free(&mut tx, lease).await?;
        for id in lease.all() {
            let row = sqlx::query("UPDATE jobs SET tries = tries + 1 WHERE id = ? RETURNING tries")
                .bind(id.to_string())
                .fetch_one(&mut *tx)
                .await?;
            let tries: i64 = row.try_get("tries")?;
            let alone = lease.members.is_empty();
            if alone && (!retry || tries >= MAX_TRIES) {
                end_failed(&mut tx, id, fault, now).await?;
            } else if alone {
                sqlx::query("UPDATE jobs SET not_before_ms = ? WHERE id = ?")
                    .bind(now.plus(Duration::from_millis(500 << tries.clamp(0, 6))).0)
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

    /// Takes claims back whose worker is dead: all of them at the start of the process (nobody can hold one then), and
    /// later those whose lease ran out. Returns how many.
    pub async fn reclaim(&self, all: bool) -> Result<usize, StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        let rows = sqlx::query(
            "SELECT id, attempt, losses, (SELECT COUNT(*) FROM jobs m WHERE m.leader = jobs.id) AS members FROM jobs
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
            let wait =
                if losses > 2 { Duration::from_millis(250 << losses.clamp(0, 7)) } else { Duration::ZERO };
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
            if alone && losses >= MAX_LOSSES {
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

impl Lease {
    /// The job and the members of its batch.
    pub fn all(&self) -> impl Iterator<Item = JobId> {
        std::iter::once(self.job).chain(self.members.iter().copied())
    }
}

/// Puts further registrations that are ready under the leader.
async fn join_batch(
    tx: &mut Transaction<'static, Sqlite>,
    leader: &Job,
    now: Timestamp,
    limit: u32,
) -> Result<Vec<Job>, StorageError> {
    // The leader holds the project now, so the question is asked as if it did not.
    let ready = READY_TO_MAP.replace("h.worker IS NOT NULL)", "h.worker IS NOT NULL AND h.id <> ?2)");
    let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
        "UPDATE jobs SET state = 'running', leader = ?2, attempt = attempt + 1,
           started_ms = COALESCE(started_ms, ?1), updated_ms = ?1, revision = revision + 1
         WHERE seq IN (SELECT seq FROM jobs WHERE seq IN ({ready}) AND project_id = ?3 AND kind = 'registration'
                       AND tries = 0 AND losses = 0 ORDER BY seq LIMIT ?4) RETURNING *"
    )))
    .bind(now.0)
    .bind(leader.id.to_string())
    .bind(leader.project.to_string())
    .bind(limit)
    .fetch_all(&mut **tx)
    .await?;
    rows.iter().map(job).collect()
}

/// Whether a lease still holds the job and every member.
pub(super) async fn check(tx: &mut Transaction<'static, Sqlite>, lease: &Lease) -> Result<(), StorageError> {
    let row = sqlx::query(
        "SELECT (SELECT COUNT(*) FROM jobs WHERE id = ?1 AND attempt = ?2 AND worker IS NOT NULL AND state = 'running')
           AS held, (SELECT COUNT(*) FROM jobs WHERE leader = ?1 AND state = 'running') AS members",
    )
    .bind(lease.job.to_string())
    .bind(i64::from(lease.attempt))
    .fetch_one(&mut **tx)
    .await?;
    let (held, members): (i64, i64) = (row.try_get("held")?, row.try_get("members")?);
    if held == 1 && usize::try_from(members).is_ok_and(|n| n == lease.members.len()) {
        Ok(())
    } else {
        Err(StorageError::Fenced { job: lease.job, attempt: lease.attempt })
    }
}

/// Lets go of a job and its members, if this attempt still holds it.
async fn free(tx: &mut Transaction<'static, Sqlite>, lease: &Lease) -> Result<bool, StorageError> {
    let done = sqlx::query(
        "UPDATE jobs SET worker = NULL, lease_ms = NULL WHERE id = ? AND attempt = ? AND worker IS NOT NULL",
    )
    .bind(lease.job.to_string())
    .bind(i64::from(lease.attempt))
    .execute(&mut **tx)
    .await?;
    let held = done.rows_affected() > 0;
    if held {
        sqlx::query("UPDATE jobs SET leader = NULL WHERE leader = ?")
            .bind(lease.job.to_string())
            .execute(&mut **tx)
            .await?;
    }
    Ok(held)
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
    .bind(to_json(&crate::project::Standing::Failed(fault.clone()))?)
    .bind(id.to_string())
    .execute(&mut **tx)
    .await?;
    Ok(())
}
