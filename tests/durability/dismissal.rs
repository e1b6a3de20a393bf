//! Computations let go of their worker when their job is dismissed, also one that would never end. `CAIRN_DISMISSALS` says how often (6 if it does not), on a model of
//! 16 scans, or 32 if it says more.

use std::time::{Duration, Instant};

use cairn::control::Seed;
use rand::RngExt;
use reqwest::{Client, StatusCode};
use serde_json::{Value, json};
use sqlx::sqlite::SqliteConnectOptions;
use sqlx::{Connection as _, Row as _, SqliteConnection};

use crate::process::{Faults, Process, room, until};
use crate::subjects::subjects;

/// Work on the whole model, the longest first and most often.
const KINDS: [&str; 6] =
    ["rebuild", "rebuild", "dense-refinement", "rebuild", "track-refinement", "global-bundle-adjustment"];

async fn asked(service: &Process, project: &str, kind: &str) -> Value {
    let request = Client::new().post(format!("{}{project}/jobs", service.url)).json(&json!({ "kind": kind }));
    request.send().await.unwrap().json().await.unwrap()
}

#[tokio::test]
async fn a_worker_takes_the_next_job_though_the_dismissed_one_would_never_end() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &["--workers", "1", "--job-seconds", "86400"], Some(&faults));
    // What is prepared of a scan depends on its bytes only, so that another project tells the name of the file.
    let elsewhere = service.project().await;
    let known = service.accepted(&elsewhere, room(7.0)).await;
    assert_eq!(service.ended(&known["job"]).await["status"], "succeeded");
    let options = SqliteConnectOptions::new().filename(data.join("cairn.sqlite")).read_only(true);
    let mut database = SqliteConnection::connect_with(&options).await.unwrap();
    let row = sqlx::query("SELECT blob FROM derived").fetch_one(&mut database).await.unwrap();
    faults.set(&format!("open loop 0 {}", row.get::<String, _>("blob")));
    let project = service.project().await;
    let hung = service.accepted(&project, room(7.0)).await["job"].clone();
    until("the mapper hangs", || faults.struck() > 0).await;
    let at = format!("/v1/jobs/{}", hung["id"].as_str().unwrap());
    let hanging = service.json(&at).await;
    // The first attempt decoded it: what hangs is the mapper, which has a day.
    assert!(hanging["status"] == "running" && hanging["attempt"] == 2, "{hanging}");
    let dismissed = Client::new().delete(format!("{}{at}", service.url)).send().await.unwrap();
    assert_eq!(dismissed.status(), StatusCode::OK);
    let next = service.accepted(&project, room(0.0)).await;
    assert_eq!(service.ended(&next["job"]).await["status"], "succeeded");
    assert_eq!(service.json(&at).await["status"], "dismissed");
    assert!(!service.has_died());
}

/// Waits until a worker is at a job, and says how long that took.
async fn begun(service: &Process, job: &Value) -> Duration {
    let waiting = Instant::now();
    let path = format!("/v1/jobs/{}", job["id"].as_str().unwrap());
    while service.json(&path).await["status"] == "accepted" {
        // Only so that this ends: that a worker lets go is shown by the job above, which would hold it for ever.
        assert!(waiting.elapsed() < Duration::from_mins(10), "the worker does not let go");
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    waiting.elapsed()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dismissed_job_lets_go_of_its_worker_wherever_it_is() {
    let dismissals: usize = std::env::var("CAIRN_DISMISSALS").map_or(6, |n| n.parse().unwrap());
    let data = tempfile::tempdir().unwrap();
    // With one worker the next job begins when it has let go of this one.
    let mut service = Process::with(data.path(), &["--workers", "1"], None);
    let project = service.project().await;
    let scans = if dismissals > 6 { 32 } else { 16 };
    for subject in subjects(scans / 4, scans) {
        service.accepted(&project, subject.file).await;
    }
    service.all_ended(&project).await;
    let whole = Instant::now();
    let job = asked(&service, &project, "rebuild").await;
    assert_eq!(service.ended(&job).await["status"], "succeeded");
    let whole = whole.elapsed().as_secs_f64();

    let mut rng = Seed(3).derive("dismissals", 0);
    let (mut taken, mut turn) = (Vec::new(), 0);
    let mut job = asked(&service, &project, KINDS[0]).await;
    while taken.len() < dismissals {
        turn += 1;
        let next = asked(&service, &project, KINDS[turn % KINDS.len()]).await;
        begun(&service, &job).await;
        tokio::time::sleep(Duration::from_secs_f64(rng.random_range(0.0..0.9) * whole)).await;
        let at = format!("{}/v1/jobs/{}", service.url, job["id"].as_str().unwrap());
        let answer = Client::new().delete(at).send().await.unwrap();
        if answer.status() == StatusCode::CONFLICT {
            // It had ended already: refinements are short.
            job = next;
            continue;
        }
        let dismissed: Value = answer.json().await.unwrap();
        assert_eq!(dismissed["status"], "dismissed", "{dismissed}");
        let stage = dismissed["stage"].as_str().unwrap_or("none");
        taken.push((begun(&service, &next).await, format!("{} in {stage}", dismissed["kind"])));
        job = next;
    }
    taken.sort();
    println!(
        "{scans} scans, whose rebuild takes {whole:.1} s; the next job began after (the longest last): {taken:?}"
    );
    assert_eq!(service.ended(&job).await["status"], "succeeded", "the model is none the worse");
    assert!(!service.has_died());
}
