//! The database: opening, transactions, and the bells that ring when something changed.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use sqlx::migrate::Migrator;
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::{Row, Sqlite, Transaction};
use tokio::sync::{Notify, broadcast};

use super::folders::make_private;
use super::{BlobStore, Hold, StorageError, UploadFiles};
use crate::project::{JobId, Limits};

/// How long a statement waits for a lock that another process holds, such as a backup.
pub(super) const BUSY: Duration = Duration::from_secs(5);
/// The file of the database in the data directory.
pub(super) const DATABASE: &str = "cairn.sqlite";
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
    pub(super) data: Arc<Path>,
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
    project_limits: OnceLock<Limits>,
    changed: broadcast::Sender<JobId>,
    work: Notify,
    _claim: DataClaim,
}

/// What keeps the data directory as this store needs it, for as long as the store is open.
#[derive(Debug)]
enum DataClaim {
    /// It is this process's: one process a data directory, so that at the start no worker can be alive.
    Whole { _lock: File },
    /// It may be another process's, which deletes nothing while it is held off.
    Beside { _hold: Option<Hold> },
}

static MIGRATOR: Migrator = sqlx::migrate!();

impl Store {
    /// Opens the data directory for this process alone, makes it if needed, readable by nobody else, and brings the schema up to date.
    pub async fn open(data: &Path) -> Result<Self, StorageError> {
        make_private(data)?;
        let lock = lock(data)?;
        let blobs = BlobStore::open(&data.join("blobs"))?;
        UploadFiles::open(&data.join("uploads"))?;
        let options = options(data).create_if_missing(true);
        // One writer: SQLite allows no more, and a queue here is fairer than its lock.
        let write = connections(1).connect_with(writing(&options)).await?;
        MIGRATOR.run(&write).await?;
        // The names of the database and of the folder of blobs must survive a power cut as well as what is in them.
        File::open(data)
            .and_then(|folder| folder.sync_all())
            .map_err(StorageError::io("syncing the data directory"))?;
        let store = Self::assemble(data, options, write, blobs, DataClaim::Whole { _lock: lock }).await?;
        for damage in store.damage().await? {
            store.blobs.ledger.recall(damage.blob, damage.finding);
        }
        Ok(store)
    }

    /// Opens a data directory that another process may be serving: it must have this program's schema. While the store is open, no
    /// process deletes blobs.
    pub async fn open_beside(data: &Path) -> Result<Self, StorageError> {
        let (at, taken) = (data.to_owned(), "holding the collector off");
        let hold = tokio::task::spawn_blocking(move || Hold::take(&at))
            .await
            .map_err(|e| StorageError::io(taken)(std::io::Error::other(e)))??;
        Self::open_with(data, Some(hold)).await
    }

    /// Opens the data directory of the service that this process works for. Blobs that it stores are safe from the collector only for
    /// as long as that spares fresh ones.
    pub async fn open_for_service(data: &Path) -> Result<Self, StorageError> {
        Self::open_with(data, None).await
    }

    async fn open_with(data: &Path, hold: Option<Hold>) -> Result<Self, StorageError> {
        if !data.join(DATABASE).is_file() {
            return Err(StorageError::NoData(data.to_owned()));
        }
        let options = options(data);
        let write = connections(1).connect_lazy_with(writing(&options));
        let blobs = BlobStore::beside(&data.join("blobs"));
        let store = Self::assemble(data, options, write, blobs, DataClaim::Beside { _hold: hold }).await?;
        let found: Vec<i64> =
            sqlx::query("SELECT version FROM _sqlx_migrations WHERE success ORDER BY version")
                .fetch_all(&store.read)
                .await?
                .iter()
                .map(|row| row.try_get("version"))
                .collect::<Result<_, _>>()?;
        let mut known: Vec<i64> = MIGRATOR.iter().map(|m| m.version).collect();
        known.sort_unstable();
        if found == known { Ok(store) } else { Err(StorageError::OtherSchema) }
    }

    async fn assemble(
        data: &Path,
        options: SqliteConnectOptions,
        write: SqlitePool,
        blobs: BlobStore,
        claim: DataClaim,
    ) -> Result<Self, StorageError> {
        let read = connections(READERS).connect_with(options.read_only(true)).await?;
        let bells = Bells {
            project_limits: OnceLock::new(),
            changed: broadcast::Sender::new(CHANGES),
            work: Notify::new(),
            _claim: claim,
        };
        let uploads = UploadFiles::at_folder(&data.join("uploads"));
        Ok(Self { data: data.into(), read, write, blobs, uploads, bells: Arc::new(bells) })
    }

    /// The data directory.
    #[must_use]
    pub fn data(&self) -> &Path {
        &self.data
    }

    /// Opens a write transaction. It takes the write lock at once, so that it cannot fail half-way on a lock.
    pub(super) async fn begin(&self) -> Result<Transaction<'static, Sqlite>, StorageError> {
        match self.write.begin_with("BEGIN IMMEDIATE").await {
            // SQLite rolls a transaction back by itself when the disk fails under its commit, of which the connection's own count of
            // transactions knows nothing: it would refuse every one from then on. So it is replaced.
            Err(sqlx::Error::InvalidSavePointStatement) => {
                self.write.acquire().await?.close().await?;
                Ok(self.write.begin_with("BEGIN IMMEDIATE").await?)
            }
            other => Ok(other?),
        }
    }

    /// Sets how much each project may have, once; without that there is no limit.
    pub fn limit_projects(&self, limits: Limits) {
        self.bells.project_limits.get_or_init(|| limits);
    }

    pub(super) fn project_limits(&self) -> Limits {
        self.bells.project_limits.get().copied().unwrap_or_default()
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

/// At most so many connections, which stay open. Each has a thread, and asking that first whether its file is still there would double the
/// time that a short query takes.
fn connections(most: u32) -> SqlitePoolOptions {
    SqlitePoolOptions::new()
        .max_connections(most)
        .test_before_acquire(false)
        .idle_timeout(None)
        .max_lifetime(None)
}

fn options(data: &Path) -> SqliteConnectOptions {
    SqliteConnectOptions::new()
        .filename(data.join(DATABASE))
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .busy_timeout(BUSY)
}

/// Who writes also says how the file is kept; readers, who may not write, take it as it is.
fn writing(options: &SqliteConnectOptions) -> SqliteConnectOptions {
    options.clone().journal_mode(SqliteJournalMode::Wal)
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
