//! The `cairn` binary: picks the subcommand.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use cairn::cli::{bench, calibrate, demo, evaluate, key, openapi, register, serve, simulate};

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
    Key(key::KeyArgs),
    Register(register::RegisterArgs),
    Demo(demo::DemoArgs),
    Evaluate(evaluate::EvaluateArgs),
    Bench(bench::BenchArgs),
    Simulate(simulate::SimulateArgs),
    Calibrate(calibrate::CalibrateArgs),
    Openapi(openapi::OpenapiArgs),
}

fn main() -> ExitCode {
    run(Cli::parse().command).unwrap_or_else(|error| {
        eprintln!("error: {error:#}");
        ExitCode::FAILURE
    })
}

fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Serve(args) => serve::run(args)?,
        Command::Key(args) => key::run(args)?,
        Command::Register(args) => return register::run(&args),
        Command::Demo(args) => return demo::run(&args),
        Command::Evaluate(args) => evaluate::run(&args)?,
        Command::Bench(args) => return bench::run(&args),
        Command::Simulate(args) => simulate::run(&args)?,
        Command::Calibrate(args) => return calibrate::run(&args),
        Command::Openapi(args) => openapi::run(args)?,
    }
    Ok(ExitCode::SUCCESS)
}
