//! Doing one job that was claimed: it runs while its claim is watched, and ends, is given back, or is set aside.
//!
//! Used by the loops of `workers`, and by the processes that jobs have of their own (see `isolated`).

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::decide::decide;
use super::ingest::ingest;
use super::isolated::Processes;
use super::model_cache::ModelCache;
use super::progress::ProgressSink;
use super::refine::refine;
use super::register::register;
use super::remove::remove;
use super::session::Task;
use super::workers::WorkerOptions;
use super::{Compute, Demand, JobError};
use crate::control::CancelToken;
use crate::project::{Fault, JobKind, Lane};
use crate::storage::{Claim, Lease, StorageError, Store};

/// Whoever does jobs. Clones share everything.
#[derive(Clone)]
pub(super) struct Performer {
    pub store: Store,
    pub compute: Compute,
    pub models: Arc<ModelCache>,
    /// Where jobs get processes of their own.
    pub processes: Arc<Processes>,
    /// How much clients ask for at this moment.
    pub demand: Arc<Demand>,
    pub options: WorkerOptions,
    pub stop: CancellationToken,
    /// How long a job that was told to stop is waited for.
    pub patience: Duration,
}

/// Why a job is interrupted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Interruption {
    /// It was dismissed, or somebody else has it now.
    Lost,
    /// The service stops.
    Stopping,
    /// It does not end.
    Overdue,
    /// It takes more memory than it may.
    TooLarge,
    /// Its claim is not renewed any more.
    Silent,
}

/// How long a job that was told to stop is waited for in the service. The core looks at its token every few tens of milliseconds;
/// writing what it has just finished may take longer.
pub(super) const PATIENCE: Duration = Duration::from_secs(20);

/// How long it takes until the end of a job that could not be written down is written again.
const WRITE_AGAIN: Duration = Duration::from_secs(1);

/// An upload may take so long to be decoded and prepared, however small it is …
const INGEST_AT_LEAST: Duration = Duration::from_mins(2);
/// … and a second more for so many bytes. Decoding text, the slowest, is ten times as fast on one core.
const INGEST_BYTES_PER_SECOND: u64 = 2_000_000;

impl Performer {
    /// Does the job and writes down how it ended. Returns whether nothing is left of it: a computation that does not stop goes on
    /// behind its back.
    pub async fn perform(&self, lane: Lane, claim: Claim) -> bool {
        let limit = match self.time_limit(lane, &claim).await {
            Ok(limit) => limit,
            Err(error) => {
                tracing::error!(%error, "a job cannot begin");
                told(self.store.postpone(&claim.lease).await);
                return true;
            }
        };
        let lease = claim.lease.clone();
        let task = Task {
            progress: Arc::new(ProgressSink::new(claim.job.kind, lane)),
            cancel: CancelToken::new(),
            store: self.store.clone(),
            compute: self.compute.clone(),
            models: Arc::clone(&self.models),
            options: self.options.clone(),
            claim,
        };
        tracing::info!(lane = lane.as_str(), batch = 1 + lease.members.len(), "job begins");
        let mut work = pin!(run(lane, &task));
        let why = tokio::select! {
            result = &mut work => {
                self.end(&lease, result).await;
                return true;
            }
            why = self.keep(&task, limit) => why,
        };
        task.cancel.cancel();
        let stopped = tokio::time::timeout(self.patience, &mut work).await;
        let settled = stopped.is_ok();
        if !settled && why != Interruption::Stopping {
            tracing::error!(?why, "a computation does not stop; its thread is given up");
            self.compute.renew();
        }
        match (why, stopped) {
            (Interruption::Overdue, Ok(Ok(()))) => {}
            (Interruption::Overdue, _) => told(self.store.crashed(&lease, &overdue(limit)).await),
            (_, Ok(result)) => self.end(&lease, result).await,
            (_, Err(_)) => told(self.store.release(&lease).await),
        }
        settled
    }

