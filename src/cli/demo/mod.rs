//! `cairn demo`: the real service in this process, two rigs that upload to it over HTTP, and what becomes of it.
//!
//! Nothing here touches the engine: all goes through the REST interface, as any client would do it.

mod client;
mod display;
mod figures;
mod survey;

use std::fs::File;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use clap::Args;
use tokio::task::JoinSet;

use super::signals::{INTERRUPTED, signal};
use crate::app::{self, Running};
use crate::config::Settings;
use crate::control::Seed;
use crate::telemetry;
use client::{Client, Model, ScanRow};
use display::{Display, Standing};
use figures::{AgainstTruth, Figures, Seconds};
use survey::{DemoSurvey, RIGS};

/// Show everything at once: a service, two rigs, one model.
///
/// Starts the service with a data directory of its own, simulates a building that two rigs scan, uploads their scans in parallel over
/// HTTP, watches the model grow, runs a global bundle adjustment, downloads poses, merged cloud and picture, and compares the
/// poses with the truth. Then it keeps serving until Ctrl-C.
#[derive(Debug, Clone, Args)]
pub struct DemoArgs {
    /// End instead of serving on
    #[arg(long)]
    pub exit: bool,
    /// Your own scans instead of a simulated building; poses.json in the folder or beside it is taken for the truth
    #[arg(long, value_name = "DIR")]
    pub scans: Option<PathBuf>,
    /// Another seed, another building
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Scans of the simulated building
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u16).range(2..=500), conflicts_with = "scans")]
    pub stations: u16,
    /// Address to listen on [default: 127.0.0.1:8080, or a free port if that is taken]
    #[arg(long, value_name = "ADDRESS")]
    pub listen: Option<SocketAddr>,
    /// Folder for the results; the service keeps its data in it too, and begins anew each time
    #[arg(long, value_name = "DIR", default_value = "cairn-demo")]
    pub dir: PathBuf,
    /// Print the figures as JSON
    #[arg(long)]
    pub json: bool,
}

/// How often the demo asks the service how things stand.
const POLL: Duration = Duration::from_millis(250);
/// How long a rig of the simulated survey takes from one scan to the next. (A real one takes minutes.)
const SCANNING: Duration = Duration::from_millis(400);
/// The file that marks a data directory of the service, and that a running one holds locked.
const LOCK: &str = "cairn.lock";

/// Runs the demo.
///
/// # Errors
/// Where the service does not start, a call fails, or files cannot be read or written.
pub fn run(args: &DemoArgs) -> anyhow::Result<ExitCode> {
    let _telemetry = std::env::var_os("RUST_LOG").map(|_| telemetry::init(false)).transpose()?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let started = Instant::now();
        let running = app::start(settings(args)?.resolve()?).await?;
        let shown = tokio::select! {
            shown = show(args, &running, started) => shown,
            () = signal() => {
                running.stop().await;
                return Ok(ExitCode::from(INTERRUPTED));
            }
        };
        if shown.is_ok() && !args.exit {
            eprintln!("the service runs on at {} until Ctrl-C", running.url());
            signal().await;
        }
        running.stop().await;
        shown.map(|()| ExitCode::SUCCESS)
    })
}

/// Settings of the service: the defaults, on fresh data.
fn settings(args: &DemoArgs) -> anyhow::Result<Settings> {
    std::fs::create_dir_all(&args.dir).with_context(|| format!("cannot create {}", args.dir.display()))?;
    let data = args.dir.join("data");
    if data.exists() {
        let lock = File::open(data.join(LOCK))
            .with_context(|| format!("{} is not of an earlier demo; give another --dir", data.display()))?;
        ensure!(lock.try_lock().is_ok(), "another demo runs in {}; give another --dir", args.dir.display());
        std::fs::remove_dir_all(&data).with_context(|| format!("cannot remove {}", data.display()))?;
    }
    let usual = SocketAddr::from(([127, 0, 0, 1], 8080));
    let free = SocketAddr::from(([127, 0, 0, 1], 0));
    let listen = args.listen.unwrap_or_else(|| if TcpListener::bind(usual).is_ok() { usual } else { free });
    Ok(Settings { listen: Some(listen), data: Some(data), ..Settings::default() })
}

