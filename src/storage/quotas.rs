//! How much a project or a key may have, and how much that is now.
//!
//! What counts is decided in the transaction that makes the scan or the job, so that requests at the same moment cannot
//! together pass a limit that each alone keeps. Before an upload is read it is looked at once, so that bytes that could
//! not be kept are not sent.

use sqlx::SqliteConnection;

use super::rows::count;
use super::{StorageError, Store};
use crate::project::{KeyId, Limits, ProjectId};

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
}

/// What a request would add.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Addition {
    pub bytes: u64,
    pub scans: u64,
    pub jobs: u64,
}

impl Store {
    /// Fails if an upload of so many bytes, as far as is known, could not be kept.
    pub async fn check_upload(
        &self,
        project: ProjectId,
        key: Option<KeyId>,
        bytes: u64,
    ) -> Result<(), StorageError> {
        self.check_announcement(&mut *self.read.acquire().await?, project, key, bytes).await
    }

    /// The same within a transaction. Uploads that were announced and have not ended count as if they had.
    pub(super) async fn check_announcement(
        &self,
        connection: &mut SqliteConnection,
        project: ProjectId,
        key: Option<KeyId>,
        bytes: u64,
    ) -> Result<(), StorageError> {
        let announced = |column| {
            format!(
                "SELECT COALESCE(SUM(length), 0) AS bytes, COUNT(*) AS scans FROM uploads WHERE {column} = ? AND scan_id IS NULL"
            )
        };
        for (holder, limits) in self.holders(connection, project, key).await? {
            let row = sqlx::query(sqlx::AssertSqlSafe(announced(holder.column())))
                .bind(holder.id())
                .fetch_one(&mut *connection)
                .await?;
            let (coming, scans): (u64, u64) = (count(&row, "bytes")?, count(&row, "scans")?);
            let more = Addition { bytes: bytes.saturating_add(coming), scans: scans + 1, jobs: 1 };
            within(connection, holder, limits, more).await?;
        }
        Ok(())
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
            let row = sqlx::query("SELECT max_bytes, max_scans, max_queued_jobs FROM keys WHERE id = ?")
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

async fn within(
    connection: &mut SqliteConnection,
    holder: Holder,
    limits: Limits,
    more: Addition,
) -> Result<(), StorageError> {
    let of = holder.column();
    let row = sqlx::query(sqlx::AssertSqlSafe(format!(
        "SELECT COUNT(*) AS scans, COALESCE(SUM(bytes), 0) AS bytes, (SELECT COUNT(*) FROM jobs
           WHERE {of} = ?1 AND state IN ('accepted', 'running')) AS jobs
         FROM scans WHERE {of} = ?1 AND deleted_ms IS NULL"
    )))
    .bind(holder.id())
    .fetch_one(connection)
    .await?;
    let has =
        Addition { bytes: count(&row, "bytes")?, scans: count(&row, "scans")?, jobs: count(&row, "jobs")? };
    let checks = [
        (Quota::Bytes, has.bytes, more.bytes, limits.bytes),
        (Quota::Scans, has.scans, more.scans, limits.scans),
        (Quota::QueuedJobs, has.jobs, more.jobs, limits.queued_jobs),
    ];
    for (quota, has, more, limit) in checks {
        if let Some(limit) = limit
            && more > 0
            && has.saturating_add(more) > limit
        {
            return Err(StorageError::OverQuota { holder, quota, limit });
        }
    }
    Ok(())
}
