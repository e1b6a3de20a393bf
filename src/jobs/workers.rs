//! The worker pool: loops that claim jobs and have them done (see `perform`), and those that keep the store in order.

use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;

use super::isolated::{Isolated, Isolation};
use super::perform::{PATIENCE, Performer};
use super::{Compute, Demand};
use crate::project::Lane;
use crate::storage::{Claim, Overdue, StorageError, Store};

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
    /// Memory that the process of one job may use, bytes.
    pub memory_bytes: u64,
    /// How long a job may take.
    pub job_limit: Duration,
    /// Which jobs get a process of their own, and how; `None`: none.
    pub isolated: Option<Isolated>,
    /// How often files are deleted that nothing needs any more.
    pub collect_every: Duration,
    /// How long a stopping worker is waited for.
    pub grace: Duration,
}

/// How often the folder of blobs is walked for files that nothing names, and deletions whose jobs failed are tried again; the first time at
/// the start.
const WALK_EVERY: Duration = Duration::from_hours(24);
/// How old such a file must be. Whatever is younger may belong to a row that is about to be committed.
const ORPHAN_AGE: Duration = Duration::from_hours(1);
/// How long blobs are spared that a process of a job has stored: so long it may take to commit their rows.
const FRESH: Duration = Duration::from_mins(10);

/// The running pool.
#[derive(Debug)]
pub struct Workers {
    stop: CancellationToken,
    loops: JoinSet<()>,
    grace: Duration,
}

struct Pool(Performer);

