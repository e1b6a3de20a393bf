//! `cairn work`: one job in a process of its own. The service starts it; nobody else should.

use std::io::Read;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use rustix::process::{Resource, Rlimit, setrlimit};
use tokio::signal::unix::{SignalKind, signal};

use crate::config::Settings;
use crate::jobs::{Compute, NOT_NOW, work_alone, yield_to_clients};
use crate::project::JobId;
use crate::storage::{StorageError, Store};
use crate::telemetry;

/// Do one job that the service has claimed
#[derive(Debug, Clone, Args)]
pub struct WorkArgs {
    #[arg(long)]
    data: PathBuf,
    #[arg(long)]
    job: JobId,
    #[arg(long)]
    attempt: u32,
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

/// Does the job. How it ended is in its row; the exit code only tells that the process lived.
///
/// # Errors
/// If settings make no sense or the pool cannot be started.
pub fn run(args: &WorkArgs) -> anyhow::Result<ExitCode> {
    yield_to_clients();
    let _telemetry = telemetry::init(args.log_json)?;
    die_with_the_service()?;
    // A computation that needs more fails here, and not the service or its neighbours; and nobody wants its memory on disk.
    let most = args.memory_bytes.saturating_add(RESERVED);
    setrlimit(Resource::As, Rlimit { current: Some(most), maximum: Some(most) })?;
    setrlimit(Resource::Core, Rlimit { current: Some(0), maximum: Some(0) })?;
    let settings = Settings {
        data: Some(args.data.clone()),
        max_points: Some(args.max_points),
        worker_memory_bytes: Some(args.memory_bytes),
        lease_seconds: Some(args.lease_seconds),
        job_seconds: Some(args.job_seconds),
        ..Settings::default()
    };
    let config = settings.resolve()?;
    let compute = Compute::new(args.threads)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build()?;
    let worked = runtime.block_on(async {
        // A signal to the service and its processes, as at a shutdown, is the service's business: dying of it would look like a crash.
        let _ignored = [SignalKind::terminate(), SignalKind::interrupt()].map(signal);
        let store = Store::open_for_service(&args.data).await?;
        work_alone(store, compute, config.workers, args.job, args.attempt).await
    });
    // A thread that does not stop is left behind.
    runtime.shutdown_timeout(Duration::ZERO);
    Ok(match worked {
        Ok(()) | Err(StorageError::Fenced { .. }) => ExitCode::SUCCESS,
        Err(error) => {
            tracing::error!(%error, "a job cannot begin");
            ExitCode::from(NOT_NOW)
        }
    })
}

/// Ends this process when the pipe from the service ends, as it does however the service ends.
fn die_with_the_service() -> std::io::Result<()> {
    let wait = || {
        // Nothing is ever sent: reading returns when there is nobody any more who could send.
        let _ = std::io::stdin().read(&mut [0]);
        std::process::exit(NOT_NOW.into());
    };
    std::thread::Builder::new().name("service".to_owned()).spawn(wait).map(|_| ())
}
