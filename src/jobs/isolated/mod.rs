//! Jobs in processes of their own: what a stranger's upload does to the process that works on it, it does not do to the service.
//!
//! A process is this program again (`cairn work`), started for its first job and kept for the next (see `pool`). It is told which claim to
//! work on, opens the same data directory, and speaks to the service by the rows, beside a line when it begins and one when it is done
//! (`message`). It may use a limited amount of memory, is killed when its job's time is over or when it does not let go of a job that
//! was dismissed, and ends with the service. If it dies, that counts against its job; a job that is suspect gets a process that nobody
//! used before or will use after it.

mod cores;
mod inside;
mod memory;
mod message;
mod pool;
mod process;

use std::io;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::Duration;

use serde::Deserialize;
use tokio::time::Instant;

use cores::Cores;
pub use inside::work_for_service;
use memory::taken_by;
pub use message::{Order, Report};
pub(super) use pool::Processes;
use process::Process;

use super::perform::{Interruption, Performer, overdue, told};
use crate::project::{Fault, Lane, Timestamp};
use crate::storage::Claim;

/// Which jobs get a process of their own.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Isolation {
    /// None.
    Never,
    /// Those during which a process has died before.
    Suspects,
    /// Every job.
    #[default]
    All,
}

/// How jobs get a process of their own.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Isolated {
    /// Which jobs.
    pub which: Isolation,
    /// This program.
    pub program: PathBuf,
    /// Threads that compute in it; 0 is one for each core.
    pub threads: usize,
    /// Whether it logs as JSON.
    pub log_json: bool,
}

/// How long a process may take to let go of a job that was dismissed. After that it is killed, so dismissal never takes longer.
const LETTING_GO: Duration = Duration::from_millis(300);
/// How much longer than its time a job may take until its process is killed, which stops by itself if it can.
const STOPPING: Duration = Duration::from_secs(2);

/// Exit code of a process that could not begin, for want of something that may be there again soon.
pub const NOT_NOW: u8 = 75;

/// What a process at work came to.
enum End {
    /// It says so.
    Reported(Report),
    /// It is gone.
    Died(ExitStatus),
    /// Nothing can be heard of it.
    Silent(io::Error),
    /// It is to stop.
    Interrupted(Interruption),
}

/// What is to be written down of a job that its process is no longer at.
enum Verdict {
    /// Nothing, if the process has done so; otherwise somebody else may have it.
    Settled,
    /// It is to be tried again in a moment.
    NotNow,
    /// It did something to its process.
    Crashed(Fault),
}

impl Performer {
    /// Whether a job gets a process of its own.
    pub fn isolates(&self, claim: &Claim) -> Option<&Isolated> {
        self.options.isolated.as_ref().filter(|isolated| match isolated.which {
            Isolation::Never => false,
            Isolation::Suspects => claim.suspect,
            Isolation::All => true,
        })
    }

    /// Has the job done by a process of its own, and sees to it that it ends.
    pub async fn perform_isolated(&self, isolated: &Isolated, lane: Lane, claim: Claim) {
        let (lease, project) = (claim.lease.clone(), claim.job.project);
        let (at_work, known) = self.processes.begin(lane, project, claim.suspect, &self.options);
        let (mut process, limit) = match self.begin(isolated, lane, &claim, known).await {
            Ok(begun) => begun,
            Err(error) => {
                tracing::error!(error, "no process could be started for a job");
                return told(self.store.postpone(&lease).await);
            }
        };
        tracing::info!(lane = lane.as_str(), process = process.id(), "job begins in a process of its own");
        let id = process.id();
        let end = tokio::select! {
            report = process.report() => heard(report),
            why = self.watch(&claim, limit, id) => End::Interrupted(why),
        };
        let (verdict, kept) = match end {
            End::Reported(Report::Done) => (Verdict::Settled, true),
            End::Reported(Report::NotNow) => (Verdict::NotNow, false),
            // It has ended the job, or could not write down how.
            End::Died(status) if status.success() => (Verdict::Settled, false),
            End::Died(status) if status.code() == Some(NOT_NOW.into()) => (Verdict::NotNow, false),
            End::Died(status) => {
                tracing::error!(%status, "the process of a job died");
                (Verdict::Crashed(died(status)), false)
            }
            End::Silent(error) => (Verdict::Crashed(silent(&error)), false),
            End::Interrupted(Interruption::Lost) => (Verdict::Settled, lets_go(&mut process).await),
            End::Interrupted(Interruption::Stopping) => (Verdict::Settled, false),
            End::Interrupted(Interruption::Overdue) => {
                tracing::warn!("a job's time is over; its process is killed");
                (Verdict::Crashed(overdue(limit)), false)
            }
            End::Interrupted(Interruption::Silent) => {
                tracing::warn!("the process of a job has fallen silent; it is killed");
                (Verdict::Crashed(fell_silent()), false)
            }
            End::Interrupted(Interruption::TooLarge) => {
                tracing::warn!("a job takes more memory than it may; its process is killed");
                (Verdict::Crashed(too_large(self.options.memory_bytes)), false)
            }
        };
        if kept && !claim.suspect {
            self.processes.keep(at_work, process, project, &self.options, std::time::Instant::now());
        } else {
            process.kill().await;
            drop(at_work);
        }
        match verdict {
            Verdict::Settled => self.write_down(|| self.store.release(&lease)).await,
            Verdict::NotNow => self.write_down(|| self.store.postpone(&lease)).await,
            Verdict::Crashed(fault) => self.write_down(|| self.store.crashed(&lease, &fault)).await,
        }
        self.store.relay_freed(lease.all());
    }

