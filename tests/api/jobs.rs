//! Jobs: asked for, polled, followed, dismissed.

use std::time::{Duration, Instant};

use reqwest::header;
use serde_json::{Value, json};

use crate::server::{Server, problem, room};

async fn ask(server: &Server, project: &str, kind: &str) -> reqwest::Response {
    let url = server.url(&format!("{project}/jobs"));
    server.client.post(url).json(&json!({ "kind": kind })).send().await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn work_on_the_whole_model_comes_after_the_scans_before_it() {
    let server = Server::start().await;
    let project = server.project().await;
    let mut uploads = Vec::new();
    for i in 0..3u8 {
        uploads.push(server.accepted(&project, &format!("{i}.ply"), room(f64::from(i) * 0.2)).await);
    }
    for kind in ["global-bundle-adjustment", "track-refinement", "dense-refinement", "rebuild"] {
        let answer = ask(&server, &project, kind).await;
        assert_eq!(answer.status(), 202);
        let job: Value = server.ended(&answer.json().await.unwrap()).await;
        assert_eq!(job["status"], "succeeded", "{job}");
        for upload in &uploads {
            let id = upload["job"]["id"].as_str().unwrap();
            assert_eq!(server.json(&format!("/v1/jobs/{id}")).await["status"], "succeeded");
        }
    }
    for kind in ["registration", "removal", "nonsense"] {
        let found = problem(ask(&server, &project, kind).await, 400, "invalid-field").await;
        assert_eq!(found["field"], "kind");
    }
    let list = server.json(&format!("{project}/jobs?kind=rebuild&status=succeeded")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 1);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_ended_job_is_polled_once_and_then_known() {
    let server = Server::start().await;
    let project = server.project().await;
    let (_, job) = server.registered(&project, "a.ply", room(0.0)).await;
    let url = server.url(&format!("/v1/jobs/{}", job["id"].as_str().unwrap()));
    let first = server.client.get(&url).send().await.unwrap();
    assert!(!first.headers().contains_key("retry-after"));
    let etag = first.headers()["etag"].clone();
    let begun = Instant::now();
    let again = server.client.get(format!("{url}?wait=30")).header(header::IF_NONE_MATCH, etag).send();
    assert_eq!(again.await.unwrap().status(), 304);
    assert!(begun.elapsed() < Duration::from_secs(5), "nothing will change, so nothing is waited for");
    problem(server.client.get(format!("{url}?wait=61")).send().await.unwrap(), 400, "invalid-field").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn events_tell_the_job_until_its_end_and_resume_by_id() {
    let server = Server::start().await;
    let project = server.project().await;
    let answer = server.accepted(&project, "a.ply", room(0.0)).await;
    let path = format!("/v1/jobs/{}/events", answer["job"]["id"].as_str().unwrap());
    let events = server.get(&path).await;
    assert_eq!(events.headers()["content-type"], "text/event-stream");
    assert_eq!(events.headers()["x-accel-buffering"], "no");
    let text = events.text().await.unwrap();
    let field = |name: &str| -> Vec<String> {
        text.lines().filter_map(|l| l.strip_prefix(name)).map(|v| v.trim().to_owned()).collect()
    };
    let ids: Vec<u64> = field("id:").iter().map(|id| id.parse().unwrap()).collect();
    assert!(ids.is_sorted_by(|a, b| a < b), "{ids:?}");
    assert_eq!(field("event:").last().unwrap(), "succeeded");
    let progress: Vec<u64> = field("data:")
        .iter()
        .map(|data| serde_json::from_str::<Value>(data).unwrap()["progress"].as_u64().unwrap())
        .collect();
    assert!(progress.is_sorted() && progress.last() == Some(&100), "{progress:?}");
    let last = ids.last().unwrap();
    let after = |id: u64| server.client.get(server.url(&path)).header("last-event-id", id.to_string()).send();
    assert_eq!(after(*last).await.unwrap().status(), 204, "nothing is left to hear, so do not come again");
    let missed = after(last - 1).await.unwrap().text().await.unwrap();
    assert!(missed.contains(&format!("id: {last}")) && missed.contains("event: succeeded"), "{missed}");
    let foreign = after(last + 1000).await.unwrap().text().await.unwrap();
    assert!(foreign.contains("event: succeeded"), "an id that is not of this job hides nothing: {foreign}");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dismissed_job_is_never_done_and_others_are() {
    let server = Server::start().await;
    let project = server.project().await;
    let mut jobs = Vec::new();
    for i in 0..6u8 {
        let answer = server.accepted(&project, &format!("{i}.ply"), room(f64::from(i) * 0.1)).await;
        jobs.push(answer["job"].clone());
    }
    let last = ask(&server, &project, "rebuild").await.json::<Value>().await.unwrap();
    let url = server.url(&format!("/v1/jobs/{}", last["id"].as_str().unwrap()));
    let dismissed = server.client.delete(&url).send().await.unwrap();
    assert_eq!(dismissed.status(), 200);
    assert_eq!(dismissed.json::<Value>().await.unwrap()["status"], "dismissed");
    problem(server.client.delete(&url).send().await.unwrap(), 409, "job-ended").await;
    for job in &jobs {
        assert_eq!(server.ended(job).await["status"], "succeeded");
    }
    assert_eq!(server.ended(&last).await["status"], "dismissed");
    server.stop().await;
}
