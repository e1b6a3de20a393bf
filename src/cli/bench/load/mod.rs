//! `cairn bench load`: what a service bears. It is started on an empty directory, or one that runs is named.
//!
//! Three things are measured: how fast a large upload is beside what the same disk writes with synced blocks, how fast a poll is answered
//! while nothing else happens, and how fast everything is while many clients upload, poll and download at once; and how much memory
//! the service's processes took.

mod clients;
mod disk;
mod figures;
mod service;

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use serde_json::json;

use crate::jobs::answer_promptly;
use clients::Crowd;
use figures::{Figures, Latencies, median};
use service::Service;

/// Measure how a service bears many clients: latencies, upload throughput beside the disk's, memory
#[derive(Debug, Clone, Args)]
pub(super) struct LoadArgs {
    /// Clients at once; a fifth uploads, three fifths poll, a fifth downloads
    #[arg(long, default_value_t = 200)]
    clients: usize,
    /// How long they are at it, seconds
    #[arg(long, default_value_t = 120)]
    seconds: u64,
    /// How long each waits between requests, on average, milliseconds
    #[arg(long, default_value_t = 1000)]
    pause_ms: u64,
    /// Size of the large upload, mebibytes; 0: none
    #[arg(long, default_value_t = 1024)]
    upload_mib: usize,
    /// Where the service keeps its state: an empty directory on the disk to be measured
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Further flags for the service, such as --workers=4
    #[arg(last = true)]
    flags: Vec<String>,
    /// Print the report as JSON
    #[arg(long)]
    json: bool,
}

/// Large uploads, and blocks of the disk beside each: the median counts.
const ROUNDS: usize = 3;
/// Polls of a service that does nothing else.
const QUIET_POLLS: usize = 1000;

/// Runs the command.
pub(super) fn run(args: &LoadArgs) -> anyhow::Result<ExitCode> {
    // Clients are elsewhere and wait for no processor of the service's machine.
    answer_promptly();
    tokio::runtime::Builder::new_multi_thread().enable_all().build()?.block_on(measure(args))
}

async fn measure(args: &LoadArgs) -> anyhow::Result<ExitCode> {
    let service = Service::start(&args.data, &args.flags)?;
    let mut report = json!({});
    if args.upload_mib > 0 {
        let (disk, upload) = throughput(args, &service).await?;
        report["disk_mb_per_s"] = json!(disk.round());
        report["upload_mb_per_s"] = json!(upload.round());
        report["upload_of_disk"] = json!((upload / disk * 100.0).round() / 100.0);
    }
    let quiet = quiet_poll(&service).await?;
    report["quiet_poll_ms"] = quiet.report();
    let crowd = Crowd::gather(&service, args.clients, Duration::from_millis(args.pause_ms)).await?;
    let figures: Figures = crowd.work(Duration::from_secs(args.seconds)).await;
    report["clients"] = json!(args.clients);
    report["requests"] = figures.report();
    let ratio = figures.polls().quantile(0.99).as_secs_f64() / quiet.quantile(0.5).as_secs_f64().max(1e-9);
    report["loaded_p99_of_quiet_median"] = json!((ratio * 10.0).round() / 10.0);
    report["memory"] = service.memory();
    report["refused"] = json!(figures.refused);
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        println!("{}", figures::text(&report));
    }
    let failed = figures.refused.keys().any(|what| !what.starts_with('4'));
    Ok(if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Megabytes a second: the disk with synced blocks, and an upload. Each is the median of a few, taken in turns.
async fn throughput(args: &LoadArgs, service: &Service) -> anyhow::Result<(f64, f64)> {
    let project = service.project("throughput").await?;
    let (mut disk, mut upload) = (Vec::new(), Vec::new());
    for round in 0..=ROUNDS {
        let written = disk::write(&args.data, args.upload_mib)?;
        let sent = clients::large_upload(service, &project, args.upload_mib, round).await?;
        // The first round only finds files and connections their place.
        if round > 0 {
            disk.push(written);
            upload.push(sent);
        }
    }
    service.delete(&project).await?;
    Ok((median(disk), median(upload)))
}

async fn quiet_poll(service: &Service) -> anyhow::Result<Latencies> {
    let project = service.project("quiet").await?;
    let job = clients::finished_job(service, &project).await?;
    let mut latencies = Latencies::default();
    for _ in 0..QUIET_POLLS {
        latencies.push(service.timed(&job).await?);
    }
    Ok(latencies)
}
