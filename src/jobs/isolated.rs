//! Jobs in a process of their own: what a stranger's upload does to the process that reads it, it does not do to the service.
//!
//! Uploads are decoded and prepared there, and so is every job during which a process has died before. The process is this program
//! again (`cairn work`), told which claim it works on; it opens the same data directory, and speaks to the service by the rows only.
//! It may use a limited amount of memory, is killed when its time is over or its job was dismissed, and ends with the service,
//! however that ends: it listens to a pipe that the service holds open. If it dies, that counts against its job.

use std::ffi::OsString;
use std::path::PathBuf;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;

use serde::Deserialize;
use tokio::process::{Child, Command};
use tokio::time::Instant;
use tokio_util::sync::CancellationToken;

use super::Compute;
use super::perform::{Interruption, Performer, overdue, told};
use super::workers::WorkerOptions;
use crate::project::{Fault, JobId, Lane};
use crate::storage::{Claim, StorageError, Store};

/// Which jobs get a process of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Isolation {
    /// None.
    Never,
    /// Those during which a process has died before.
    Suspects,
    /// These, and every job that reads an upload for the first time.
    #[default]
    Uploads,
}

/// How jobs get a process of their own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Isolated {
    /// Which jobs.
    pub which: Isolation,
    /// This program.
    pub program: PathBuf,
    /// Threads that compute in it.
    pub threads: usize,
    /// Whether it logs as JSON.
    pub log_json: bool,
}

/// How long a job that was told to stop is waited for in a process of its own, whose end harms nobody.
const ALONE: Duration = Duration::from_secs(1);

/// Exit code of a process that could not begin, for want of something that may be there again soon.
pub const NOT_NOW: u8 = 75;

impl Performer {
    /// Whether a job gets a process of its own.
    pub fn isolates(&self, lane: Lane, claim: &Claim) -> Option<&Isolated> {
        self.options.isolated.as_ref().filter(|isolated| match isolated.which {
            Isolation::Never => false,
            Isolation::Suspects => claim.suspect,
            Isolation::Uploads => claim.suspect || lane == Lane::Ingest,
        })
    }

    /// Has the job done by a process of its own, and sees to it that it ends.
    pub async fn perform_isolated(&self, isolated: &Isolated, lane: Lane, claim: Claim) {
        let lease = claim.lease.clone();
        let begun = match self.time_limit(lane, &claim).await {
            Ok(limit) => self.spawn(isolated, &claim).map(|child| (child, limit)).map_err(|e| e.to_string()),
            Err(error) => Err(error.to_string()),
        };
        let (mut child, limit) = match begun {
            Ok(begun) => begun,
            Err(error) => {
                tracing::error!(error, "no process could be started for a job");
                return told(self.store.postpone(&lease).await);
            }
        };
        // Waiting would close it, and it must be open for as long as the process shall live.
        let pipe = child.stdin.take();
        tracing::info!(lane = lane.as_str(), process = child.id(), "job begins in a process of its own");
        let ended = tokio::select! {
            status = child.wait() => Ok(status),
            why = self.watch(&claim, limit) => Err(why),
        };
        drop(pipe);
        let status = match ended {
            Ok(Ok(status)) => Ok(status),
            Ok(Err(error)) => Err(Some(broken(&error.to_string()))),
            Err(why) => {
                if why == Interruption::Overdue {
                    tracing::warn!("a job's time is over; its process is killed");
                }
                if let Err(error) = child.kill().await {
                    tracing::error!(%error, "the process of a job cannot be killed");
                }
                Err((why == Interruption::Overdue).then(|| overdue(limit)))
            }
        };
        match status {
            // It has ended the job, or could not write down how.
            Ok(status) if status.success() => told(self.store.release(&lease).await),
            Ok(status) if status.code() == Some(NOT_NOW.into()) => told(self.store.postpone(&lease).await),
            Ok(status) => {
                tracing::error!(%status, "the process of a job died");
                told(self.store.crashed(&lease, &died(status)).await);
            }
            Err(Some(fault)) => told(self.store.crashed(&lease, &fault).await),
            Err(None) => told(self.store.release(&lease).await),
        }
        self.store.relay(lease.all());
    }

    fn spawn(&self, isolated: &Isolated, claim: &Claim) -> std::io::Result<Child> {
        let options = &self.options;
        let mut command = Command::new(&isolated.program);
        command.arg("work").arg("--data").arg(self.store.data());
        for (flag, value) in [
            ("--job", claim.job.id.to_string()),
            ("--attempt", claim.lease.attempt.to_string()),
            ("--threads", isolated.threads.to_string()),
            ("--max-points", options.max_points.to_string()),
            ("--memory-bytes", options.memory_bytes.to_string()),
            ("--lease-seconds", options.lease.as_secs().max(1).to_string()),
            ("--job-seconds", options.job_limit.as_secs().max(1).to_string()),
            ("--log-json", isolated.log_json.to_string()),
        ] {
            command.arg(flag).arg(OsString::from(value));
        }
        command.stdin(Stdio::piped()).stdout(Stdio::null()).kill_on_drop(true).spawn()
    }

    /// Watches the claim while another process works on it, and passes on what clients wait for.
    async fn watch(&self, claim: &Claim, limit: Duration) -> Interruption {
        // The process stops by itself when its time is over; it is killed if it does not.
        let limit = limit + 2 * ALONE;
        let mut changes = self.store.changes();
        let mut tick = tokio::time::interval(self.options.progress_every);
        let (begun, mut seen) = (Instant::now(), claim.job.revision);
        loop {
            let ours = tokio::select! {
                _ = tick.tick() => false,
                change = changes.recv() => change.map_or(true, |id| claim.lease.all().any(|own| own == id)),
                () = self.stop.cancelled() => return Interruption::Stopping,
            };
            if begun.elapsed() > limit {
                return Interruption::Overdue;
            }
            match self.store.holds(&claim.lease).await {
                Ok(Some(revision)) if revision != seen => {
                    seen = revision;
                    if !ours {
                        self.store.relay(claim.lease.all());
                    }
                }
                Ok(Some(_)) => {}
                // Ended by the process itself, which is about to exit, or taken away.
                Ok(None) => {
                    tokio::time::sleep(Duration::from_millis(50)).await;
                    return Interruption::Lost;
                }
                Err(error) => tracing::warn!(%error, "the claim of a job cannot be watched"),
            }
        }
    }
}

fn broken(error: &str) -> Fault {
    Fault { code: "worker-lost".to_owned(), detail: format!("its process cannot be watched: {error}") }
}

/// Why a job fails whose process died.
fn died(status: ExitStatus) -> Fault {
    let detail = format!(
        "the process that worked on it alone died ({status}), again and again; it needs more memory than a worker may use, or \
         sets off a fault of this program"
    );
    Fault { code: "worker-lost".to_owned(), detail }
}

/// Does one claimed job in this process, which does nothing else.
///
/// # Errors
/// If the data directory cannot be opened or the claim is gone: nothing was done.
pub async fn work_alone(
    store: Store,
    compute: Compute,
    options: WorkerOptions,
    job: JobId,
    attempt: u32,
) -> Result<(), StorageError> {
    let (lane, claim) = store.held(job, attempt).await?;
    let performer = Performer {
        store,
        compute,
        models: std::sync::Arc::default(),
        options,
        stop: CancellationToken::new(),
        patience: ALONE,
    };
    let store = performer.store.clone();
    performer.perform(lane, claim).await;
    // What it found damaged nobody else knows.
    store.settle_damage().await.map(|_| ())
}
