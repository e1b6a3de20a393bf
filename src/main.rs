//! The `cairn` binary: picks the subcommand.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use cairn::cli::{evaluate, openapi, register, serve, simulate};

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
    Register(register::RegisterArgs),
    Evaluate(evaluate::EvaluateArgs),
    Simulate(simulate::SimulateArgs),
    Openapi(openapi::OpenapiArgs),
}

fn main() -> anyhow::Result<ExitCode> {
    match Cli::parse().command {
        Command::Serve(args) => serve::run(args)?,
        Command::Register(args) => return register::run(&args),
        Command::Evaluate(args) => evaluate::run(&args)?,
        Command::Simulate(args) => simulate::run(&args)?,
        Command::Openapi(args) => openapi::run(args)?,
    }
    Ok(ExitCode::SUCCESS)
}
