//! `cairn bench`: what the engine is worth, measured on scenes with known truth. One file a measure.

mod pairs;

use clap::{Args, Subcommand};

/// Measure recall, precision and cost on scenes with known truth
#[derive(Debug, Clone, Args)]
pub struct BenchArgs {
    #[command(subcommand)]
    measure: Measure,
}

#[derive(Debug, Clone, Subcommand)]
enum Measure {
    Pairs(pairs::PairsArgs),
}

/// Runs the command.
///
/// # Errors
/// Names the file that cannot be read, or what does not fit together.
pub fn run(args: &BenchArgs) -> anyhow::Result<()> {
    match &args.measure {
        Measure::Pairs(args) => pairs::run(args),
    }
}
