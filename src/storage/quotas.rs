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
    fn id(self) -> String {
        match self {
            Self::Project(id) => id.to_string(),
            Self::Key(id) => id.to_string(),
        }
    }
}

impl Quota {
    /// How much of it a holder (?1) has now (?2). What was announced and has not ended counts as if it were there, but for one upload (?3).
    /// Each is looked up in totals (`holdings`) or in an index of what is under way: it takes no longer the more scans there are.
    fn query(self, holder: Holder) -> String {
        let of = match holder {
            Holder::Project(_) => "project_id",
            Holder::Key(_) => "key_id",
        };
        let coming =
            format!("uploads WHERE {of} = ?1 AND scan_id IS NULL AND expires_ms > ?2 AND id IS NOT ?3");
        match self {
            Self::Bytes => format!(
                "SELECT COALESCE((SELECT bytes FROM holdings WHERE holder = ?1), 0)
                   + COALESCE((SELECT SUM(length) FROM {coming}), 0) AS has"
            ),
            Self::Scans => format!(
                "SELECT COALESCE((SELECT scans FROM holdings WHERE holder = ?1), 0)
                   + (SELECT COUNT(*) FROM {coming}) AS has"
            ),
            Self::QueuedJobs => format!(
                "SELECT COUNT(*) AS has FROM jobs WHERE {of} = ?1 AND lane IN ('ingest', 'map') AND state IN ('accepted', 'running')"
            ),
            Self::OpenUploads => format!("SELECT COUNT(*) AS has FROM {coming}"),
        }
    }
}

/// Fails if a holder would have more than it may.
async fn within(
    connection: &mut SqliteConnection,
    holder: Holder,
    limits: Limits,
    more: Addition,
) -> Result<(), StorageError> {
    let checks = [
        (Quota::Bytes, more.bytes, limits.bytes),
        (Quota::Scans, more.scans, limits.scans),
        (Quota::QueuedJobs, more.jobs, limits.queued_jobs),
        (Quota::OpenUploads, more.uploads, limits.open_uploads),
    ];
    let announced = more.announced.map(|id| id.to_string());
    for (quota, more, limit) in checks.into_iter().filter(|(_, more, _)| *more > 0) {
        let Some(limit) = limit else { continue };
        let row = sqlx::query(sqlx::AssertSqlSafe(quota.query(holder)))
            .bind(holder.id())
            .bind(Timestamp::now().0)
            .bind(announced.as_deref())
            .fetch_one(&mut *connection)
            .await?;
        let has: u64 = count(&row, "has")?;
        if has.saturating_add(more) > limit {
            return Err(StorageError::OverQuota { holder, quota, limit });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::Row;

    use super::*;
    use crate::project::{Name, Reach, Scope, Token};
    use crate::storage::testing::{Fixture, new_scan, project};
    use crate::storage::{NewKey, NewScan};

    const QUOTAS: [Quota; 4] = [Quota::Bytes, Quota::Scans, Quota::QueuedJobs, Quota::OpenUploads];

    impl Fixture {
        async fn key(&self) -> KeyId {
            let token = Token::generate(KeyId::generate()).unwrap();
            let (name, limits) = (Name::parse("rig").unwrap(), Limits::default());
            let new = NewKey { name, scope: Scope::Upload, reach: Reach::Everything, limits, expires: None };
            self.store.keys().create(&new, &token).await.unwrap().id
        }

        async fn has(&self, holder: Holder) -> [u64; 4] {
            let mut has = [0; 4];
            for (quota, has) in QUOTAS.into_iter().zip(&mut has) {
                let query = sqlx::query(sqlx::AssertSqlSafe(quota.query(holder)));
                let query = query.bind(holder.id()).bind(Timestamp::now().0).bind(None::<String>);
                *has = count(&query.fetch_one(&self.store.read).await.unwrap(), "has").unwrap();
            }
            has
        }

        /// What the rows of scans themselves say, summed.
        async fn summed(&self) -> Vec<(String, i64, i64)> {
            let sums = "SELECT holder, COUNT(*) AS n, SUM(bytes) AS bytes FROM
                (SELECT project_id AS holder, bytes FROM scans WHERE deleted_ms IS NULL
                 UNION ALL SELECT key_id, bytes FROM scans WHERE deleted_ms IS NULL AND key_id IS NOT NULL)
                GROUP BY holder ORDER BY holder";
            self.totals(sums).await
        }

        async fn totals(&self, query: &'static str) -> Vec<(String, i64, i64)> {
            let rows = sqlx::query(query).fetch_all(&self.store.read).await.unwrap();
            rows.iter().map(|row| (row.get(0), row.get(1), row.get(2))).collect()
        }
    }

    #[tokio::test]
    async fn what_is_held_follows_scans_that_come_go_and_end_with_their_project() {
        let at = Fixture::new().await;
        let other = project(&at.store).await;
        let key = at.key().await;
        let mut scans = Vec::new();
        for (project, sender, n) in [(at.project, Some(key), 1), (at.project, None, 2), (other, Some(key), 3)]
        {
            let blob = at.blob(&"x".repeat(n));
            let new = NewScan { sender, ..new_scan(project, n as u128, *blob) };
            scans.push(at.store.admit_scan(&new).await.unwrap().scan);
        }
        let kept = "SELECT holder, scans, bytes FROM holdings WHERE scans > 0 ORDER BY holder";
        assert_eq!(at.has(Holder::Project(at.project)).await, [3, 2, 2, 0]);
        assert_eq!(at.has(Holder::Key(key)).await, [4, 2, 2, 0]);
        assert_eq!(at.totals(kept).await, at.summed().await);
        at.store.delete_scan(at.project, scans[0].id).await.unwrap();
        assert_eq!(at.has(Holder::Project(at.project)).await[..2], [2, 1]);
        assert_eq!(at.has(Holder::Key(key)).await[..2], [3, 1]);
        assert_eq!(at.totals(kept).await, at.summed().await);
        at.store.delete_project(other).await.unwrap();
        assert_eq!(at.has(Holder::Key(key)).await[..2], [0, 0]);
        assert_eq!(at.totals(kept).await, at.summed().await);
        let left = "SELECT holder, scans, bytes FROM holdings ORDER BY holder";
        assert!(at.totals(left).await.iter().all(|(holder, ..)| *holder != other.to_string()));
    }

    #[tokio::test]
    async fn no_limit_is_checked_by_reading_all_that_was_ever_kept() {
        let at = Fixture::new().await;
        for holder in [Holder::Project(at.project), Holder::Key(KeyId::generate())] {
            for quota in QUOTAS {
                let explained = format!("EXPLAIN QUERY PLAN {}", quota.query(holder));
                let rows =
                    sqlx::query(sqlx::AssertSqlSafe(explained)).fetch_all(&at.store.read).await.unwrap();
                let plan: Vec<String> = rows.iter().map(|row| row.get("detail")).collect();
                for step in plan.iter().filter(|step| !step.contains("CONSTANT") && !step.contains("SCALAR"))
                {
                    let narrow =
                        ["USING PRIMARY KEY", "uploads_coming_", "jobs_open_of_project", "open_jobs_of_key"];
                    assert!(
                        step.starts_with("SEARCH") && narrow.iter().any(|index| step.contains(index)),
                        "{quota:?} of {holder:?}: {plan:?}"
                    );
                }
            }
        }
    }
}
