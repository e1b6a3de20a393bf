//! `cairn backup` and `cairn restore`: copies of a data directory.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Args;

use super::check::DAMAGED;
use crate::storage::{Copied, Sharing, backup, restore};

/// Copy a data directory while the service runs
#[derive(Debug, Clone, Args)]
pub struct BackupArgs {
    /// Where the copy goes; empty or not there
    #[arg(value_name = "DIR")]
    pub to: PathBuf,
    /// Directory of all state
    #[arg(long, env = "CAIRN_DATA", value_name = "DIR", default_value = "cairn-data")]
    pub data: PathBuf,
    /// Copy every file, even where a link would do
    #[arg(long)]
    pub copy: bool,
}

/// Make a data directory from a backup
#[derive(Debug, Clone, Args)]
pub struct RestoreArgs {
    /// The backup
    #[arg(value_name = "DIR")]
    pub from: PathBuf,
    /// The directory to make; empty or not there
    #[arg(long, env = "CAIRN_DATA", value_name = "DIR", default_value = "cairn-data")]
    pub data: PathBuf,
    /// Link files instead of copying them, where that can be
    #[arg(long)]
    pub link: bool,
}

/// Makes a backup and says what is in it.
///
/// # Errors
/// If the directory cannot be read or the copy cannot be written. Damaged files are no error: the exit code tells them.
pub fn run(args: &BackupArgs) -> anyhow::Result<ExitCode> {
    let sharing = if args.copy { Sharing::Copies } else { Sharing::Links };
    Ok(tell(&tokio::runtime::Runtime::new()?.block_on(backup(&args.data, &args.to, sharing))?))
}

/// Restores a backup and says what was in it.
///
/// # Errors
/// If the backup is none or the directory cannot be written. Damaged files are no error: the exit code tells them.
pub fn run_restore(args: &RestoreArgs) -> anyhow::Result<ExitCode> {
    let sharing = if args.link { Sharing::Links } else { Sharing::Copies };
    Ok(tell(&tokio::runtime::Runtime::new()?.block_on(restore(&args.from, &args.data, sharing))?))
}

fn tell(copied: &Copied) -> ExitCode {
    for (reference, error) in &copied.missing {
        println!("{reference}: {error}");
    }
    let (blobs, bytes, linked) = (copied.blobs, copied.bytes, copied.linked);
    println!("{blobs} files of {bytes} bytes, {linked} of them linked; {} missing", copied.missing.len());
    if copied.missing.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(DAMAGED) }
}
