//! Scans whose work kills or hangs the process that does it: they are set aside and say why, and their project goes on.

use std::collections::BTreeSet;

use serde_json::Value;
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, Row as _, SqliteConnection};

use crate::process::{Faults, Process, room, until};
use crate::resident::{lives, workers, works};

fn failed(job: &Value, code: &str) {
    assert_eq!(job["status"], "failed", "{job}");
    assert_eq!(job["problem"]["type"], format!("urn:cairn:problem:{code}"), "{job}");
}

#[tokio::test]
async fn an_upload_that_crashes_or_hangs_its_reader_is_set_aside_and_the_service_lives() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &["--job-seconds", "3", "--workers", "2"], Some(&faults));
    let project = service.project().await;
    let [crash, hang] = [room(7.0), room(8.0)];
    let name = |bytes: &[u8]| blake3::hash(bytes).to_hex().to_string();
    faults.set(&format!("open abort 0 {}\nopen loop 0 {}", name(&crash), name(&hang)));
    let (crash, hang) = (service.accepted(&project, crash).await, service.accepted(&project, hang).await);
    let mut good = Vec::new();
    for shift in [0.0, 0.4, 0.8] {
        good.push(service.accepted(&project, room(shift)).await);
    }
    for upload in &good {
        assert_eq!(service.ended(&upload["job"]).await["status"], "succeeded");
    }
    failed(&service.ended(&crash["job"]).await, "worker-lost");
    failed(&service.ended(&hang["job"]).await, "time-limit");
    assert!(!service.has_died());
    // Whoever sends it again gets another chance.
    faults.set("");
    let again = service.accepted(&project, room(7.0)).await;
    assert_eq!(service.ended(&again["job"]).await["status"], "succeeded");
}

#[tokio::test]
async fn a_scan_that_kills_the_mapper_is_found_out_and_the_others_are_mapped() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &[], Some(&faults));
    // What is prepared of a scan depends on its bytes only, so that another project tells the name of the file.
    let elsewhere = service.project().await;
    let known = service.accepted(&elsewhere, room(7.0)).await;
    service.ended(&known["job"]).await;
    let options = SqliteConnectOptions::new().filename(data.join("cairn.sqlite")).read_only(true);
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let row = sqlx::query("SELECT blob FROM derived").fetch_one(&mut database).await.unwrap();
    faults.set(&format!("open abort 0 {}", row.get::<String, _>("blob")));
    let project = service.project().await;
    let mut uploads = Vec::new();
    for shift in [0.0, 7.0, 0.4] {
        uploads.push(service.accepted(&project, room(shift)).await);
    }
    let mut ended = Vec::new();
    for upload in &uploads {
        ended.push(service.ended(&upload["job"]).await);
    }
    assert!(!service.has_died(), "it was a process of jobs that died");
    failed(&ended[1], "worker-lost");
    assert_eq!((&ended[0]["status"], &ended[2]["status"]), (&"succeeded".into(), &"succeeded".into()));
}

#[tokio::test]
async fn a_job_that_takes_ever_more_memory_fails_and_nobody_else_does() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let little = (300_u64 << 20).to_string();
    let mut service = Process::with(&data, &["--worker-memory-bytes", &little], Some(&faults));
    let project = service.project().await;
    let greedy = room(7.0);
    faults.set(&format!("open gorge 0 {}", blake3::hash(&greedy).to_hex()));
    let greedy = service.accepted(&project, greedy).await;
    let mut good = Vec::new();
    for shift in [0.0, 0.4] {
        good.push(service.accepted(&project, room(shift)).await);
    }
    for upload in &good {
        assert_eq!(service.ended(&upload["job"]).await["status"], "succeeded");
    }
    failed(&service.ended(&greedy["job"]).await, "memory-limit");
    assert!(!service.has_died());
}

#[tokio::test]
async fn a_scan_at_which_every_process_falls_silent_is_set_aside() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &["--lease-seconds", "1"], Some(&faults));
    let project = service.project().await;
    let silent = room(7.0);
    faults.set(&format!("open loop 0 {}", blake3::hash(&silent).to_hex()));
    let silent = service.accepted(&project, silent).await;
    let job = format!("/v1/jobs/{}", silent["job"]["id"].as_str().unwrap());
    let mut stopped = BTreeSet::new();
    let begun = std::time::Instant::now();
    while service.json(&job).await["finished"].is_null() {
        assert!(begun.elapsed() < std::time::Duration::from_mins(2), "a silent process keeps its job");
        for process in workers(&service).into_iter().filter(|process| works(*process)) {
            // One that has ended meanwhile cannot be stopped.
            let _ = std::process::Command::new("kill").arg("-STOP").arg(process.to_string()).output();
            stopped.insert(process);
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    failed(&service.ended(&silent["job"]).await, "worker-lost");
    until("those that fell silent are ended", || stopped.iter().all(|process| !lives(*process))).await;
    faults.set("");
    let good = service.accepted(&project, room(0.0)).await;
    assert_eq!(service.ended(&good["job"]).await["status"], "succeeded");
    assert!(!service.has_died());
}
