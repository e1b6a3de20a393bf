//! Publishing a version: the one transaction by which a model changes.

use serde_json::Value;

use super::claims::check;
use super::removals::forget;
use super::rows::to_json;
use super::thinning::thin;
use super::{BlobId, Lease, StorageError, Store};
use crate::project::{
    ContentKey, Fault, JobId, JobKind, ProjectId, ScanId, ScanState, Standing, Timestamp, VersionNumber,
};

/// A scan's new state.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanChange {
    /// The scan.
    pub scan: ScanId,
    /// Where it stands now.
    pub standing: Standing,
}

/// All that a job changes when it ends well. Blobs that it names are synced already.
#[derive(Debug, Clone, PartialEq)]
pub struct Publication {
    /// Whose model.
    pub project: ProjectId,
    /// What the job does.
    pub kind: JobKind,
    /// The version that the job started from; the publication fails if the project has moved on.
    pub from: VersionNumber,
    /// The new version, unless the model is as it was.
    pub version: Option<NewVersion>,
    /// Pairs matched on the way: the two keys (ascending) and the engine's result.
    pub pairs: Vec<(ContentKey, ContentKey, Vec<u8>)>,
    /// Parameters under which scans were prepared and pairs matched.
    pub engine: String,
    /// Scans whose standing changed.
    pub scans: Vec<ScanChange>,
    /// Deleted scans that the model holds no more.
    pub forgotten: Vec<ScanId>,
    /// How each job of the lease ends.
    pub outcomes: Vec<(JobId, Result<Value, Fault>)>,
}

/// A version to be inserted.
#[derive(Debug, Clone, PartialEq)]
pub struct NewVersion {
    /// The engine's snapshot.
    pub snapshot: BlobId,
    /// What readers see.
    pub content: BlobId,
    /// Voxel size, metres.
    pub resolution: f64,
    /// Number of components.
    pub components: usize,
    /// Scans in a component.
    pub registered: usize,
    /// Scans in none.
    pub waiting: usize,
}

impl Store {
    /// Publishes. Nothing is changed if the lease is lost, the project is gone, or its head has moved.
    pub async fn publish(&self, lease: &Lease, publication: &Publication) -> Result<(), StorageError> {
        let now = Timestamp::now();
        let project = publication.project.to_string();
        let mut tx = self.begin().await?;
        check(&mut tx, lease).await?;
        if let Some(version) = &publication.version {
            let number = publication.from.next();
            let moved = sqlx::query("UPDATE projects SET head = ? WHERE id = ? AND head = ?")
                .bind(number.0)
                .bind(&project)
                .bind(publication.from.0)
                .execute(&mut *tx)
                .await?;
            if moved.rows_affected() != 1 {
                return Err(StorageError::Fenced { job: lease.job, attempt: lease.attempt });
            }
            sqlx::query("INSERT INTO versions VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)")
                .bind(&project)
                .bind(number.0)
                .bind(lease.job.to_string())
                .bind(publication.kind.as_str())
                .bind(version.snapshot.to_string())
                .bind(version.content.to_string())
                .bind(&publication.engine)
                .bind(version.resolution)
                .bind(version.components as i64)
                .bind(version.registered as i64)
                .bind(version.waiting as i64)
                .bind(now.0)
                .execute(&mut *tx)
                .await?;
            thin(&mut tx, &project, number).await?;
        }
        // Before new pairs: the same content may have come again.
        for scan in &publication.forgotten {
            forget(&mut tx, *scan, &project, now).await?;
        }
        for (a, b, result) in &publication.pairs {
            sqlx::query("INSERT OR REPLACE INTO pairs VALUES (?, ?, ?, ?, ?)")
                .bind(&project)
                .bind(&publication.engine)
                .bind(a.0.to_be_bytes().as_slice())
                .bind(b.0.to_be_bytes().as_slice())
                .bind(result.as_slice())
                .execute(&mut *tx)
                .await?;
        }
        for change in &publication.scans {
            let state = match change.standing {
                Standing::Registered(_) => ScanState::Registered,
                Standing::Waiting(_) => ScanState::Waiting,
                Standing::Failed(_) => ScanState::Failed,
            };
            sqlx::query("UPDATE scans SET state = ?, standing = ? WHERE id = ?")
                .bind(state.as_str())
                .bind(to_json(&change.standing)?)
                .bind(change.scan.to_string())
                .execute(&mut *tx)
                .await?;
        }
        for (job, outcome) in &publication.outcomes {
            let (state, outcome, fault) = match outcome {
                Ok(outcome) => ("succeeded", Some(to_json(outcome)?), None),
                Err(fault) => ("failed", None, Some(to_json(fault)?)),
            };
            sqlx::query(
                "UPDATE jobs SET state = ?1, outcome = ?2, fault = ?3, progress = CASE ?1 WHEN 'succeeded' THEN 100
                   ELSE progress END, stage = NULL, worker = NULL, leader = NULL, lease_ms = NULL, finished_ms = ?4,
                   updated_ms = ?4, revision = revision + 1 WHERE id = ?5",
            )
            .bind(state)
            .bind(outcome)
            .bind(fault)
            .bind(now.0)
            .bind(job.to_string())
            .execute(&mut *tx)
            .await?;
        }
        tx.commit().await?;
        self.announce(publication.outcomes.iter().map(|(job, _)| *job));
        self.ring();
        Ok(())
    }
}
