//! A process that does jobs, as the service holds it.

use std::io;
use std::num::NonZero;
use std::path::Path;
use std::process::{ExitStatus, Stdio};

use tokio::io::{AsyncBufReadExt, AsyncWriteExt, BufReader, Lines};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

use super::Isolated;
use super::memory::taken_by;
use super::message::{Order, Report};
use super::pool::Resident;
use crate::jobs::workers::WorkerOptions;
use crate::project::{Lane, ProjectId};

/// A process that does one job after the other. It is killed when this is dropped, and ends by itself when the service does,
/// however that ends: it listens to a pipe that the service holds open.
#[derive(Debug)]
pub(in crate::jobs) struct Process {
    child: Child,
    orders: ChildStdin,
    reports: Lines<BufReader<ChildStdout>>,
    lane: Lane,
    worked_on: Vec<ProjectId>,
}

impl Process {
    /// Starts a process that waits for orders.
    pub fn start(isolated: &Isolated, options: &WorkerOptions, data: &Path, lane: Lane) -> io::Result<Self> {
        // Counted here: a process that leaves a core to others when it starts would see too few for all its life.
        let all = || std::thread::available_parallelism().map_or(1, NonZero::get);
        let threads = if isolated.threads == 0 { all() } else { isolated.threads };
        let mut command = Command::new(&isolated.program);
        command.arg("work").arg("--data").arg(data);
        for (flag, value) in [
            ("--threads", threads.to_string()),
            ("--max-points", options.max_points.to_string()),
            ("--memory-bytes", options.memory_bytes.to_string()),
            ("--lease-seconds", options.lease.as_secs().max(1).to_string()),
            ("--job-seconds", options.job_limit.as_secs().max(1).to_string()),
            ("--log-json", isolated.log_json.to_string()),
        ] {
            command.arg(flag).arg(value);
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).kill_on_drop(true).spawn()?;
        let (Some(orders), Some(reports)) = (child.stdin.take(), child.stdout.take()) else {
            return Err(io::Error::other("its pipes are missing"));
        };
        let reports = BufReader::new(reports).lines();
        Ok(Self { child, orders, reports, lane, worked_on: Vec::new() })
    }

    /// What the system calls it, while it runs.
    pub fn id(&self) -> Option<u32> {
        self.child.id()
    }

    /// Tells it what to do.
    pub async fn order(&mut self, order: Order) -> io::Result<()> {
        self.orders.write_all(format!("{order}\n").as_bytes()).await
    }

    /// Its next report, or how it ended instead. May be dropped and called again.
    pub async fn report(&mut self) -> io::Result<Result<Report, ExitStatus>> {
        match self.reports.next_line().await? {
            Some(line) => line.parse().map(Ok).map_err(io::Error::other),
            None => self.child.wait().await.map(Err),
        }
    }

    /// Ends it at once.
    pub async fn kill(mut self) {
        if !self.lives() {
            return;
        }
        if let Err(error) = self.child.kill().await {
            tracing::error!(%error, "the process of a job cannot be killed");
        }
    }
}

impl Resident for Process {
    fn lives(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    fn memory(&self) -> u64 {
        self.id().and_then(taken_by).unwrap_or(0)
    }

    fn lane(&self) -> Lane {
        self.lane
    }

    fn worked_on(&mut self) -> &mut Vec<ProjectId> {
        &mut self.worked_on
    }
}
