//! What is asked for with an `Idempotency-Key` is done once, also when the process dies between doing it and answering.

use reqwest::{Client, StatusCode};
use serde_json::{Value, json};

use crate::process::{Faults, Process};

/// Calls that one request syncs the database with, and a few more.
const SYNCS: usize = 4;

#[tokio::test]
async fn a_request_whose_answer_dies_with_the_process_is_answered_when_it_comes_again_and_not_done_again() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let mut service = Process::with(&data, &[], Some(&faults));
    let project = service.project().await;
    let asked: [(&str, String, Value); 2] = [
        ("/v1/projects", "/v1/projects".to_owned(), json!({ "name": "Town hall" })),
        ("/jobs", format!("{project}/jobs"), json!({ "kind": "rebuild" })),
    ];
    let mut deaths = 0;
    for (what, path, body) in &asked {
        let count = async |service: &Process| {
            service.json(&format!("{path}?limit=200")).await["items"].as_array().unwrap().len()
        };
        for skipped in 0..SYNCS {
            let key = format!("{what} {skipped}").replace(['/', ' '], "-");
            let before = count(&service).await;
            let send = async |service: &Process| {
                let request = Client::new().post(format!("{}{path}", service.url));
                request.header("idempotency-key", &key).json(body).send().await
            };
            // What was written is there when the process dies here, but nobody was told.
            faults.set(&format!("sync abort {skipped} /data/cairn.sqlite-wal"));
            let first = send(&service).await;
            faults.set("");
            if first.is_err() {
                deaths += 1;
                service.kill();
                service = Process::with(&data, &[], Some(&faults));
            }
            let mut again = send(&service).await;
            if again.is_err() {
                // It answered the first time, and died of a sync of a worker's just after.
                service.kill();
                service = Process::with(&data, &[], Some(&faults));
                again = send(&service).await;
            }
            let again = again.unwrap();
            assert!([StatusCode::CREATED, StatusCode::ACCEPTED].contains(&again.status()), "{again:?}");
            let location = again.headers()["location"].to_str().unwrap().to_owned();
            let again: Value = again.json().await.unwrap();
            assert_eq!(count(&service).await, before + 1, "{what}, {skipped} syncs");
            assert_eq!(service.json(&location).await["id"], again["id"]);
        }
    }
    assert!(deaths >= asked.len(), "the process died before it answered: {deaths}");
}
