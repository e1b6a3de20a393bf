//! What can go wrong below the service.

use std::io::ErrorKind;
use std::path::PathBuf;

use super::{Holder, Quota};
use crate::project::{DecisionId, JobId, KeyId, ProjectId, ScanId, UploadId, VersionNumber, WebhookId};

/// A failure of the database or of the blob files.
#[derive(Debug, thiserror::Error)]
pub enum StorageError {
    /// No such project, or it was deleted.
    #[error("there is no project {0}")]
    NoProject(ProjectId),
    /// No such scan in the project, or it was deleted.
    #[error("there is no scan {0}")]
    NoScan(ScanId),
    /// No such job.
    #[error("there is no job {0}")]
    NoJob(JobId),
    /// No such decision in the project, or it was taken back, or went with a scan.
    #[error("there is no decision {0}")]
    NoDecision(DecisionId),
    /// No such upload, or it was taken back, or it expired long ago.
    #[error("there is no upload {0}")]
    NoUpload(UploadId),
    /// Bytes of an upload that were safe on disk are there no more, such as after a restored backup.
    #[error("upload {upload} has lost its bytes: {kept} were kept, {found} are there")]
    DamagedUpload {
        /// The upload.
        upload: UploadId,
        /// Bytes that its row knows.
        kept: u64,
        /// Bytes in its file.
        found: u64,
    },
    /// No such webhook in the project.
    #[error("there is no webhook {0}")]
    NoWebhook(WebhookId),
    /// The project holds as many webhooks as it may.
    #[error("project {project} holds {limit} webhooks, which is the limit")]
    TooManyWebhooks {
        /// The project.
        project: ProjectId,
        /// How many it may hold.
        limit: u32,
    },
    /// No such key.
    #[error("there is no key {0}")]
    NoKey(KeyId),
    /// A project or a key would have more than it may.
    #[error("{} may have {limit} {}, and would have more", words(*holder), thing(*quota))]
    OverQuota {
        /// Whose limit it is.
        holder: Holder,
        /// What of.
        quota: Quota,
        /// How much it may have.
        limit: u64,
    },
    /// The project holds as many decisions as it may.
    #[error(
        "project {project} holds {limit} decisions, which is the limit; take back what no longer matters"
    )]
    TooManyDecisions {
        /// The project.
        project: ProjectId,
        /// How many it may hold.
        limit: u32,
    },
    /// The project has no version of this number.
    #[error("project {0} has no version {1}")]
    NoVersion(ProjectId, VersionNumber),
    /// The job is in a final state already.
    #[error("job {0} has ended")]
    JobEnded(JobId),
    /// The worker no longer holds what it tries to change: its lease ran out, the job was dismissed, or the
    /// project is gone. Nothing was changed.
    #[error("job {job} is no longer held in attempt {attempt}")]
    Fenced {
        /// The job.
        job: JobId,
        /// The attempt that was held.
        attempt: u32,
    },
    /// A blob that a row names is not there.
    #[error("blob {0} is missing")]
    MissingBlob(String),
    /// The bytes of a blob no longer have the hash that is their name.
    #[error("blob {expected} is damaged: its bytes hash to {found}")]
    DamagedBlob {
        /// The name.
        expected: String,
        /// What the bytes hash to.
        found: String,
    },
    /// A row holds a value that this program never writes.
    #[error("the database holds an unreadable value in {column}: {value}")]
    BadRow {
        /// Table and column.
        column: &'static str,
        /// The value.
        value: String,
    },
    /// The database was written by an older or a newer program.
    #[error(
        "the data directory was written by another version of this program; start the service of this version on it once"
    )]
    OtherSchema,
    /// There is no database where one must be.
    #[error("{} is no data directory: it holds no cairn.sqlite", .0.display())]
    NoData(PathBuf),
    /// Something is where a copy was to be made.
    #[error("{} is not empty", .0.display())]
    NotEmpty(PathBuf),
    /// Another process serves this data directory.
    #[error("the data directory is in use by another process")]
    InUse,
    /// The file system failed.
    #[error("{action}: {source}")]
    Io {
        /// What was being done.
        action: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// The database failed.
    #[error("database: {0}")]
    Database(#[from] sqlx::Error),
    /// The database could not be brought to this program's schema.
    #[error("migration: {0}")]
    Migration(#[from] sqlx::migrate::MigrateError),
}

/// Trouble that is the machine's and not the request's: it may pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Trouble {
    /// No space is left for what was to be written.
    Full,
    /// The database is locked by another process for too long.
    Busy,
    /// A file could not be read, written or synced.
    Failing,
}

/// Result codes of SQLite: <https://www.sqlite.org/rescode.html>. Extended codes have these in their lowest byte.
const SQLITE_BUSY: i32 = 5;
const SQLITE_LOCKED: i32 = 6;
const SQLITE_IOERR: i32 = 10;
const SQLITE_FULL: i32 = 13;
const SQLITE_CANTOPEN: i32 = 14;
/// What is written to may have become read-only, as file systems do when their disk fails.
const SQLITE_READONLY: i32 = 8;
/// So many opened the database at once that one of them gave up.
const SQLITE_PROTOCOL: i32 = 15;

fn words(holder: Holder) -> &'static str {
    match holder {
        Holder::Project(_) => "the project",
        Holder::Key(_) => "the key",
    }
}

fn thing(quota: Quota) -> &'static str {
    match quota {
        Quota::Bytes => "bytes of scans",
        Quota::Scans => "scans",
        Quota::QueuedJobs => "jobs that have not ended",
        Quota::OpenUploads => "uploads that are not complete",
    }
}

impl StorageError {
    /// Whether something was stored and cannot be read any more.
    #[must_use]
    pub fn is_damage(&self) -> bool {
        matches!(self, Self::MissingBlob(_) | Self::DamagedBlob { .. } | Self::BadRow { .. })
    }

    /// What the machine lacks, if that is why.
    #[must_use]
    pub fn trouble(&self) -> Option<Trouble> {
        match self {
            Self::Io { source, .. } => Some(match source.kind() {
                ErrorKind::StorageFull | ErrorKind::QuotaExceeded => Trouble::Full,
                _ => Trouble::Failing,
            }),
            Self::Database(sqlx::Error::PoolTimedOut) => Some(Trouble::Busy),
            // A commit failed under the connection, and so did the one that took its place: the disk goes on failing.
            // Or the connection could not be made, or ended under a statement.
            Self::Database(
                sqlx::Error::InvalidSavePointStatement | sqlx::Error::Io(_) | sqlx::Error::WorkerCrashed,
            ) => Some(Trouble::Failing),
            Self::Database(sqlx::Error::Database(error)) => {
                let code: i32 = error.code()?.parse().ok()?;
                match code & 0xff {
                    SQLITE_FULL => Some(Trouble::Full),
                    SQLITE_BUSY | SQLITE_LOCKED | SQLITE_PROTOCOL => Some(Trouble::Busy),
                    SQLITE_IOERR | SQLITE_CANTOPEN | SQLITE_READONLY => Some(Trouble::Failing),
                    _ => None,
                }
            }
            _ => None,
        }
    }

    /// Wraps an I/O error with what was being done.
    pub(super) fn io(action: &'static str) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { action, source }
    }
}
