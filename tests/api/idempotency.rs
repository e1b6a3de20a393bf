//! `Idempotency-Key`: what is sent again is done once.

use std::time::Duration;

use cairn::config::Settings;
use reqwest::{Body, RequestBuilder, Response};
use serde_json::{Value, json};

use crate::server::{Server, problem, room};

fn post(server: &Server, path: &str, key: &str) -> RequestBuilder {
    server.client.post(server.url(path)).header("idempotency-key", key)
}

fn replayed(answer: &Response) -> bool {
    answer.headers().get("idempotency-replayed").is_some_and(|v| v == "true")
}

async fn projects(server: &Server) -> usize {
    server.json("/v1/projects").await["items"].as_array().unwrap().len()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_project_that_is_asked_for_twice_is_made_once_also_after_a_restart() {
    let server = Server::start().await;
    let body = json!({ "name": "Town hall" });
    let first = post(&server, "/v1/projects", "k1").json(&body).send().await.unwrap();
    assert_eq!((first.status().as_u16(), replayed(&first)), (201, false));
    let location = first.headers()["location"].clone();
    let first: Value = first.json().await.unwrap();
    let server = server.restart().await;
    let again = post(&server, "/v1/projects", "\"k1\"").json(&body).send().await.unwrap();
    assert_eq!((again.status().as_u16(), replayed(&again)), (201, true));
    assert_eq!(
        (&again.headers()["location"], &again.headers()["content-type"]),
        (&location, &"application/json".parse().unwrap())
    );
    assert_eq!(again.json::<Value>().await.unwrap(), first);
    assert_eq!(projects(&server).await, 1);
    // Another key is another request, and so is the same one when it is forgotten.
    assert_eq!(post(&server, "/v1/projects", "k2").json(&body).send().await.unwrap().status(), 201);
    server.sql("UPDATE answers SET expires_ms = 1").await;
    assert!(!replayed(&post(&server, "/v1/projects", "k1").json(&body).send().await.unwrap()));
    assert_eq!(projects(&server).await, 3);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_that_comes_with_another_request_is_refused() {
    let server = Server::start().await;
    let project = server.project().await;
    let body = json!({ "name": "Town hall" });
    post(&server, "/v1/projects", "k").json(&body).send().await.unwrap();
    let other = post(&server, "/v1/projects", "k").json(&json!({ "name": "Church" })).send().await.unwrap();
    assert_eq!(problem(other, 422, "key-reused").await["field"], "idempotency-key");
    let elsewhere = post(&server, &format!("{project}/jobs"), "k").json(&body).send().await.unwrap();
    problem(elsewhere, 422, "key-reused").await;
    let bad = post(&server, "/v1/projects", "two words").json(&body).send().await.unwrap();
    assert_eq!(problem(bad, 400, "invalid-field").await["field"], "idempotency-key");
    assert_eq!(projects(&server).await, 2);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn refusals_are_repeated_too_unless_the_request_was_not_read_to_its_end() {
    let server = Server::start().await;
    let project = server.project().await;
    for repeated in [false, true] {
        let answer = post(&server, "/v1/projects", "k").json(&json!({ "name": "" })).send().await.unwrap();
        assert_eq!((answer.status().as_u16(), replayed(&answer)), (400, repeated));
    }
    for _ in 0..2 {
        let path = format!("{project}/scans?name=a.ply&units=furlong");
        let answer = post(&server, &path, "l").body(room(0.0)).send().await.unwrap();
        assert!(!replayed(&answer));
        problem(answer, 400, "invalid-field").await;
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_that_is_sent_again_is_answered_as_before() {
    let server = Server::start().await;
    let project = server.project().await;
    let path = format!("{project}/scans?name=a.ply");
    let first = post(&server, &path, "k").body(room(0.0)).send().await.unwrap();
    assert_eq!(first.status(), 202);
    let first: Value = first.json().await.unwrap();
    let again = post(&server, &path, "k").body(room(0.0)).send().await.unwrap();
    assert_eq!((again.status().as_u16(), replayed(&again)), (202, true));
    assert_eq!(again.json::<Value>().await.unwrap(), first);
    let other = post(&server, &path, "k").body(room(0.1)).send().await.unwrap();
    problem(other, 422, "key-reused").await;
    // Without a key, or with a new one, it is an explicit duplicate.
    let duplicate = post(&server, &path, "l").body(room(0.0)).send().await.unwrap();
    assert_eq!(duplicate.status(), 200);
    assert_eq!(duplicate.json::<Value>().await.unwrap()["duplicate"], true);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_resumable_upload_that_is_announced_twice_is_one() {
    let server = Server::start().await;
    let project = server.project().await;
    let announce = async || {
        let metadata = format!("project {},name YQ==", base64(project.rsplit('/').next().unwrap()));
        let request = post(&server, "/v1/uploads", "k").header("tus-resumable", "1.0.0");
        request.header("upload-length", 1000).header("upload-metadata", metadata).send().await.unwrap()
    };
    let (first, again) = (announce().await, announce().await);
    assert_eq!((first.status().as_u16(), replayed(&again)), (201, true));
    assert_eq!(first.headers()["location"], again.headers()["location"]);
    assert_eq!(again.headers()["tus-resumable"], "1.0.0");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_refusal_for_want_of_room_is_not_given_again_when_there_is_room() {
    let settings = Settings {
        webhook_hosts: Some(vec!["127.0.0.1".to_owned()]),
        webhook_networks: Some(vec!["127.0.0.0/8".to_owned()]),
        ..Settings::default()
    };
    let server = Server::with(settings).await;
    let path = format!("{}/webhooks", server.project().await);
    let register = async |key: &str| {
        let body = json!({ "url": "http://127.0.0.1:9/hook" });
        post(&server, &path, key).json(&body).send().await.unwrap()
    };
    let mut last = String::new();
    for i in 0..20 {
        let made = register(&format!("key-{i}")).await;
        assert_eq!(made.status(), 201);
        last = made.headers()["location"].to_str().unwrap().to_owned();
    }
    problem(register("k").await, 409, "too-many-webhooks").await;
    assert_eq!(server.client.delete(server.url(&last)).send().await.unwrap().status(), 204);
    assert_eq!(register("k").await.status(), 201);
    assert!(replayed(&register("k").await));
    server.stop().await;
}

fn base64(text: &str) -> String {
    use base64::Engine as _;
    base64::engine::general_purpose::STANDARD.encode(text)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_whose_request_still_runs_is_refused() {
    let server = Server::start().await;
    let project = server.project().await;
    let path = format!("{project}/scans?name=a.ply");
    let (sender, receiver) = tokio::sync::mpsc::channel::<Result<Vec<u8>, std::io::Error>>(2);
    let pieces = futures_util::stream::unfold(receiver, |mut r| async { r.recv().await.map(|p| (p, r)) });
    let first = tokio::spawn(post(&server, &path, "k").body(Body::wrap_stream(pieces)).send());
    let mut whole = room(0.0);
    // So much that the first part of it goes to the disk before the rest is there.
    whole.resize(3 << 20, b'\n');
    sender.send(Ok(whole[..2 << 20].to_vec())).await.unwrap();
    while server.files("blobs/partial") == 0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let second = post(&server, &path, "k").body("ply").send().await.unwrap();
    problem(second, 409, "request-running").await;
    sender.send(Ok(whole[2 << 20..].to_vec())).await.unwrap();
    drop(sender);
    assert_eq!(first.await.unwrap().unwrap().status(), 202);
    let again = post(&server, &path, "k").body(whole).send().await.unwrap();
    assert!(replayed(&again));
    server.stop().await;
}
