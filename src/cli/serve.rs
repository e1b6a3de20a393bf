//! `cairn serve`: the service, until it is told to stop.

use std::path::PathBuf;

use clap::Args;
use tokio_util::sync::CancellationToken;

use super::signals::{INTERRUPTED, signal};
use crate::config::Settings;
use crate::jobs::answer_promptly;
use crate::{app, telemetry};

/// Run the service
#[derive(Debug, Clone, Args)]
pub struct ServeArgs {
    /// TOML file with settings; flags and environment win over it
    #[arg(long, env = "CAIRN_CONFIG", value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// The settings.
    #[command(flatten)]
    pub settings: Settings,
}

/// Serves until SIGINT or SIGTERM, then shuts down softly; a second signal ends the process at once.
pub fn run(args: ServeArgs) -> anyhow::Result<()> {
    let file = args.config.as_deref().map(Settings::from_file).transpose()?.unwrap_or_default();
    let config = Settings { program: Some(this_program()), ..args.settings.or(file) }.resolve()?;
    let _telemetry = telemetry::init(config.log_json)?;
    // Before there are threads: they inherit it.
    answer_promptly();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(async {
        let running = app::start(config).await?;
        println!("listening on {}", running.url());
        tokio::spawn(stop_on_signal(running.stopper()));
        running.wait().await;
        Ok(())
    })
}

/// This very program, even if its file was replaced since it started.
pub(super) fn this_program() -> PathBuf {
    let running = PathBuf::from("/proc/self/exe");
    if running.exists() { running } else { std::env::current_exe().unwrap_or(running) }
}

async fn stop_on_signal(stop: CancellationToken) {
    signal().await;
    tracing::info!("stopping");
    stop.cancel();
    signal().await;
    std::process::exit(INTERRUPTED.into());
}
