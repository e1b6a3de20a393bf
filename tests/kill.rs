//! `kill -9` at random moments of an upload-and-register run: the real binary, the real disk.

use std::io::{BufRead, BufReader, Cursor};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cairn::cloud::PlyWriter;
use cairn::control::Seed;
use cairn::geometry::Pose;
use cairn::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};
use rand::RngExt;
use reqwest::Client;
use serde_json::{Value, json};

/// The service as a process of its own.
struct Process {
    child: Child,
    url: String,
}

impl Process {
    fn start(data: &Path) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_cairn"))
            .args(["serve", "--listen", "127.0.0.1:0", "--threads", "2", "--data"])
            .arg(data)
            .env("RUST_LOG", "warn")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.trim().strip_prefix("listening on ").expect("the service says where").to_owned();
        Self { child, url }
    }

    /// SIGKILL, then nothing of it is left.
    fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A file to upload, and where its scan truly is.
struct Subject {
    name: String,
    file: Vec<u8>,
    truth: Pose,
}

fn subjects() -> Vec<Subject> {
    let options = SurveyOptions {
        building: BuildingOptions { rooms: 2, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(30_000),
        stations: 8,
        seed: Seed(5),
        ..SurveyOptions::default()
    };
    let survey = simulate(&options).unwrap();
    let subject = |scan: &cairn::simulate::SimulatedScan| {
        let mut file = Cursor::new(Vec::new());
        let mut ply = PlyWriter::new(&mut file, false, &[]).unwrap();
        scan.cloud.points.iter().for_each(|p| ply.point(*p).unwrap());
        ply.finish().unwrap();
        Subject { name: format!("{}.ply", scan.name), file: file.into_inner(), truth: scan.model_from_scan }
    };
    survey.scans.iter().map(subject).collect()
}

async fn new_project(url: &str) -> String {
    let made: Value = Client::new()
        .post(format!("{url}/v1/projects"))
        .json(&json!({ "name": "kill" }))
        .send()
        .await
        .unwrap()
        .json()
        .await
        .unwrap();
    format!("/v1/projects/{}", made["id"].as_str().unwrap())
}

/// Uploads every scan, again and again until it is acknowledged, wherever the service is just now. Notes the ids that
/// were acknowledged.
async fn upload_all(url: Arc<Mutex<String>>, project: String, subjects: Arc<Vec<Subject>>) -> Vec<Value> {
    let client = Client::new();
    let mut acknowledged = Vec::new();
    for subject in subjects.iter() {
        loop {
            let at = format!("{}{project}/scans?name={}", url.lock().unwrap(), subject.name);
            let sent = client.post(at).body(subject.file.clone()).send().await;
            if let Ok(response) = sent
                && response.status().is_success()
                && let Ok(body) = response.json::<Value>().await
            {
                acknowledged.push(body["scan"]["id"].clone());
                break;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        tokio::time::sleep(Duration::from_millis(150)).await;
    }
    acknowledged
}

/// Waits until no job is open and returns all of them.
async fn all_ended(url: &str, project: &str) -> Vec<Value> {
    let begun = Instant::now();
    loop {
        let list: Value =
            reqwest::get(format!("{url}{project}/jobs?limit=200")).await.unwrap().json().await.unwrap();
        let jobs = list["items"].as_array().unwrap().clone();
        if jobs.iter().all(|job| !job["finished"].is_null()) {
            return jobs;
        }
        assert!(begun.elapsed() < Duration::from_mins(2), "jobs do not end: {jobs:?}");
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
}

/// How many scans are in the largest component, and the worst distance (metres) of one of them from its true place.
async fn quality(url: &str, project: &str, subjects: &[Subject]) -> (usize, f64) {
    let poses: Value =
        reqwest::get(format!("{url}{project}/poses?component=0")).await.unwrap().json().await.unwrap();
    let placed: Vec<(Pose, Pose)> = subjects
        .iter()
        .filter_map(|s| {
            let rows: [[f64; 4]; 4] = serde_json::from_value(poses["scans"][&s.name]["pose"].clone()).ok()?;
            Some((Pose::from_rows(&rows).unwrap(), s.truth))
        })
        .collect();
    let Some((first, truth)) = placed.first() else { return (0, 0.0) };
    let truth_from_model = *truth * first.inverse();
    let worst =
        placed.iter().map(|(pose, truth)| (truth_from_model * *pose).difference(truth).1).fold(0.0, f64::max);
    (placed.len(), worst)
}

#[tokio::test(flavor = "multi_thread")]
async fn ten_kills_lose_no_acknowledged_scan_and_leave_as_good_a_model() {
    let subjects = Arc::new(subjects());
    let data = tempfile::tempdir().unwrap();
    let mut rng = Seed(11).derive("kills", 0);

    let mut service = Process::start(data.path());
    let quiet = new_project(&service.url).await;
    let url = Arc::new(Mutex::new(service.url.clone()));
    let begun = Instant::now();
    upload_all(Arc::clone(&url), quiet.clone(), Arc::clone(&subjects)).await;
    all_ended(&service.url, &quiet).await;
    let undisturbed = begun.elapsed();
    let (registered, worst) = quality(&service.url, &quiet, &subjects).await;
    assert!(registered >= 6 && worst < 0.3, "the undisturbed run: {registered} scans, {worst} m");

    let project = new_project(&service.url).await;
    let uploads = tokio::spawn(upload_all(Arc::clone(&url), project.clone(), Arc::clone(&subjects)));
    // Ten moments over about the time that the run takes, each of them in a life of its own.
    for _ in 0..10 {
        let life = rng.random_range(0.02..0.3) * undisturbed.as_secs_f64();
        tokio::time::sleep(Duration::from_secs_f64(life)).await;
        service.kill();
        service = Process::start(data.path());
        url.lock().unwrap().clone_from(&service.url);
    }
    let acknowledged = uploads.await.unwrap();
    let jobs = all_ended(&service.url, &project).await;
    for job in &jobs {
        assert_eq!(job["status"], "succeeded", "{job}");
    }
    let list: Value =
        reqwest::get(format!("{}{project}/scans", service.url)).await.unwrap().json().await.unwrap();
    let there: Vec<&Value> = list["items"].as_array().unwrap().iter().map(|s| &s["id"]).collect();
    assert!(acknowledged.iter().all(|id| there.contains(&id)), "{acknowledged:?} of {there:?}");
    assert_eq!(there.len(), subjects.len(), "no scan is there twice");
    let (after, worst_after) = quality(&service.url, &project, &subjects).await;
    assert!(after >= registered, "{after} scans are registered, {registered} without kills");
    assert!(worst_after < worst + 0.1, "the worst is {worst_after} m off, {worst} m without kills");
}
