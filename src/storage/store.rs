//! The database: opening, transactions, and the bells that ring when something changed.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use sqlx::sqlite::{
    SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{Sqlite, Transaction};
use tokio::sync::{Notify, broadcast};

use super::{BlobStore, StorageError, UploadFiles};
use crate::project::JobId;

/// How long a statement waits for a lock that another process holds, such as a backup.
pub(super) const BUSY: Duration = Duration::from_secs(10);
/// Connections for readers; in WAL they never wait for the writer.
const READERS: u32 = 4;
/// Changes that a slow listener may lag behind; after that it reads the row again anyway.
const CHANGES: usize = 1024;

/// A part of a list, oldest first.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Page {
    /// Continue after this position (an opaque number that the previous part ended with).
    pub after: Option<i64>,
    /// At most so many.
    pub limit: u32,
}

/// Rows and blobs of one data directory. Clones share everything.
#[derive(Debug, Clone)]
pub struct Store {
    pub(super) read: SqlitePool,
    pub(super) write: SqlitePool,
    /// Content-addressed files.
    pub blobs: BlobStore,
    /// Uploads that are not complete.
    pub uploads: UploadFiles,
    bells: Arc<Bells>,
}

#[derive(Debug)]
struct Bells {
    changed: broadcast::Sender<JobId>,
    work: Notify,
    /// Held for as long as the store is open: one process a data directory, so that at the start no worker can be alive.
    _lock: File,
}

impl Store {
    /// Opens the data directory, makes it if needed, and brings the schema up to date.
    pub async fn open(data: &Path) -> Result<Self, StorageError> {
        std::fs::create_dir_all(data).map_err(StorageError::io("making the data directory"))?;
        let lock = lock(data)?;
        let blobs = BlobStore::open(&data.join("blobs"))?;
        let uploads = UploadFiles::open(&data.join("uploads"))?;
        let options = SqliteConnectOptions::new()
            .filename(data.join("cairn.sqlite"))
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY);
        // One writer: SQLite allows no more, and a queue here is fairer than its lock.
        let write = SqlitePoolOptions::new().max_connections(1).connect_with(options.clone()).await?;
        sqlx::migrate!().run(&write).await?;
        let read =
            SqlitePoolOptions::new().max_connections(READERS).connect_with(options.read_only(true)).await?;
        // The names of the database and of the folder of blobs must survive a power cut as well as what is in them.
        File::open(data)
            .and_then(|folder| folder.sync_all())
            .map_err(StorageError::io("syncing the data directory"))?;
        let bells = Bells { changed: broadcast::Sender::new(CHANGES), work: Notify::new(), _lock: lock };
        Ok(Self { read, write, blobs, uploads, bells: Arc::new(bells) })
    }

    /// Opens a write transaction. It takes the write lock at once, so that it cannot fail half-way on a lock.
    pub(super) async fn begin(&self) -> Result<Transaction<'static, Sqlite>, StorageError> {
        Ok(self.write.begin_with("BEGIN IMMEDIATE").await?)
    }

    /// Hears of every job that changes, after the change is committed.
    #[must_use]
    pub fn changes(&self) -> broadcast::Receiver<JobId> {
        self.bells.changed.subscribe()
    }

    /// Returns when a job may have become ready since the last call returned.
    pub async fn work(&self) {
        self.bells.work.notified().await;
    }

    /// Tells listeners that these jobs changed.
    pub(super) fn announce(&self, jobs: impl IntoIterator<Item = JobId>) {
        for job in jobs {
            // An error only says that nobody listens.
            let _ = self.bells.changed.send(job);
        }
    }

    /// Wakes idle workers.
    pub(super) fn ring(&self) {
        self.bells.work.notify_waiters();
        self.bells.work.notify_one();
    }

    /// Answers whether the database can be read.
    pub async fn ping(&self) -> Result<(), StorageError> {
        sqlx::query("SELECT 1").execute(&self.read).await?;
        Ok(())
    }

    /// Finishes what is under way and closes the database.
    pub async fn close(&self) {
        self.read.close().await;
        self.write.close().await;
    }
}

/// Takes the data directory for this process. The lock goes with the process, however it ends.
fn lock(data: &Path) -> Result<File, StorageError> {
    let file = File::create(data.join("cairn.lock")).map_err(StorageError::io("making the lock file"))?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => Err(StorageError::InUse),
        Err(TryLockError::Error(e)) => Err(StorageError::io("locking the data directory")(e)),
    }
}
