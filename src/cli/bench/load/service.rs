//! The service that is measured, as a process of its own, and the calls that all clients make.

use std::collections::BTreeMap;
use std::fs;
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use reqwest::Client;
use serde_json::{Value, json};

use crate::cli::bench::memory::peak_in;

/// A running service.
pub(super) struct Service {
    child: Child,
    pub url: String,
    pub client: Client,
    /// Most memory by process, bytes.
    peaks: Arc<Mutex<BTreeMap<u32, u64>>>,
    ended: Arc<AtomicBool>,
    watcher: Option<JoinHandle<()>>,
}

/// How often processes are looked for.
const LOOK_EVERY: Duration = Duration::from_millis(100);

impl Service {
    /// Starts the service on an empty directory.
    pub fn start(data: &Path, flags: &[String]) -> anyhow::Result<Self> {
        fs::create_dir_all(data)?;
        let mut child = Command::new(std::env::current_exe()?)
            .args(["serve", "--listen", "127.0.0.1:0", "--data"])
            .arg(data)
            .args(flags)
            // What it bears is to be measured, not what it lets one address do.
            .envs([("CAIRN_REQUESTS_PER_SECOND", "0"), ("CAIRN_MAX_CONNECTIONS_PER_ADDRESS", "4096")])
            .env("RUST_LOG", "error")
            .stdout(Stdio::piped())
            .spawn()?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().context("the service has no output")?).read_line(&mut line)?;
        let url = line.trim().strip_prefix("listening on ").context("the service does not start")?.to_owned();
        let (peaks, ended, id) = (Arc::default(), Arc::new(AtomicBool::new(false)), child.id());
        let watcher = std::thread::spawn({
            let (peaks, ended) = (Arc::clone(&peaks), Arc::clone(&ended));
            move || {
                while !ended.load(Ordering::Relaxed) {
                    look(id, &peaks);
                    std::thread::sleep(LOOK_EVERY);
                }
            }
        });
        Ok(Self { child, url, client: Client::new(), peaks, ended, watcher: Some(watcher) })
    }

    /// Makes a project and returns its path.
    pub async fn project(&self, name: &str) -> anyhow::Result<String> {
        let made = self.client.post(format!("{}/v1/projects", self.url)).json(&json!({ "name": name }));
        let made: Value = made.send().await?.error_for_status()?.json().await?;
        let id = made["id"].as_str().context("a project has no id")?;
        Ok(format!("/v1/projects/{id}"))
    }

    pub async fn delete(&self, project: &str) -> anyhow::Result<()> {
        self.client.delete(format!("{}{project}", self.url)).send().await?.error_for_status()?;
        Ok(())
    }

    /// How long a GET takes, its body included.
    pub async fn timed(&self, path: &str) -> anyhow::Result<Duration> {
        let begun = Instant::now();
        self.client.get(format!("{}{path}", self.url)).send().await?.error_for_status()?.bytes().await?;
        Ok(begun.elapsed())
    }

    /// The most memory that the service took, and the largest and the sum of the largest processes of jobs at once, mebibytes.
    pub fn memory(&self) -> Value {
        look(self.child.id(), &self.peaks);
        let peaks = self.peaks.lock().unwrap_or_else(PoisonError::into_inner);
        let mebibytes = |bytes: u64| bytes >> 20;
        let own = peaks.get(&self.child.id()).copied().unwrap_or(0);
        let jobs = peaks.iter().filter(|(id, _)| **id != self.child.id()).map(|(_, peak)| *peak).max();
        json!({ "service_mib": mebibytes(own), "largest_job_process_mib": mebibytes(jobs.unwrap_or(0)) })
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Relaxed);
        let _ = self.child.kill();
        let _ = self.child.wait();
        if let Some(watcher) = self.watcher.take() {
            let _ = watcher.join();
        }
    }
}

/// Notes the peaks of a process and of its children, as `/proc` tells them.
fn look(id: u32, peaks: &Mutex<BTreeMap<u32, u64>>) {
    let children = fs::read_dir(format!("/proc/{id}/task")).into_iter().flatten().flatten();
    let children = children.filter_map(|task| fs::read_to_string(task.path().join("children")).ok());
    let mut all: Vec<u32> = children
        .flat_map(|ids| ids.split_whitespace().filter_map(|id| id.parse().ok()).collect::<Vec<_>>())
        .collect();
    all.push(id);
    for process in all {
        // One that is just being made is still a copy of the service.
        let command = fs::read_to_string(format!("/proc/{process}/cmdline")).unwrap_or_default();
        if process != id && command.split('\0').nth(1) != Some("work") {
            continue;
        }
        let status = fs::read_to_string(format!("/proc/{process}/status")).unwrap_or_default();
        if let Some(peak) = peak_in(&status) {
            let mut peaks = peaks.lock().unwrap_or_else(PoisonError::into_inner);
            let known = peaks.entry(process).or_default();
            *known = peak.max(*known);
        }
    }
}
