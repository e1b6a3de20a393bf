//! Webhooks, with a receiver that the test is.

use std::sync::{Arc, Mutex};

use axum::Router;
use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::routing::post;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use cairn::config::Settings;
use cairn::jobs::webhooks::signature;
use cairn::project::SigningSecret;
use reqwest::Response;
use serde_json::{Value, json};
use tokio::net::TcpListener;
use tokio::sync::Notify;

use crate::server::{Server, problem, room};

/// A message as it arrived.
#[derive(Debug, Clone)]
struct Message {
    id: String,
    timestamp: i64,
    signature: String,
    body: String,
}

/// Takes messages, after it has answered with each of `answers` first.
#[derive(Debug, Default)]
struct Receiver {
    messages: Mutex<Vec<Message>>,
    answers: Mutex<Vec<StatusCode>>,
    arrived: Notify,
}

impl Receiver {
    /// A receiver and its address.
    async fn start(answers: &[u16]) -> (Arc<Self>, String) {
        let answers = answers.iter().rev().map(|status| StatusCode::from_u16(*status).unwrap()).collect();
        let receiver = Arc::new(Self { answers: Mutex::new(answers), ..Self::default() });
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let url = format!("http://{}/hook?token=1", listener.local_addr().unwrap());
        let app = Router::new().route("/hook", post(receive)).with_state(Arc::clone(&receiver));
        tokio::spawn(async move { axum::serve(listener, app).await });
        (receiver, url)
    }

    /// Waits until so many messages have arrived.
    async fn messages(&self, n: usize) -> Vec<Message> {
        let enough = async {
            loop {
                let arrived = self.arrived.notified();
                let messages = self.messages.lock().unwrap().clone();
                if messages.len() >= n {
                    return messages;
                }
                arrived.await;
            }
        };
        tokio::time::timeout(std::time::Duration::from_mins(1), enough).await.expect("messages should arrive")
    }
}

async fn receive(
    State(receiver): State<Arc<Receiver>>,
    request: Request,
) -> (StatusCode, [(&'static str, &'static str); 2]) {
    let (parts, body) = request.into_parts();
    let header = |name: &str| parts.headers[name].to_str().unwrap().to_owned();
    let body = axum::body::to_bytes(body, 1 << 20).await.unwrap();
    receiver.messages.lock().unwrap().push(Message {
        id: header("webhook-id"),
        timestamp: header("webhook-timestamp").parse().unwrap(),
        signature: header("webhook-signature"),
        body: String::from_utf8(body.to_vec()).unwrap(),
    });
    receiver.arrived.notify_one();
    let status = receiver.answers.lock().unwrap().pop().unwrap_or(StatusCode::OK);
    // Like a server of old, it closes the connection after each answer.
    (status, [("location", "/elsewhere"), ("connection", "close")])
}

/// A service that may speak to the receiver.
async fn allowed() -> Server {
    Server::with(Settings {
        webhook_hosts: Some(vec!["127.0.0.1".to_owned(), "localhost".to_owned()]),
        webhook_networks: Some(vec!["127.0.0.0/8".to_owned(), "::1/128".to_owned()]),
        webhook_retry_seconds: Some(1),
        ..Settings::default()
    })
    .await
}

async fn register(server: &Server, project: &str, url: &str) -> Response {
    let path = server.url(&format!("{project}/webhooks"));
    server.client.post(path).json(&json!({ "url": url })).send().await.unwrap()
}

