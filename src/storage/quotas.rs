//! How much a project or a key may have, and how much that is now.
//!
//! What counts is decided in the transaction that makes the scan or the job, so that requests at the same moment cannot
//! together pass a limit that each alone keeps. Before an upload is read it is looked at once, so that bytes that could
//! not be kept are not sent.

use sqlx::SqliteConnection;

use super::rows::count;
use super::{StorageError, Store};
use crate::project::{KeyId, Limits, ProjectId, Timestamp, UploadId};

/// Whose limit it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Holder {
    /// Everybody's together in a project.
    Project(ProjectId),
    /// That of one key.
    Key(KeyId),
}

/// What there is enough of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quota {
    /// Bytes of scans.
    Bytes,
    /// Scans.
    Scans,
    /// Jobs that wait or run. It passes by itself.
    QueuedJobs,
    /// Uploads that were announced and are not complete. It passes when they end or expire.
    OpenUploads,
}

/// What a request would add.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Addition {
    pub bytes: u64,
    pub scans: u64,
    pub jobs: u64,
    pub uploads: u64,
    /// The upload that this was announced as, which therefore does not count twice.
    pub announced: Option<UploadId>,
}

impl Store {
    /// Fails if an upload of so many bytes, as far as is known, could not be kept.
    pub async fn check_upload(
        &self,
        project: ProjectId,
        key: Option<KeyId>,
        bytes: u64,
    ) -> Result<(), StorageError> {
        let more = Addition { bytes, scans: 1, jobs: 1, ..Addition::default() };
        self.check_quotas(&mut *self.read.acquire().await?, project, key, more).await
    }

    /// Fails if what is to be added passes a limit of the project or of the key.
    pub(super) async fn check_quotas(
        &self,
        connection: &mut SqliteConnection,
        project: ProjectId,
        key: Option<KeyId>,
        more: Addition,
    ) -> Result<(), StorageError> {
        for (holder, limits) in self.holders(connection, project, key).await? {
            within(connection, holder, limits, more).await?;
        }
        Ok(())
    }

    /// Jobs that wait or run, in all projects; at most `enough` are counted.
    pub async fn open_jobs(&self, enough: u64) -> Result<u64, StorageError> {
        let row = sqlx::query(
            "SELECT COUNT(*) AS open FROM (SELECT 1 FROM jobs WHERE state IN ('accepted', 'running') LIMIT ?)",
        )
        .bind(i64::try_from(enough).unwrap_or(i64::MAX))
        .fetch_one(&self.read)
        .await?;
        count(&row, "open")
    }

    /// Bytes that are free for this program where the data are.
    pub fn free_bytes(&self) -> Result<u64, StorageError> {
        let disk = rustix::fs::statvfs(self.blobs.root())
            .map_err(|error| StorageError::io("asking how much space is free")(error.into()))?;
        Ok(disk.f_bavail.saturating_mul(disk.f_frsize))
    }

    /// Who has limits here.
    async fn holders(
        &self,
        connection: &mut SqliteConnection,
        project: ProjectId,
        key: Option<KeyId>,
    ) -> Result<Vec<(Holder, Limits)>, StorageError> {
        let mut holders = vec![(Holder::Project(project), self.project_limits())];
        if let Some(key) = key {
            let row = sqlx::query(
                "SELECT max_bytes, max_scans, max_queued_jobs, max_open_uploads FROM keys WHERE id = ?",
            )
            .bind(key.to_string())
            .fetch_optional(connection)
            .await?
            .ok_or(StorageError::NoKey(key))?;
            holders.push((Holder::Key(key), super::keys::limits(&row)?));
        }
        holders.retain(|(_, limits)| *limits != Limits::default());
        Ok(holders)
    }
}

impl Holder {
    fn column(self) -> &'static str {
        match self {
            Self::Project(_) => "project_id",
            Self::Key(_) => "key_id",
        }
    }

    fn id(self) -> String {
        match self {
            Self::Project(id) => id.to_string(),
            Self::Key(id) => id.to_string(),
        }
    }
}

/// Fails if a holder would have more than it may. What was announced and has not ended counts as if it were there.
async fn within(
    connection: &mut SqliteConnection,
    holder: Holder,
    limits: Limits,
    more: Addition,
) -> Result<(), StorageError> {
    let of = holder.column();
    let row = sqlx::query(sqlx::AssertSqlSafe(format!(
        "WITH kept AS (SELECT COUNT(*) AS n, COALESCE(SUM(bytes), 0) AS bytes FROM scans
                       WHERE {of} = ?1 AND deleted_ms IS NULL),
              coming AS (SELECT COUNT(*) AS n, COALESCE(SUM(length), 0) AS bytes FROM uploads
                         WHERE {of} = ?1 AND scan_id IS NULL AND expires_ms > ?2 AND id IS NOT ?3)
         SELECT kept.n + coming.n AS scans, kept.bytes + coming.bytes AS bytes, coming.n AS uploads,
           (SELECT COUNT(*) FROM jobs WHERE {of} = ?1 AND state IN ('accepted', 'running')) AS jobs
         FROM kept, coming"
    )))
    .bind(holder.id())
    .bind(Timestamp::now().0)
    .bind(more.announced.map(|id| id.to_string()))
    .fetch_one(connection)
    .await?;
    let checks = [
        (Quota::Bytes, "bytes", more.bytes, limits.bytes),
        (Quota::Scans, "scans", more.scans, limits.scans),
        (Quota::QueuedJobs, "jobs", more.jobs, limits.queued_jobs),
        (Quota::OpenUploads, "uploads", more.uploads, limits.open_uploads),
    ];
    for (quota, column, more, limit) in checks {
        let has: u64 = count(&row, column)?;
        if let Some(limit) = limit
            && more > 0
            && has.saturating_add(more) > limit
        {
            return Err(StorageError::OverQuota { holder, quota, limit });
        }
    }
    Ok(())
}
