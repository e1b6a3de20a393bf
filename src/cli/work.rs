//! `cairn work`: jobs in a process of their own. The service starts it and speaks to it; nobody else should.

use std::io::{self, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use rustix::process::{Resource, Rlimit, setrlimit, setsid};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;

use crate::config::Settings;
use crate::jobs::{Compute, NOT_NOW, Order, Report, work_for_service, yield_to_clients};
use crate::storage::Store;
use crate::telemetry;

/// Do jobs that the service has claimed, as it orders on standard input
#[derive(Debug, Clone, Args)]
pub struct WorkArgs {
    #[arg(long)]
    data: PathBuf,
    #[arg(long)]
    threads: usize,
    #[arg(long)]
    max_points: u64,
    #[arg(long)]
    memory_bytes: u64,
    #[arg(long)]
    lease_seconds: u64,
    #[arg(long)]
    job_seconds: u64,
    #[arg(long, action = clap::ArgAction::Set)]
    log_json: bool,
}

/// Addresses that threads and libraries take without using the memory, bytes.
const RESERVED: u64 = 4 << 30;

/// Does jobs until the service ends. How they ended is in their rows; the exit code only tells that the process lived.
///
/// # Errors
/// If settings make no sense or the pool cannot be started.
pub fn run(args: &WorkArgs) -> anyhow::Result<ExitCode> {
    yield_to_clients();
    stand_apart();
    let _telemetry = telemetry::init(args.log_json)?;
    limit_memory(args.memory_bytes)?;
    let settings = Settings {
        data: Some(args.data.clone()),
        max_points: Some(args.max_points),
        worker_memory_bytes: Some(args.memory_bytes),
        lease_seconds: Some(args.lease_seconds),
        job_seconds: Some(args.job_seconds),
        ..Settings::default()
    };
    let config = settings.resolve()?;
    let orders = listen()?;
    let compute = Compute::new(args.threads)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let worked = runtime.block_on(async {
        // A signal to the service and its processes, as at a shutdown, is the service's business: dying of it would look like a crash.
        let _ignored = [SignalKind::terminate(), SignalKind::interrupt()].map(signal);
        let store = match Store::open_for_service(&args.data).await {
            Ok(store) => store,
            Err(error) => {
                tracing::error!(%error, "no job can begin");
                return ExitCode::from(NOT_NOW);
            }
        };
        match work_for_service(store, compute, config.workers, orders, tell).await {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                tracing::debug!(%error, "the service is gone, and nobody hears that a job is done");
                ExitCode::from(NOT_NOW)
            }
        }
    });
    // A thread that does not stop is left behind.
    runtime.shutdown_timeout(Duration::ZERO);
    Ok(worked)
}

/// Makes this process a session of its own. Where autogroups are on, Linux shares the processor out by sessions first: in that of the
/// service, what is computed here would be taken from what the service may use to answer its clients. The session itself is no nicer than
/// others: beside other busy programs it would get next to nothing, also while it holds the database's write lock.
fn stand_apart() {
    // It is refused to whoever leads a group of processes, such as one that a person started.
    let _ = setsid();
}

/// A computation that needs more than its memory fails here, and not the service or its neighbours; and nobody wants that memory on disk.
fn limit_memory(bytes: u64) -> io::Result<()> {
    let most = bytes.saturating_add(RESERVED);
    setrlimit(Resource::As, Rlimit { current: Some(most), maximum: Some(most) })?;
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) })?;
    // When the machine has no memory left, the system ends a process: this rather than the service. Not told everywhere.
    let _ = std::fs::write("/proc/self/oom_score_adj", "1000");
    Ok(())
}

/// The orders from standard input. When it ends, as it does however the service ends, so does this process.
fn listen() -> io::Result<mpsc::Receiver<Order>> {
    let (sender, orders) = mpsc::channel(4);
    let listen = move || {
        for line in io::stdin().lines() {
            let order =
                line.map_err(|e| e.to_string()).and_then(|line| line.parse().map_err(|e| format!("{e}")));
            match order {
                Ok(order) if sender.blocking_send(order).is_ok() => {}
                Ok(_) => break,
                Err(error) => {
                    tracing::error!(error, "an order cannot be read");
                    break;
                }
            }
        }
        std::process::exit(NOT_NOW.into());
    };
    std::thread::Builder::new().name("service".to_owned()).spawn(listen)?;
    Ok(orders)
}

/// Reports on standard output.
fn tell(report: Report) -> io::Result<()> {
    let mut output = io::stdout().lock();
    writeln!(output, "{report}")?;
    output.flush()
}