fn secret(made: &Value) -> SigningSecret {
    let text = made["secret"].as_str().unwrap().strip_prefix("whsec_").unwrap();
    SigningSecret(STANDARD.decode(text).unwrap().try_into().unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_end_of_a_job_is_told_signed_and_told_again_until_it_is_taken() {
    let server = allowed().await;
    let project = server.project().await;
    let (receiver, url) = Receiver::start(&[500, 302]).await;
    let answer = register(&server, &project, &url).await;
    assert_eq!(answer.status(), 201);
    let own = answer.headers()["location"].to_str().unwrap().to_owned();
    let made: Value = answer.json().await.unwrap();
    let (_, job) = server.registered(&project, "a.ply", room(0.0)).await;

    let messages = receiver.messages(3).await;
    for message in &messages {
        assert_eq!((&message.id, &message.body), (&messages[0].id, &messages[0].body), "the same message");
        let expected = signature(&secret(&made), &message.id, message.timestamp, &message.body);
        assert_eq!(message.signature, expected);
    }
    let body: Value = serde_json::from_str(&messages[0].body).unwrap();
    assert_eq!(body["type"], "job.succeeded");
    assert_eq!((&body["data"]["id"], &body["data"]["outcome"]), (&job["id"], &job["outcome"]));

    let delivered = async {
        loop {
            let list = server.json(&format!("{own}/deliveries")).await;
            if list["items"][0]["state"] == "delivered" {
                return list;
            }
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
    };
    let list = tokio::time::timeout(std::time::Duration::from_secs(30), delivered).await.unwrap();
    assert_eq!(list["items"].as_array().unwrap().len(), 1);
    assert_eq!((&list["items"][0]["attempts"], &list["items"][0]["status"]), (&json!(3), &json!(200)));
    assert!(server.json(&own).await.get("secret").is_none(), "the secret is shown once");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn messages_wait_for_a_service_that_was_stopped() {
    let server = allowed().await;
    let project = server.project().await;
    // The receiver knows no such address, so the message waits for its next attempt.
    let (receiver, url) = Receiver::start(&[]).await;
    let dead = url.replace("/hook", "/nothing");
    assert_eq!(register(&server, &project, &dead).await.status(), 201);
    let (_, job) = server.registered(&project, "a.ply", room(0.0)).await;
    assert_eq!(job["status"], "succeeded");
    let server = server.restart().await;
    // Started without a list of hosts, it tells nobody, but keeps the message and says why.
    let hooks = server.json(&format!("{project}/webhooks")).await;
    let own = format!("{project}/webhooks/{}", hooks["items"][0]["id"].as_str().unwrap());
    let list = server.json(&format!("{own}/deliveries")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 1);
    assert!(receiver.messages.lock().unwrap().is_empty());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_sent_where_the_operator_has_not_allowed_it() {
    let server = Server::start().await;
    let project = server.project().await;
    let (_, url) = Receiver::start(&[]).await;
    let body = problem(register(&server, &project, &url).await, 400, "invalid-field").await;
    assert_eq!(body["field"], "url");
    server.stop().await;

    // The host is listed, but what it stands for is inside.
    let settings = Settings {
        webhook_hosts: Some(vec!["localhost".to_owned(), "127.0.0.1".to_owned()]),
        webhook_retry_seconds: Some(1),
        ..Settings::default()
    };
    let server = Server::with(settings).await;
    let project = server.project().await;
    let (receiver, url) = Receiver::start(&[]).await;
    let named = url.replace("127.0.0.1", "localhost");
    for url in [&url, &named] {
        assert_eq!(register(&server, &project, url).await.status(), 201);
    }
    server.registered(&project, "a.ply", room(0.0)).await;
    let hooks = server.json(&format!("{project}/webhooks")).await;
    for hook in hooks["items"].as_array().unwrap() {
        let path = format!("{project}/webhooks/{}/deliveries", hook["id"].as_str().unwrap());
        let refused = async {
            loop {
                let list = server.json(&path).await;
                if let Some(error) = list["items"][0]["error"].as_str() {
                    return error.to_owned();
                }
                tokio::time::sleep(std::time::Duration::from_millis(20)).await;
            }
        };
        let error = tokio::time::timeout(std::time::Duration::from_secs(30), refused).await.unwrap();
        assert!(error.contains("no address that messages may be sent to"), "{error}");
    }
    assert!(receiver.messages.lock().unwrap().is_empty());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_project_has_few_webhooks_and_a_deleted_one_is_told_nothing() {
    let server = allowed().await;
    let project = server.project().await;
    let (receiver, url) = Receiver::start(&[]).await;
    let mut paths = Vec::new();
    for _ in 0..20 {
        let answer = register(&server, &project, &url).await;
        paths.push(answer.headers()["location"].to_str().unwrap().to_owned());
    }
    problem(register(&server, &project, &url).await, 409, "too-many-webhooks").await;
    for path in &paths[1..] {
        assert_eq!(server.client.delete(server.url(path)).send().await.unwrap().status(), 204);
    }
    assert_eq!(server.get(&paths[1]).await.status(), 404);
    let other = server.project().await;
    let elsewhere = paths[0].replace(&project, &other);
    assert_eq!(server.get(&elsewhere).await.status(), 404);
    server.registered(&project, "a.ply", room(0.0)).await;
    server.registered(&project, "b.ply", room(0.3)).await;
    assert_eq!(receiver.messages(2).await.len(), 2);
    server.stop().await;
}
