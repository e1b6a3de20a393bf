//! The service as a process of its own, the faults that it can be given, and the few calls that the tests make.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use reqwest::{Client, Response, StatusCode};
use serde_json::{Value, json};

pub use crate::room::room;

/// The program that is tested.
fn program() -> PathBuf {
    std::env::var_os("CARGO_BIN_EXE_cairn").map_or_else(|| env!("CARGO_BIN_EXE_cairn").into(), PathBuf::from)
}

/// A running service.
pub struct Process {
    child: Child,
    pub url: String,
}

impl Process {
    /// Starts the service on a data directory.
    pub fn start(data: &Path) -> Self {
        Self::with(data, &[], None)
    }

    /// Starts the service with further flags, and with faults if asked for.
    pub fn with(data: &Path, flags: &[&str], faults: Option<&Faults>) -> Self {
        let mut command = Command::new(program());
        command.args(["serve", "--listen", "127.0.0.1:0", "--threads", "2", "--data"]).arg(data).args(flags);
        if let Some(faults) = faults {
            command.env("LD_PRELOAD", library()).env("CAIRN_INJECT", &faults.0);
        }
        let mut child = command.env("RUST_LOG", "off").stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("listening on ").expect("the service says where").to_owned();
        Self { child, url }
    }

    /// What the service says when it does not start.
    pub fn refused(data: &Path, faults: &Faults) -> String {
        let mut command = Command::new(program());
        command.args(["serve", "--listen", "127.0.0.1:0", "--data"]).arg(data);
        let output = command.env("LD_PRELOAD", library()).env("CAIRN_INJECT", &faults.0).output().unwrap();
        assert!(!output.status.success());
        String::from_utf8_lossy(&output.stderr).into_owned()
    }

    /// SIGKILL, then nothing of it is left.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// What the system calls it.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Whether it has ended by itself.
    pub fn has_died(&mut self) -> bool {
        self.child.try_wait().unwrap().is_some()
    }

    /// GET, 200, JSON.
    pub async fn json(&self, path: &str) -> Value {
        let response = reqwest::get(format!("{}{path}", self.url)).await.unwrap();
        assert_eq!(response.status(), StatusCode::OK, "{path}");
        response.json().await.unwrap()
    }

    /// Makes a project and returns its path.
    pub async fn project(&self) -> String {
        let body = json!({ "name": "test", "resolution": 0.1 });
        let made = Client::new().post(format!("{}/v1/projects", self.url)).json(&body).send().await.unwrap();
        let made: Value = made.json().await.unwrap();
        format!("/v1/projects/{}", made["id"].as_str().unwrap())
    }

    pub async fn upload(&self, project: &str, bytes: Vec<u8>) -> reqwest::Result<Response> {
        Client::new().post(format!("{}{project}/scans?name=scan.ply", self.url)).body(bytes).send().await
    }

    /// Uploads, expects 202, and returns the answer.
    pub async fn accepted(&self, project: &str, bytes: Vec<u8>) -> Value {
        let response = self.upload(project, bytes).await.unwrap();
        assert_eq!(response.status(), StatusCode::ACCEPTED);
        response.json().await.unwrap()
    }

    /// Waits for the end of a job.
    pub async fn ended(&self, job: &Value) -> Value {
        let begun = Instant::now();
        loop {
            let job = self.json(&format!("/v1/jobs/{}?wait=5", job["id"].as_str().unwrap())).await;
            if !job["finished"].is_null() {
                return job;
            }
            assert!(begun.elapsed() < Duration::from_mins(2), "it does not end: {job}");
        }
    }

    /// Waits until no job of the project is open and returns all of them.
    pub async fn all_ended(&self, project: &str) -> Vec<Value> {
        let begun = Instant::now();
        loop {
            let list = self.json(&format!("{project}/jobs?limit=200")).await;
            let jobs = list["items"].as_array().unwrap().clone();
            if jobs.iter().all(|job| !job["finished"].is_null()) {
                return jobs;
            }
            assert!(begun.elapsed() < Duration::from_mins(3), "jobs do not end: {jobs:?}");
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits for something that will be so.
pub async fn until(what: &str, is_so: impl Fn() -> bool) {
    let begun = Instant::now();
    while !is_so() {
        assert!(begun.elapsed() < Duration::from_mins(2), "it does not come about that {what}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

/// The rules by which calls fail; see `inject.c`.
pub struct Faults(PathBuf);

impl Faults {
    /// None so far.
    pub fn new(folder: &Path) -> Self {
        let file = folder.join("faults");
        fs::write(&file, "").unwrap();
        Self(file)
    }

    /// From now on exactly these.
    pub fn set(&self, rules: &str) {
        // In one stroke: the file is read while it is written.
        let new = self.0.with_extension("new");
        fs::write(&new, rules).unwrap();
        fs::rename(new, &self.0).unwrap();
    }

    /// How many calls the rules have struck so far.
    pub fn struck(&self) -> u64 {
        fs::metadata(self.0.with_extension("struck")).map_or(0, |file| file.len())
    }
}

/// The library that makes calls fail, compiled once.
fn library() -> &'static Path {
    static LIBRARY: OnceLock<PathBuf> = OnceLock::new();
    LIBRARY.get_or_init(|| {
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/durability/inject.c");
        let library = Path::new(env!("CARGO_TARGET_TMPDIR")).join("inject.so");
        let compiled = Command::new("cc")
            .args(["-shared", "-fPIC", "-O1", "-o"])
            .arg(&library)
            .arg(source)
            .arg("-ldl")
            .status()
            .expect("a C compiler");
        assert!(compiled.success());
        library
    })
}

/// Runs another command of the program.
pub fn cairn(arguments: &[&str]) -> Output {
    Command::new(program()).args(arguments).env("RUST_LOG", "off").output().unwrap()
}

/// Runs `cairn check` and returns its exit code and report.
pub fn check(data: &Path, flags: &[&str]) -> (i32, Value) {
    let data = data.to_str().unwrap();
    let output = cairn(&[&["check", "--json", "--data", data], flags].concat());
    let report = serde_json::from_slice(&output.stdout);
    let report = report.unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&output.stderr)));
    (output.status.code().unwrap(), report)
}

/// A valid file that is decoded in no time: so few points that nothing can be made of them.
pub fn speck(seed: usize) -> Vec<u8> {
    let points: Vec<String> = (0..9).map(|i| format!("{} {} 1\n", i + seed, i * i)).collect();
    let points = points.concat();
    format!("ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nproperty float y\nproperty float z\nend_header\n{points}")
        .into_bytes()
}

/// Where the file of a blob is.
pub fn blob(data: &Path, hex: &str) -> PathBuf {
    data.join("blobs").join(&hex[..2]).join(&hex[2..4]).join(hex)
}
