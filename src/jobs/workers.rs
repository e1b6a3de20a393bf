//! The worker pool: loops that claim a job, do it, and watch the claim while it runs.

use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::decide::decide;
use super::ingest::ingest;
use super::model_cache::ModelCache;
use super::progress::ProgressSink;
use super::refine::refine;
use super::register::register;
use super::remove::remove;
use super::session::Task;
use super::{Compute, JobError};
use crate::control::CancelToken;
use crate::project::{JobKind, Lane};
use crate::storage::{Claim, StorageError, Store};

/// How the pool works.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WorkerOptions {
    /// Jobs at once.
    pub workers: usize,
    /// How long a claim lasts without being renewed.
    pub lease: Duration,
    /// How often idle workers look at the queue even if nobody called them.
    pub poll: Duration,
    /// How often progress is written, at most.
    pub progress_every: Duration,
    /// Scans that one mapping job takes at once, at most.
    pub batch: u32,
    /// Points that one scan may have.
    pub max_points: u64,
    /// How often files are deleted that nothing needs any more.
    pub collect_every: Duration,
    /// How long a stopping worker is waited for.
    pub grace: Duration,
}

/// The running pool.
#[derive(Debug)]
pub struct Workers {
    stop: CancellationToken,
    loops: JoinSet<()>,
    grace: Duration,
}

struct Pool {
    store: Store,
    compute: Compute,
    models: Arc<ModelCache>,
    options: WorkerOptions,
    stop: CancellationToken,
}

impl Workers {
    /// Takes back what a dead process left claimed, then starts the loops.
    pub async fn start(store: Store, compute: Compute, options: WorkerOptions) -> Result<Self, StorageError> {
        let left = store.reclaim(true).await?;
        if left > 0 {
            tracing::info!(jobs = left, "jobs of a process that ended are taken up again");
        }
        let stop = CancellationToken::new();
        let grace = options.grace;
        let workers = options.workers.max(1);
        let pool = Arc::new(Pool { store, compute, models: Arc::default(), options, stop: stop.clone() });
        let mut loops = JoinSet::new();
        for index in 0..workers {
            let pool = Arc::clone(&pool);
            loops.spawn(async move { pool.work(&format!("{}-{index}", std::process::id())).await });
        }
        let sweeper = Arc::clone(&pool);
        loops.spawn(async move { sweeper.sweep().await });
        loops.spawn(async move { pool.collect().await });
        Ok(Self { stop, loops, grace })
    }

    /// Stops claiming, cancels what runs, gives it back, and waits; after the grace period it waits no longer.
    pub async fn stop(mut self) {
        self.stop.cancel();
        let all = async { while self.loops.join_next().await.is_some() {} };
        if tokio::time::timeout(self.grace, all).await.is_err() {
            tracing::warn!("workers did not stop in time; their jobs will be taken up at the next start");
            self.loops.abort_all();
        }
    }
}

impl Pool {
    async fn work(&self, worker: &str) {
        while !self.stop.is_cancelled() {
            match self.claim(worker).await {
                Ok(Some((lane, claim))) => {
                    let span = tracing::info_span!("job", job = %claim.job.id, kind = %claim.job.kind,
                        project = %claim.job.project, attempt = claim.job.attempt);
                    self.perform(lane, claim).instrument(span).await;
                }
                Ok(None) => self.idle().await,
                Err(error) => {
                    tracing::error!(%error, "the queue cannot be read");
                    self.idle().await;
                }
            }
        }
    }

    /// Mapping first: it is what clients wait for, and only one worker a project can be at it.
    async fn claim(&self, worker: &str) -> Result<Option<(Lane, Claim)>, StorageError> {
        for lane in [Lane::Map, Lane::Ingest] {
            let batch = self.options.batch;
            if let Some(claim) = self.store.claim(lane, worker, self.options.lease, batch).await? {
                return Ok(Some((lane, claim)));
            }
        }
        Ok(None)
    }

    async fn idle(&self) {
        tokio::select! {
            () = self.store.work() => {}
            () = tokio::time::sleep(self.options.poll) => {}
            () = self.stop.cancelled() => {}
        }
    }

    /// Takes back claims whose lease ran out.
    async fn sweep(&self) {
        let mut tick = tokio::time::interval(self.options.lease / 2);
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = self.stop.cancelled() => return,
            }
            match self.store.reclaim(false).await {
                Ok(0) => {}
                Ok(jobs) => tracing::warn!(jobs, "leases ran out; the jobs are queued again"),
                Err(error) => tracing::error!(%error, "leases cannot be checked"),
            }
        }
    }

    /// Deletes files that nothing needs any more, from time to time: nobody waits for it.
    async fn collect(&self) {
        let mut tick = tokio::time::interval(self.options.collect_every);
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = self.stop.cancelled() => return,
            }
            match self.store.collect_garbage().await {
                Ok(0) => {}
                Ok(blobs) => tracing::info!(blobs, "files that nothing needs any more are deleted"),
                Err(error) => tracing::error!(%error, "garbage cannot be collected"),
            }
        }
    }

    async fn perform(&self, lane: Lane, claim: Claim) {
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
        let result = {
            let mut run = pin!(run(lane, &task));
            tokio::select! {
                result = &mut run => result,
                () = self.keep(&task) => {
                    // The core looks at the token every few tens of milliseconds.
                    task.cancel.cancel();
                    run.await
                }
            }
        };
        let ended = match result {
            Ok(()) => {
                tracing::info!("job's stage is done");
                Ok(())
            }
            Err(JobError::Lost | JobError::Cancelled(_)) => {
                tracing::info!("job is let go");
                self.store.release(&lease).await
            }
            Err(JobError::Failed { fault, retry }) => {
                tracing::warn!(code = fault.code, detail = fault.detail, retry, "job fails");
                self.store.fail(&lease, &fault, retry).await
            }
        };
        match ended {
            Ok(()) | Err(StorageError::Fenced { .. }) => {}
            Err(error) => {
                tracing::error!(%error, "the end of a job could not be written; its lease will run out");
            }
        }
    }

    /// Renews the claim and shows progress until the claim is lost or the pool stops.
    async fn keep(&self, task: &Task) {
        let mut changes = self.store.changes();
        let mut shown = task.progress.shown();
        let mut renewed = tokio::time::Instant::now();
        let mut tick = tokio::time::interval(self.options.progress_every);
        loop {
            let ours = tokio::select! {
                _ = tick.tick() => false,
                // A listener that lagged behind has missed something that may concern this job.
                change = changes.recv() => change.map_or(true, |id| task.claim.lease.all().any(|own| own == id)),
                () = self.stop.cancelled() => return,
            };
            let now = task.progress.shown();
            if !ours && now == shown && renewed.elapsed() < self.options.lease / 3 {
                continue;
            }
            match self.store.renew(&task.claim.lease, self.options.lease, now.stage, now.percent).await {
                Ok(()) => (shown, renewed) = (now, tokio::time::Instant::now()),
                Err(StorageError::Fenced { .. }) => return,
                Err(error) => tracing::warn!(%error, "a lease could not be renewed"),
            }
        }
    }
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