/// The demo itself, on a running service.
async fn show(args: &DemoArgs, running: &Running, started: Instant) -> anyhow::Result<()> {
    let mut display = Display::new(args.json);
    display.say(&format!("the service listens on {}", running.url()));
    let (survey, pause) = survey(args, &display).await?;
    let client = Client::create_project(&running.url(), "demo").await?;

    let uploading = Instant::now();
    let mut last = upload_and_watch(&client, &survey, pause, &mut display).await?;
    let registered = Instant::now();
    let job = client.run_job("global-bundle-adjustment").await?;
    let adjusted = Instant::now();
    if let Some(outcome) = &job.outcome {
        display.say(&format!("global bundle adjustment: {outcome}"));
    }
    let model = client.model().await?;
    last.see_model(&model);
    download(&client, &model, &args.dir).await?;
    let truth =
        survey.truth.map(|truth| AgainstTruth::of(&args.dir.join("poses.json"), &truth)).transpose()?;

    let seconds = Seconds {
        registration: (registered - uploading).as_secs_f64(),
        bundle_adjustment: (adjusted - registered).as_secs_f64(),
        total: started.elapsed().as_secs_f64(),
    };
    let figures = Figures::new(&last, truth, seconds, running.url());
    if args.json {
        println!("{}", serde_json::to_string(&figures)?);
    } else {
        print!("{}", figures.text(&args.dir));
    }
    Ok(())
}

/// The scans, and how long a rig pauses between two of them.
async fn survey(args: &DemoArgs, display: &Display) -> anyhow::Result<(DemoSurvey, Duration)> {
    let (seed, stations, dir) = (Seed(args.seed), args.stations.into(), args.dir.clone());
    if let Some(folder) = args.scans.clone() {
        let survey =
            tokio::task::spawn_blocking(move || DemoSurvey::of_folder(&folder, seed, &dir)).await??;
        display.say(&format!("{} scans", survey.len()));
        return Ok((survey, Duration::ZERO));
    }
    let survey = tokio::task::spawn_blocking(move || DemoSurvey::simulated(seed, stations, &dir)).await??;
    display.say(&format!("a building is simulated and scanned from {} stations", survey.len()));
    Ok((survey, SCANNING))
}

/// Both rigs upload at the same time, while the service registers what it has, until it has come to every scan.
async fn upload_and_watch(
    client: &Client,
    survey: &DemoSurvey,
    pause: Duration,
    display: &mut Display,
) -> anyhow::Result<Standing> {
    let done: Arc<[AtomicUsize; RIGS]> = Arc::default();
    let mut rigs = JoinSet::new();
    for (index, scans) in survey.rigs.iter().cloned().enumerate() {
        let (client, done) = (client.clone(), Arc::clone(&done));
        rigs.spawn(async move {
            let mut refused = Vec::new();
            for scan in scans {
                tokio::time::sleep(pause).await;
                if let Err(error) = client.upload(&scan.name, &scan.path).await {
                    refused.push(format!("{} was refused: {error:#}", scan.name));
                }
                if let Some(done) = done.get(index) {
                    done.fetch_add(1, Ordering::Relaxed);
                }
            }
            refused
        });
    }
    let mut refused = 0;
    loop {
        let uploaded = rigs.is_empty();
        let scans = client.scans().await?;
        let mut now = Standing {
            scans: std::array::from_fn(|i| survey.rigs[i].len()),
            uploaded: std::array::from_fn(|i| done[i].load(Ordering::Relaxed)),
            failed: refused,
            ..Standing::default()
        };
        now.see_scans(&scans);
        now.see_model(&client.model().await?);
        if uploaded && now.queued == 0 {
            display.finish(&now);
            for scan in scans.iter().filter(|scan| matches!(scan.state.as_str(), "waiting" | "failed")) {
                let why = scan.outcome.as_ref().map(ToString::to_string).unwrap_or_default();
                display.say(&format!("{} {}: {why}", scan.name, scan.state));
            }
            return Ok(now);
        }
        display.show(&now);
        tokio::time::sleep(POLL).await;
        while let Some(rig) = rigs.try_join_next() {
            let messages = rig.context("a rig broke down")?;
            refused += messages.len();
            for message in &messages {
                display.say(message);
            }
        }
    }
}

impl Standing {
    fn see_scans(&mut self, scans: &[ScanRow]) {
        for scan in scans {
            match scan.state.as_str() {
                "waiting" => self.waiting += 1,
                "failed" => self.failed += 1,
                _ => self.queued += usize::from(scan.is_queued()),
            }
        }
    }

    fn see_model(&mut self, model: &Model) {
        self.components = model.components.len();
        self.landmarks = model.components.iter().map(|component| component.landmarks).sum();
        self.registered = model.components.iter().map(|component| component.scans.len()).sum();
    }
}

/// Poses of the model, and cloud and picture of its largest component.
async fn download(client: &Client, model: &Model, dir: &Path) -> anyhow::Result<()> {
    let version = model.version;
    client.download(&format!("/poses?version={version}"), &dir.join("poses.json")).await?;
    if !model.components.is_empty() {
        client.download(&format!("/poses?format=tum&version={version}"), &dir.join("poses.tum")).await?;
        client.download(&format!("/cloud?version={version}"), &dir.join("merged.ply")).await?;
        client.download(&format!("/preview?version={version}"), &dir.join("preview.png")).await?;
    }
    Ok(())
}