    /// How long the job may take. A batch takes as long as its longest.
    pub async fn time_limit(&self, lane: Lane, claim: &Claim) -> Result<Duration, StorageError> {
        let most = self.options.job_limit;
        let (Lane::Ingest, Some(scan)) = (lane, claim.job.scan) else { return Ok(most) };
        match self.store.scan(claim.job.project, scan).await {
            Ok(scan) => {
                Ok(most.min(INGEST_AT_LEAST + Duration::from_secs(scan.bytes / INGEST_BYTES_PER_SECOND)))
            }
            // It was deleted meanwhile: the job finds that out by itself.
            Err(StorageError::NoScan(_)) => Ok(most),
            Err(error) => Err(error),
        }
    }

    async fn end(&self, lease: &Lease, result: Result<(), JobError>) {
        match result {
            Ok(()) => tracing::info!("job's stage is done"),
            Err(JobError::Lost | JobError::Cancelled(_)) => {
                tracing::info!("job is let go");
                self.write_down(|| self.store.release(lease)).await;
            }
            Err(JobError::Failed { fault, retry }) => {
                tracing::warn!(code = fault.code, detail = fault.detail, ?retry, "job fails");
                self.write_down(|| self.store.fail(lease, &fault, retry)).await;
            }
        }
    }

    /// Writes down how a job ended, again and again while disk or database do not take it, until the claim runs out anyway.
    pub async fn write_down<W: Future<Output = Result<(), StorageError>>>(&self, write: impl Fn() -> W) {
        let until = Instant::now() + self.options.lease;
        loop {
            let written = write().await;
            let passes = written.as_ref().is_err_and(|error| error.trouble().is_some());
            if !passes || Instant::now() >= until || self.stop.is_cancelled() {
                return told(written);
            }
            tokio::select! {
                () = tokio::time::sleep(WRITE_AGAIN) => {}
                () = self.stop.cancelled() => {}
            }
        }
    }

    /// Renews the claim and shows progress until the claim is lost, its time is over, or the pool stops.
    async fn keep(&self, task: &Task, limit: Duration) -> Interruption {
        let mut changes = self.store.changes();
        let mut shown = task.progress.shown();
        let (begun, mut renewed) = (Instant::now(), Instant::now());
        let mut tick = tokio::time::interval(self.options.progress_every);
        loop {
            let ours = tokio::select! {
                _ = tick.tick() => false,
                // A listener that lagged behind has missed something that may concern this job.
                change = changes.recv() => change.map_or(true, |id| task.claim.lease.all().any(|own| own == id)),
                () = self.stop.cancelled() => return Interruption::Stopping,
            };
            if begun.elapsed() > limit {
                return Interruption::Overdue;
            }
            let now = task.progress.shown();
            if !ours && now == shown && renewed.elapsed() < self.options.lease / 3 {
                continue;
            }
            match self.store.renew(&task.claim.lease, self.options.lease, now.stage, now.percent).await {
                Ok(()) => (shown, renewed) = (now, Instant::now()),
                Err(StorageError::Fenced { .. }) => return Interruption::Lost,
                Err(error) => tracing::warn!(%error, "a lease could not be renewed"),
            }
        }
    }
}

/// What became of writing down a job's end.
pub(super) fn told(ended: Result<(), StorageError>) {
    match ended {
        Ok(()) | Err(StorageError::Fenced { .. }) => {}
        Err(error) => {
            tracing::error!(%error, "the end of a job could not be written; its lease will run out");
        }
    }
}

/// Why a job fails that did not end in time.
pub(super) fn overdue(limit: Duration) -> Fault {
    Fault { code: "time-limit".to_owned(), detail: format!("it did not end within {} s", limit.as_secs()) }
}

async fn run(lane: Lane, task: &Task) -> Result<(), JobError> {
    match (lane, task.claim.job.kind) {
        (Lane::Ingest, _) => ingest(task).await,
        (Lane::Map, JobKind::Registration) => register(task).await,
        (Lane::Map, JobKind::Removal) => remove(task).await,
        (Lane::Map, JobKind::Decision) => decide(task).await,
        (Lane::Map, _) => refine(task).await,
    }
}
