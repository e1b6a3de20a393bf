//! `cairn bench`: what the engine is worth, measured on scenes with known truth. Measures are in [`crate::evaluate`], other strategies
//! in [`crate::baseline`]; here scenes are read, the engine is run and timed, and figures are printed. `pairs.rs` and `load/`, which
//! measures the service, are measures of their own; all other files are `recall`.

mod clock;
mod load;
mod markdown;
mod measure;
mod memory;
mod pairs;
mod published;
mod recall;
mod report;
mod scene;
mod tables;
mod trial;

use std::process::ExitCode;

use clap::{Args, Subcommand};

/// Measure recall, precision and cost on scenes with known truth
#[derive(Debug, Clone, Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    measure: Measure,
}

#[derive(Debug, Clone, Subcommand)]
enum Measure {
    Recall(recall::RecallArgs),
    Pairs(pairs::PairsArgs),
    Load(load::LoadArgs),
}

/// Runs the command.
///
/// # Errors
/// Names the file that cannot be read, or what does not fit together.
pub fn run(args: &BenchArgs) -> anyhow::Result<ExitCode> {
    match &args.measure {
        Measure::Recall(args) => recall::run(args),
        Measure::Pairs(args) => pairs::run(args).map(|()| ExitCode::SUCCESS),
        Measure::Load(args) => load::run(args),
    }
}
