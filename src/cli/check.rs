//! `cairn check`: is all that a data directory should hold there, and sound?

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use rayon::prelude::*;
use serde_json::json;

use crate::jobs::undecodable;
use crate::storage::{BlobStore, Reference, Role, StorageError, Store};

/// Verify a data directory: the database, every file that it names, every version
#[derive(Debug, Clone, Args)]
pub struct CheckArgs {
    /// Directory of all state
    #[arg(long, env = "CAIRN_DATA", value_name = "DIR", default_value = "cairn-data")]
    pub data: PathBuf,
    /// Repair what can be repaired; the service must be stopped
    #[arg(long)]
    pub repair: bool,
    /// Take damaged files from this backup, with --repair
    #[arg(long, value_name = "DIR", requires = "repair")]
    pub from: Option<PathBuf>,
    /// Print a report as JSON
    #[arg(long)]
    pub json: bool,
}

/// Exit code if damage is left.
pub const DAMAGED: u8 = 2;

/// One thing that is wrong.
struct Flaw {
    reference: Reference,
    detail: String,
    repaired: Option<&'static str>,
}

/// Checks, repairs if asked to, and prints.
///
/// # Errors
/// If the directory cannot be opened. Damage is no error: the exit code tells it.
pub fn run(args: &CheckArgs) -> anyhow::Result<ExitCode> {
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    runtime.block_on(check(args))
}

async fn check(args: &CheckArgs) -> anyhow::Result<ExitCode> {
    let store =
        if args.repair { Store::open(&args.data).await? } else { Store::open_beside(&args.data).await? };
    let rows = store.integrity().await?;
    let all = store.references().await?;
    let blobs = store.blobs.clone();
    let (all, mut flaws) = tokio::task::spawn_blocking(move || {
        let flaws: Vec<Flaw> = all.par_iter().filter_map(|reference| flaw(&blobs, reference)).collect();
        (all, flaws)
    })
    .await?;
    let mut collected = 0;
    if args.repair {
        let backup = args.from.as_ref().map(|from| BlobStore::read_only(&from.join("blobs")));
        for flaw in &mut flaws {
            flaw.repaired = repair(&store, backup.as_ref(), &flaw.reference)?;
        }
        store.settle_damage().await?;
        store.note_orphans(Duration::ZERO).await?;
        collected = store.collect_garbage(Duration::ZERO).await?;
    }
    store.close().await;
    let left = rows.len() + flaws.iter().filter(|f| f.repaired.is_none()).count();
    if args.json {
        let flaws: Vec<_> = flaws
            .iter()
            .map(|f| {
                json!({ "blob": f.reference.blob.to_string(), "project": f.reference.project,
                    "subject": f.reference.to_string(), "detail": f.detail, "repaired": f.repaired })
            })
            .collect();
        let report = json!({ "sound": left == 0, "references": all.len(), "rows": rows, "files": flaws, "collected": collected });
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        for row in &rows {
            println!("{row}");
        }
        for flaw in &flaws {
            let repaired = flaw.repaired.map_or_else(String::new, |how| format!(" -> {how}"));
            println!("{}: {}{repaired}", flaw.reference, flaw.detail);
        }
        if args.repair && collected > 0 {
            println!("{collected} files that nothing needs are deleted");
        }
        println!("{} files checked, {left} things wrong", all.len());
    }
    Ok(if left == 0 { ExitCode::SUCCESS } else { ExitCode::from(DAMAGED) })
}

/// What is wrong with a file, if anything.
fn flaw(blobs: &BlobStore, reference: &Reference) -> Option<Flaw> {
    let wrong = |detail: String| Some(Flaw { reference: reference.clone(), detail, repaired: None });
    match reference.role {
        Role::Content { .. } | Role::Snapshot(_) => match blobs.get(reference.blob) {
            Ok(bytes) => undecodable(&reference.role, &bytes).and_then(|why| {
                blobs.note_unreadable(reference.blob);
                wrong(why)
            }),
            Err(error) => wrong(error.to_string()),
        },
        Role::Upload { .. } | Role::Derived => {
            let read = blobs.verify(reference.blob);
            read.err().and_then(|error| wrong(error.to_string()))
        }
    }
}

/// Puts the file back from the backup, or says how it is made again.
fn repair(
    store: &Store,
    backup: Option<&BlobStore>,
    reference: &Reference,
) -> Result<Option<&'static str>, StorageError> {
    if let Some(backup) = backup
        && store.blobs.take_from(backup, reference.blob)?
    {
        return Ok(Some("taken from the backup"));
    }
    Ok(match reference.role {
        Role::Derived => Some("forgotten; it is made again when it is asked for"),
        Role::Snapshot(_) | Role::Content { newest: true, .. } => {
            Some("a rebuild is queued, which makes the model again from the uploads")
        }
        Role::Upload { .. } | Role::Content { .. } => None,
    })
}
