//! `cairn key`: makes, lists and revokes API keys, whether or not a service runs on the data directory.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use clap::{Args, Subcommand};
use serde_json::{Value, json};

use crate::config::{DEFAULT_DATA, Settings};
use crate::project::{Key, KeyId, Limits, Name, ProjectId, Reach, Scope, Timestamp, Token};
use crate::storage::{Keys, NewKey};

/// Make, list and revoke API keys, also while the service runs
#[derive(Debug, Clone, Args)]
pub struct KeyArgs {
    /// What to do.
    #[command(subcommand)]
    pub command: KeyCommand,
    /// Directory of all state [default: ./cairn-data]
    #[arg(long, env = "CAIRN_DATA", value_name = "DIR", global = true)]
    pub data: Option<PathBuf>,
    /// TOML file with settings, of which only `data` matters here
    #[arg(long, env = "CAIRN_CONFIG", value_name = "FILE", global = true)]
    pub config: Option<PathBuf>,
}

/// What to do with keys.
#[derive(Debug, Clone, Subcommand)]
pub enum KeyCommand {
    /// Make a key and print it; it is shown only this once
    Create(CreateArgs),
    /// List all keys
    List {
        /// Print JSON
        #[arg(long)]
        json: bool,
    },
    /// Revoke a key: from now on it opens nothing
    Revoke {
        /// Its id, as `list` shows it
        id: KeyId,
    },
}

/// A key to be made.
#[derive(Debug, Clone, Args)]
pub struct CreateArgs {
    /// What to call it, such as the rig that gets it
    pub name: String,
    /// read, upload (and read) or manage (and all else)
    #[arg(long, value_parser = scope)]
    pub scope: Scope,
    /// A project in which it holds, by id; may be given several times
    #[arg(long = "project", value_name = "PROJECT", required_unless_present = "all_projects")]
    pub projects: Vec<ProjectId>,
    /// It holds in every project and for the service as a whole
    #[arg(long, conflicts_with = "projects")]
    pub all_projects: bool,
    /// Days until it expires [default: never]
    #[arg(long, value_name = "DAYS", value_parser = clap::value_parser!(u32).range(1..=36_500))]
    pub expires_in_days: Option<u32>,
    /// Most bytes of scans that it may have sent and that are still there [default: no limit]
    #[arg(long, value_name = "BYTES", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub max_bytes: Option<u64>,
    /// Most scans that it may have sent and that are still there [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub max_scans: Option<u64>,
    /// Most of its jobs that may be waiting or running at once [default: no limit]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub max_queued_jobs: Option<u64>,
    /// Most of its resumable uploads that may be begun and not complete [default: no limit of its own]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(..=i64::MAX as u64))]
    pub max_open_uploads: Option<u64>,
}

fn scope(word: &str) -> Result<Scope, String> {
    Scope::from_word(word).ok_or_else(|| "it must be read, upload or manage".to_owned())
}

/// Does what was asked for and closes the database again.
pub fn run(args: KeyArgs) -> anyhow::Result<()> {
    let file = args.config.as_deref().map(Settings::from_file).transpose()?.unwrap_or_default();
    let data = args.data.or(file.data).unwrap_or_else(|| PathBuf::from(DEFAULT_DATA));
    // Only making a key is a reason to make a data directory: elsewhere a wrong path should be noticed.
    if !matches!(args.command, KeyCommand::Create(_)) && !data.join("cairn.sqlite").exists() {
        anyhow::bail!("{} is no data directory", data.display());
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let keys =
            Keys::open(&data).await.with_context(|| format!("the data directory {}", data.display()))?;
        let done = perform(&keys, args.command).await;
        keys.close().await;
        done
    })
}

async fn perform(keys: &Keys, command: KeyCommand) -> anyhow::Result<()> {
    match command {
        KeyCommand::Create(args) => create(keys, args).await,
        KeyCommand::List { json } => {
            let all = keys.list().await?;
            if json {
                let all: Vec<Value> = all.iter().map(in_json).collect();
                println!("{}", serde_json::to_string_pretty(&all)?);
            } else {
                for key in &all {
                    println!("{}", in_words(key));
                }
            }
            Ok(())
        }
        KeyCommand::Revoke { id } => {
            let key = keys.revoke(id).await?;
            eprintln!("revoked {} ({})", key.id, key.name);
            Ok(())
        }
    }
}

async fn create(keys: &Keys, args: CreateArgs) -> anyhow::Result<()> {
    let days = |n: u32| Duration::from_hours(24 * u64::from(n));
    let new = NewKey {
        name: Name::parse(&args.name)?,
        scope: args.scope,
        reach: if args.all_projects {
            Reach::Everything
        } else {
            Reach::Projects(args.projects.into_iter().collect())
        },
        limits: Limits {
            bytes: args.max_bytes,
            scans: args.max_scans,
            queued_jobs: args.max_queued_jobs,
            open_uploads: args.max_open_uploads,
        },
        expires: args.expires_in_days.map(|n| Timestamp::now().plus(days(n))),
    };
    let token = Token::generate(KeyId::generate())?;
    let key = keys.create(&new, &token).await?;
    eprintln!("key {} ({}), shown only this once:", key.id, key.name);
    println!("{}", token.reveal());
    Ok(())
}

fn state(key: &Key) -> &'static str {
    if key.revoked.is_some() {
        "revoked"
    } else if key.is_valid(Timestamp::now()) {
        "valid"
    } else {
        "expired"
    }
}

fn in_words(key: &Key) -> String {
    let reach = match &key.reach {
        Reach::Everything => "all projects".to_owned(),
        Reach::Projects(some) => some.iter().map(ToString::to_string).collect::<Vec<_>>().join(" "),
    };
    let until = key.expires.map_or_else(|| "never".to_owned(), |end| end.to_string());
    let limit = |what, most: Option<u64>| most.map(|n| format!(", at most {n} {what}")).unwrap_or_default();
    let limits = limit("bytes", key.limits.bytes)
        + &limit("scans", key.limits.scans)
        + &limit("queued jobs", key.limits.queued_jobs)
        + &limit("open uploads", key.limits.open_uploads);
    let (id, scope, state, name) = (key.id, key.scope.as_str(), state(key), &key.name);
    format!("{id}  {state:<7}  {scope:<6}  {name}: {reach}; expires {until}{limits}")
}

fn in_json(key: &Key) -> Value {
    let projects = match &key.reach {
        Reach::Everything => Value::Null,
        Reach::Projects(some) => json!(some),
    };
    json!({
        "id": key.id, "name": key.name.as_str(), "scope": key.scope.as_str(), "state": state(key), "projects": projects,
        "max_bytes": key.limits.bytes, "max_scans": key.limits.scans, "max_queued_jobs": key.limits.queued_jobs,
        "max_open_uploads": key.limits.open_uploads,
        "created": key.created, "expires": key.expires, "revoked": key.revoked,
    })
}