    /// Has a process begin, a new one if none is known. Returns how long it may take, too.
    async fn begin(
        &self,
        isolated: &Isolated,
        lane: Lane,
        claim: &Claim,
        known: Option<Process>,
    ) -> Result<(Process, Duration), String> {
        let limit = self.time_limit(lane, claim).await.map_err(|e| e.to_string())?;
        let order = Order::Work { job: claim.job.id, attempt: claim.lease.attempt };
        let mut process = match known {
            Some(process) => process,
            None => {
                Process::start(isolated, &self.options, self.store.data(), lane).map_err(|e| e.to_string())?
            }
        };
        process.order(order).await.map_err(|e| e.to_string())?;
        Ok((process, limit))
    }

    /// Watches the claim while a process works on it, passes on what clients wait for, and has it make room for them.
    async fn watch(&self, claim: &Claim, limit: Duration, process: Option<u32>) -> Interruption {
        // The process stops by itself when its time is over; it is killed if it does not.
        let limit = limit + STOPPING;
        let mut changes = self.store.changes();
        let mut tick = tokio::time::interval(self.options.progress_every);
        let (begun, mut seen) = (Instant::now(), claim.job.revision);
        let mut cores = Cores::default();
        let mut unrenewed: Option<Instant> = None;
        loop {
            tokio::select! {
                _ = tick.tick() => if let Some(process) = process {
                    cores.spare_one(process, self.demand.is_high(std::time::Instant::now()));
                },
                change = changes.recv() => {
                    if change.is_ok_and(|id| claim.lease.all().all(|own| own != id)) {
                        continue;
                    }
                }
                () = self.stop.cancelled() => return Interruption::Stopping,
            }
            if begun.elapsed() > limit {
                return Interruption::Overdue;
            }
            if process.and_then(taken_by).is_some_and(|bytes| bytes > self.options.memory_bytes) {
                return Interruption::TooLarge;
            }
            match self.store.holds(&claim.lease).await {
                Ok(Some(held)) => {
                    if held.revision != seen {
                        // What is told here comes back as a change, and is known then.
                        seen = held.revision;
                        self.store.relay(claim.lease.all());
                    }
                    // Whoever sweeps up old claims may be kept from it by this very process, which may hold the database locked.
                    if held.until >= Timestamp::now() {
                        unrenewed = None;
                    } else if unrenewed.get_or_insert_with(Instant::now).elapsed() > self.options.lease {
                        return Interruption::Silent;
                    }
                }
                // Ended by the process itself, which is about to say so, or taken away.
                Ok(None) => return Interruption::Lost,
                Err(error) => tracing::warn!(%error, "the claim of a job cannot be watched"),
            }
        }
    }
}

/// Tells a process to let go of its job. Returns whether it has, so that it can be given another.
async fn lets_go(process: &mut Process) -> bool {
    let let_go = async {
        process.order(Order::Stop).await.is_ok() && matches!(heard(process.report().await), End::Reported(_))
    };
    tokio::time::timeout(LETTING_GO, let_go).await.unwrap_or(false)
}

fn heard(report: io::Result<Result<Report, ExitStatus>>) -> End {
    match report {
        Ok(Ok(report)) => End::Reported(report),
        Ok(Err(status)) => End::Died(status),
        Err(error) => End::Silent(error),
    }
}

fn silent(error: &io::Error) -> Fault {
    Fault { code: "worker-lost".to_owned(), detail: format!("its process cannot be heard: {error}") }
}

/// Why a job fails whose process lives and does nothing.
fn fell_silent() -> Fault {
    let detail = "the process that worked on it alone fell silent for longer than its lease, again and again";
    Fault { code: "worker-lost".to_owned(), detail: detail.to_owned() }
}

/// Why a job fails whose process died.
fn died(status: ExitStatus) -> Fault {
    let detail = format!(
        "the process that worked on it alone died ({status}), again and again; it needs more memory than a worker may use, or \
         sets off a fault of this program"
    );
    Fault { code: "worker-lost".to_owned(), detail }
}

/// Why a job fails whose process took too much memory.
fn too_large(most: u64) -> Fault {
    let detail = format!("it needs more than the {} MiB of memory that a worker may use", most >> 20);
    Fault { code: "memory-limit".to_owned(), detail }
}