impl Workers {
    /// Takes back what a dead process left claimed, then starts the loops. While `demand` is high, processes of jobs leave a core to answers.
    pub async fn start(
        store: Store,
        compute: Compute,
        options: WorkerOptions,
        demand: Arc<Demand>,
    ) -> Result<Self, StorageError> {
        let left = store.reclaim(isolates(&options)).await?;
        if left > 0 {
            tracing::info!(jobs = left, "jobs of a process that ended are taken up again");
        }
        let stop = CancellationToken::new();
        let grace = options.grace;
        let workers = options.workers.max(1);
        let models = Arc::default();
        let pool = Arc::new(Pool(Performer {
            store,
            compute,
            models,
            processes: Arc::default(),
            demand,
            options,
            stop: stop.clone(),
            patience: PATIENCE,
        }));
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
        let mut first = Lane::Map;
        while !self.0.stop.is_cancelled() {
            match self.claim(worker, first).await {
                Ok(Some((lane, claim))) => {
                    first = lane.other();
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

    /// The next job, of the lane `first` if there is one. A worker asks the lanes in turn: a thousand small jobs of the one do not keep a
    /// single one of the other waiting.
    async fn claim(&self, worker: &str, first: Lane) -> Result<Option<(Lane, Claim)>, StorageError> {
        let (store, options) = (&self.0.store, &self.0.options);
        for lane in [first, first.other()] {
            let isolated = isolates(options);
            if let Some(claim) = store.claim(lane, worker, options.lease, options.batch, isolated).await? {
                return Ok(Some((lane, claim)));
            }
        }
        Ok(None)
    }

    async fn perform(&self, lane: Lane, claim: Claim) {
        if let Some(isolated) = self.0.isolates(&claim) {
            self.0.perform_isolated(isolated, lane, claim).await;
        } else {
            self.0.perform(lane, claim).await;
        }
    }

    async fn idle(&self) {
        tokio::select! {
            () = self.0.store.work() => {}
            () = tokio::time::sleep(self.0.options.poll) => {}
            () = self.0.stop.cancelled() => {}
        }
    }

    /// Takes back claims whose lease ran out and that are not renewed until the next look either. Who works renews every third of the
    /// lease, so whoever could not, because the machine slept, its clock was set or the database took nothing, has done so by then.
    async fn sweep(&self) {
        let mut tick = tokio::time::interval(self.0.options.lease / 2);
        let mut silent = Vec::new();
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                () = self.0.stop.cancelled() => return,
            }
            match self.look_after_leases(&silent).await {
                Ok(overdue) => silent = overdue,
                Err(error) => {
                    tracing::error!(%error, "leases cannot be checked");
                    silent.clear();
                }
            }
        }
    }

    /// Takes back the claims that were overdue at the last look and still are; returns those that are overdue now.
    async fn look_after_leases(&self, silent: &[Overdue]) -> Result<Vec<Overdue>, StorageError> {
        let jobs = self.0.store.reclaim_silent(silent, isolates(&self.0.options)).await?;
        if jobs > 0 {
            tracing::warn!(jobs, "leases ran out; the jobs are queued again");
        }
        self.0.store.overdue().await
    }

    /// Deletes files that nothing needs any more, sees to damaged ones, and ends processes that wait for nothing, from time to time: nobody
    /// waits for it.
    async fn collect(&self) {
        let mut tick = tokio::time::interval(self.0.options.collect_every);
        let mut walk = tokio::time::interval(WALK_EVERY);
        let spared = if self.0.options.isolated.is_some() { FRESH } else { Duration::ZERO };
        loop {
            tokio::select! {
                _ = tick.tick() => {}
                _ = walk.tick() => {
                    match self.0.store.queue_removals().await {
                        Ok(0) => {}
                        Ok(scans) => tracing::warn!(scans, "deletions whose jobs failed are tried again"),
                        Err(error) => tracing::error!(%error, "deletions whose jobs failed cannot be looked for"),
                    }
                    match self.0.store.note_orphans(ORPHAN_AGE).await {
                        Ok(0) => {}
                        Ok(files) => tracing::info!(files, "files that a crash left behind are found"),
                        Err(error) => tracing::error!(%error, "files that a crash left behind cannot be looked for"),
                    }
                }
                () = self.0.stop.cancelled() => return,
            }
            self.0.processes.retire(Instant::now());
            if let Err(error) = self.0.store.settle_damage().await {
                tracing::error!(%error, "damage cannot be written down");
            }
            match self.0.store.collect_garbage(spared).await {
                Ok(0) => {}
                Ok(blobs) => tracing::info!(blobs, "files that nothing needs any more are deleted"),
                Err(error) => tracing::error!(%error, "garbage cannot be collected"),
            }
        }
    }
}

/// Whether suspect jobs get a process of their own.
fn isolates(options: &WorkerOptions) -> bool {
    options.isolated.as_ref().is_some_and(|isolated| isolated.which != Isolation::Never)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::{Fault, JobKind};
    use crate::storage::Retry;
    use crate::storage::testing::{Fixture, new_scan, project};

    fn pool(store: &Store) -> Pool {
        let whatever = Duration::from_mins(1);
        Pool(Performer {
            store: store.clone(),
            compute: Compute::new(1).unwrap(),
            models: Arc::default(),
            processes: Arc::default(),
            demand: Arc::new(Demand::new(0)),
            options: WorkerOptions {
                workers: 1,
                lease: whatever,
                poll: whatever,
                progress_every: whatever,
                batch: 10,
                max_points: 1,
                memory_bytes: 1 << 30,
                job_limit: whatever,
                isolated: None,
                collect_every: whatever,
                grace: whatever,
            },
            stop: CancellationToken::new(),
            patience: PATIENCE,
        })
    }

    #[tokio::test]
    async fn one_worker_reads_a_scan_after_one_of_another_projects_many_removals() {
        let at = Fixture::new().await;
        for key in 0..20 {
            let blob = at.blob(&format!("scan {key}"));
            let scan = at.store.admit_scan(&new_scan(at.project, key, *blob)).await.unwrap().scan.id;
            at.store.delete_scan(at.project, scan).await.unwrap();
        }
        let blob = at.blob("single");
        let single = new_scan(project(&at.store).await, 0, *blob);
        let single = at.store.admit_scan(&single).await.unwrap().job.id;
        let pool = pool(&at.store);
        let fault = Fault { code: "internal-error".to_owned(), detail: "for the test".to_owned() };
        let (mut first, mut kinds) = (Lane::Map, Vec::new());
        loop {
            let (lane, claim) = pool.claim("worker", first).await.unwrap().unwrap();
            first = lane.other();
            if claim.job.id == single {
                break;
            }
            kinds.push(claim.job.kind);
            at.store.fail(&claim.lease, &fault, Retry::Never).await.unwrap();
        }
        assert_eq!(kinds, [JobKind::Removal]);
    }
}
