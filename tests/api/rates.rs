//! What one address may do, whoever else is served: requests, keys that open nothing, connections.

use std::time::Duration;

use cairn::config::Settings;
use cairn::project::{Reach, Scope};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::access::unlimited;
use crate::server::{Server, problem};

/// A proxy on this machine is believed, so that requests can come from anywhere.
fn behind_a_proxy() -> Settings {
    Settings { trusted_proxies: Some(vec!["127.0.0.1".to_owned()]), ..Settings::default() }
}

async fn ask(server: &Server, from: Option<&str>, key: Option<&str>) -> reqwest::Response {
    let mut request = server.client.get(server.url("/v1/projects"));
    if let Some(from) = from {
        request = request.header("x-forwarded-for", from);
    }
    if let Some(key) = key {
        request = request.bearer_auth(key);
    }
    request.send().await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_that_asks_too_often_is_told_when_to_ask_again_and_others_are_served() {
    let server = Server::with(Settings { requests_per_second: Some(1), ..behind_a_proxy() }).await;
    let mut answers = Vec::new();
    for _ in 0..30 {
        answers.push(ask(&server, Some("198.51.100.1"), None).await);
    }
    assert!(answers.iter().take(10).all(|answer| answer.status() == 200), "a burst is let through");
    let refused = answers.pop().unwrap();
    let wait: u64 = refused.headers()["retry-after"].to_str().unwrap().parse().unwrap();
    assert!((1..=10).contains(&wait), "{wait}");
    let body = problem(refused, 429, "too-many-requests").await;
    assert!(body["detail"].as_str().unwrap().contains("198.51.100.1"), "{body}");
    assert_eq!(ask(&server, Some("198.51.100.2"), None).await.status(), 200);
    assert_eq!(ask(&server, None, None).await.status(), 200, "the proxy itself");
    server.stop().await;

    // Whoever is not trusted is counted as it is, whatever it says.
    let server = Server::with(Settings { requests_per_second: Some(1), ..Settings::default() }).await;
    let mut refused = 0;
    for i in 0..30 {
        let made_up = format!("198.51.100.{i}");
        refused += usize::from(ask(&server, Some(&made_up), None).await.status() == 429);
    }
    assert!(refused > 0);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn keys_that_open_nothing_are_refused_ever_earlier_and_lock_nobody_out() {
    let server = Server::with(Settings { failures_per_minute: Some(3), ..behind_a_proxy() }).await;
    let good = unlimited(&server, Scope::Read, Reach::Everything).await;
    let bad = format!("{}x", &good[..good.len() - 1]);
    for _ in 0..3 {
        problem(ask(&server, Some("198.51.100.1"), Some(&bad)).await, 401, "bad-key").await;
    }
    let refused = ask(&server, Some("198.51.100.1"), Some(&bad)).await;
    assert!(refused.headers().contains_key("retry-after"));
    problem(refused, 429, "too-many-failures").await;
    problem(ask(&server, Some("198.51.100.1"), None).await, 401, "no-key").await;
    assert_eq!(ask(&server, Some("198.51.100.1"), Some(&good)).await.status(), 200);
    problem(ask(&server, Some("198.51.100.2"), Some(&bad)).await, 401, "bad-key").await;
    server.stop().await;
}

/// Connects and asks; what comes back until the end, or until the head of an answer.
async fn connected(server: &Server) -> (TcpStream, String) {
    let address = server.url("").trim_start_matches("http://").to_owned();
    let mut stream = TcpStream::connect(address).await.unwrap();
    // A connection that is closed at once may refuse this already.
    let _ = stream.write_all(b"GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n").await;
    let mut answer = [0; 15];
    let read = timeout(Duration::from_secs(30), stream.read(&mut answer)).await.unwrap().unwrap_or(0);
    (stream, String::from_utf8_lossy(&answer[..read]).into_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_address_that_holds_its_connections_gets_no_more_and_a_trusted_proxy_does() {
    let settings = Settings { max_connections_per_address: Some(2), ..Settings::default() };
    let server = Server::with(settings.clone()).await;
    let (first, answer) = connected(&server).await;
    assert_eq!(answer, "HTTP/1.1 200 OK");
    let (_second, answer) = connected(&server).await;
    assert_eq!(answer, "HTTP/1.1 200 OK");
    assert_eq!(connected(&server).await.1, "", "the third is closed");
    drop(first);
    let mut tries = 0;
    // That the first is gone is noticed in a moment.
    while connected(&server).await.1.is_empty() {
        tries += 1;
        assert!(tries < 100);
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    server.stop().await;

    let server = Server::with(settings.or(behind_a_proxy())).await;
    let mut held = Vec::new();
    for _ in 0..5 {
        let (stream, answer) = connected(&server).await;
        assert_eq!(answer, "HTTP/1.1 200 OK");
        held.push(stream);
    }
    drop(held);
    server.stop().await;
}
