//! The `cairn` binary: picks the subcommand.

use std::process::ExitCode;

use clap::{Parser, Subcommand};

use cairn::cli::{
    backup, bench, calibrate, check, demo, evaluate, key, openapi, register, serve, simulate, work,
};

/// Fits many 3-D scans of one place into one model
#[derive(Debug, Parser)]
#[command(name = "cairn", version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Serve(Box<serve::ServeArgs>),
    Key(key::KeyArgs),
    Register(register::RegisterArgs),
    Demo(demo::DemoArgs),
    Check(check::CheckArgs),
    Backup(backup::BackupArgs),
    Restore(backup::RestoreArgs),
    Evaluate(evaluate::EvaluateArgs),
    Bench(bench::BenchArgs),
    Simulate(simulate::SimulateArgs),
    Calibrate(calibrate::CalibrateArgs),
    Openapi(openapi::OpenapiArgs),
    #[command(hide = true)]
    Work(work::WorkArgs),
}

fn main() -> ExitCode {
    run(Cli::parse().command).unwrap_or_else(|error| {
        eprintln!("error: {error:#}");
        ExitCode::FAILURE
    })
}

fn run(command: Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Serve(args) => serve::run(*args)?,
        Command::Key(args) => key::run(args)?,
        Command::Register(args) => return register::run(&args),
        Command::Demo(args) => return demo::run(&args),
        Command::Check(args) => return check::run(&args),
        Command::Backup(args) => return backup::run(&args),
        Command::Restore(args) => return backup::run_restore(&args),
        Command::Evaluate(args) => evaluate::run(&args)?,
        Command::Bench(args) => return bench::run(&args),
        Command::Simulate(args) => simulate::run(&args)?,
        Command::Calibrate(args) => return calibrate::run(&args),
        Command::Openapi(args) => openapi::run(args)?,
        Command::Work(args) => return work::run(&args),
    }
    Ok(ExitCode::SUCCESS)
}
