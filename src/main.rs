//! The `cairn` binary: picks the subcommand.

use clap::{Parser, Subcommand};

use cairn::cli::{evaluate, openapi, serve, simulate};

/// Fits many 3-D scans of one place into one model
#[derive(Debug, Parser)]
#[command(name = "cairn", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(serve::ServeArgs),
    Evaluate(evaluate::EvaluateArgs),
    Simulate(simulate::SimulateArgs),
    Openapi(openapi::OpenapiArgs),
}

fn main() -> anyhow::Result<()> {
    match Cli::parse().command {
        Command::Serve(args) => serve::run(args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Simulate(args) => simulate::run(&args),
        Command::Openapi(args) => openapi::run(args),
    }
}
