//! What the service does not take: more than a project or a key may have, more than it can do, and clients that dawdle.

use std::time::Duration;

use cairn::config::Settings;
use cairn::project::{Limits, Reach, Scope};
use futures_util::future::join_all;
use reqwest::Method;
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;

use crate::access::{ANNOUNCED, announce, announcement, key};
use crate::server::{Server, problem, room};

/// Asks for a job on the whole model.
async fn queue(server: &Server, project: &str, token: Option<&str>) -> reqwest::Response {
    let request =
        server.client.post(server.url(&format!("{project}/jobs"))).json(&json!({ "kind": "rebuild" }));
    match token {
        Some(token) => request.bearer_auth(token),
        None => request,
    }
    .send()
    .await
    .unwrap()
}

fn retry_after(response: &reqwest::Response) -> u32 {
    response.headers()["retry-after"].to_str().unwrap().parse().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_project_that_has_its_scans_takes_no_more_until_one_is_deleted() {
    let settings = Settings { project_max_scans: Some(2), ..Settings::default() };
    let server = Server::with(settings).await;
    let project = server.project().await;
    let first = server.accepted(&project, "a.ply", room(0.0)).await;
    server.accepted(&project, "b.ply", room(0.1)).await;
    let refused = server.upload(&project, "name=c.ply", room(0.2)).await;
    assert!(retry_after(&refused) > 0);
    let body = problem(refused, 429, "over-quota").await;
    assert_eq!(body["limit"], 2);
    let announced = announce(&server, project.rsplit('/').next().unwrap(), None).await;
    problem(announced, 429, "over-quota").await;
    let scan = format!("{project}/scans/{}", first["scan"]["id"].as_str().unwrap());
    let gone = server.client.delete(server.url(&scan)).send().await.unwrap();
    assert_eq!(gone.status(), 202);
    server.accepted(&project, "c.ply", room(0.2)).await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn uploads_at_once_cannot_pass_a_limit_that_each_alone_keeps() {
    let settings = Settings { project_max_scans: Some(3), ..Settings::default() };
    let server = Server::with(settings).await;
    let project = server.project().await;
    let sent: Vec<_> = (0..8)
        .map(|i| {
            let (client, url) = (server.client.clone(), server.url(&format!("{project}/scans?name={i}.ply")));
            tokio::spawn(async move {
                client.post(url).body(room(0.1 * f64::from(i))).send().await.unwrap().status()
            })
        })
        .collect();
    let mut taken = 0;
    for status in sent {
        let status = status.await.unwrap();
        assert!(status == 202 || status == 429, "{status}");
        taken += usize::from(status == 202);
    }
    assert_eq!(taken, 3);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_key_has_limits_of_its_own_in_whatever_project() {
    let server = Server::start().await;
    let (one, two) = (server.project().await, server.project().await);
    let bytes = room(0.0).len() as u64;
    let limits =
        Limits { bytes: Some(bytes + bytes / 2), scans: None, queued_jobs: Some(1), open_uploads: None };
    let (_, token) = key(&server, Scope::Manage, Reach::Everything, limits).await;
    let (_, other) = key(&server, Scope::Manage, Reach::Everything, Limits::default()).await;
    let send = |project: &str, token: &str| {
        let url = server.url(&format!("{project}/scans?name=a.ply"));
        server.client.post(url).body(room(0.0)).bearer_auth(token).send()
    };
    let accepted = send(&one, &token).await.unwrap();
    assert_eq!(accepted.status(), 202);
    let job: serde_json::Value = accepted.json().await.unwrap();
    let over = send(&two, &token).await.unwrap();
    let body = problem(over, 429, "over-quota").await;
    assert!(body["detail"].as_str().unwrap().starts_with("the key"), "{body}");
    assert_eq!(send(&two, &other).await.unwrap().status(), 202);

    let wait = server.url(&format!("/v1/jobs/{}?wait=60", job["job"]["id"].as_str().unwrap()));
    server.client.get(wait).bearer_auth(&token).send().await.unwrap().error_for_status().unwrap();
    // All at once, so that none of them has ended when the next is asked for.
    let asked = join_all((0..20).map(|_| queue(&server, &one, Some(&token)))).await;
    let answers: Vec<u16> = asked.iter().map(|answer| answer.status().as_u16()).collect();
    assert!(answers.contains(&202) && answers.contains(&429), "{answers:?}");
    assert_eq!(queue(&server, &one, Some(&other)).await.status(), 202);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn who_has_begun_as_many_uploads_as_allowed_ends_or_takes_back_one_first() {
    let server = Server::with(Settings { project_max_open_uploads: Some(2), ..Settings::default() }).await;
    let (path, other) = (server.project().await, server.project().await);
    let project = path.rsplit('/').next().unwrap();
    for _ in 0..2 {
        assert_eq!(announce(&server, project, None).await.status(), 201);
    }
    let refused = announce(&server, project, None).await;
    assert!(retry_after(&refused) > 0);
    assert_eq!(problem(refused, 429, "over-quota").await["limit"], 2);
    assert_eq!(announce(&server, other.rsplit('/').next().unwrap(), None).await.status(), 201);
    server.accepted(&path, "direct.ply", room(0.0)).await;

    let open = server.json(&format!("{path}/uploads")).await;
    let open: Vec<&str> =
        open["items"].as_array().unwrap().iter().map(|u| u["id"].as_str().unwrap()).collect();
    assert_eq!(open.len(), 2);
    let page = server.json(&format!("{path}/uploads?limit=1")).await;
    let rest = format!("{path}/uploads?limit=1&cursor={}", page["next"].as_str().unwrap());
    assert_eq!(server.json(&rest).await["items"][0]["id"], open[1]);
    let gone = server.client.delete(server.url(&format!("/v1/uploads/{}", open[0])));
    assert_eq!(gone.header("tus-resumable", "1.0.0").send().await.unwrap().status(), 204);
    assert_eq!(announce(&server, project, None).await.status(), 201);
    assert_eq!(announce(&server, project, None).await.status(), 429);

    server.sql("UPDATE uploads SET expires_ms = 1").await;
    assert_eq!(server.json(&format!("{path}/uploads")).await["items"], json!([]));
    assert_eq!(announce(&server, project, None).await.status(), 201, "what has expired counts no more");
    let limits = Limits { open_uploads: Some(1), ..Limits::default() };
    let (_, token) = key(&server, Scope::Upload, Reach::Everything, limits).await;
    assert_eq!(announce(&server, project, Some(&token)).await.status(), 201);
    let other = announce(&server, other.rsplit('/').next().unwrap(), Some(&token)).await;
    let body = problem(other, 429, "over-quota").await;
    assert!(body["detail"].as_str().unwrap().starts_with("the key"), "{body}");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_were_announced_are_spoken_for_and_those_that_the_disk_cannot_hold_are_refused() {
    let bytes = room(0.0).len() as u64;
    let settings = Settings {
        project_max_bytes: Some(bytes + ANNOUNCED - 1),
        max_upload_bytes: Some(1 << 45),
        ..Settings::default()
    };
    let server = Server::with(settings).await;
    let path = server.project().await;
    let project = path.rsplit('/').next().unwrap();
    assert_eq!(announce(&server, project, None).await.status(), 201);
    problem(server.upload(&path, "name=a.ply", room(0.0)).await, 429, "over-quota").await;
    server.sql("UPDATE uploads SET expires_ms = 1").await;
    server.accepted(&path, "a.ply", room(0.0)).await;
    server.stop().await;

    let server = Server::with(Settings { max_upload_bytes: Some(1 << 45), ..Settings::default() }).await;
    let path = server.project().await;
    let metadata = announcement(path.rsplit('/').next().unwrap());
    let vast = server.client.post(server.url("/v1/uploads")).header("tus-resumable", "1.0.0");
    let vast = vast.header("upload-length", 1_u64 << 45).header("upload-metadata", metadata);
    let refused = vast.send().await.unwrap();
    assert!(retry_after(&refused) > 0);
    problem(refused, 503, "low-disk").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_or_queue_stops_what_brings_work_and_nothing_else() {
    let settings = Settings { min_free_bytes: Some(u64::MAX), ..Settings::default() };
    let server = Server::with(settings).await;
    let made =
        server.client.post(server.url("/v1/projects")).json(&json!({ "name": "p" })).send().await.unwrap();
    assert!(retry_after(&made) > 0);
    problem(made, 503, "low-disk").await;
    assert_eq!(server.get("/v1/projects").await.status(), 200);
    server.stop().await;

    let server = Server::with(Settings { max_open_jobs: Some(1), ..Settings::default() }).await;
    let project = server.project().await;
    let mut answers = Vec::new();
    for i in 0..8 {
        answers.push(
            server
                .upload(&project, &format!("name={i}.ply"), room(0.1 * f64::from(i)))
                .await
                .status()
                .as_u16(),
        );
    }
    assert!(answers.contains(&202) && answers.contains(&503), "{answers:?}");
    assert_eq!(server.client.delete(server.url(&project)).send().await.unwrap().status(), 204);
    assert_eq!(
        server
            .client
            .post(server.url("/v1/projects"))
            .json(&json!({ "name": "p" }))
            .send()
            .await
            .unwrap()
            .status(),
        201
    );
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_can_be_asked_after_and_taken_back_by_post_while_the_disk_is_full() {
    let server = Server::start().await;
    let project = server.project().await;
    let announced = announce(&server, project.rsplit('/').next().unwrap(), None).await;
    let upload = announced.headers()["location"].to_str().unwrap().to_owned();
    let server =
        server.restart_with(Settings { min_free_bytes: Some(u64::MAX), ..Settings::default() }).await;
    let post = async |method: &str| {
        let request = server.client.post(server.url(&upload)).header("tus-resumable", "1.0.0");
        request.header("x-http-method-override", method).send().await.unwrap()
    };
    problem(post("PATCH").await, 503, "low-disk").await;
    assert_eq!(post("HEAD").await.headers()["upload-offset"], "0");
    assert_eq!(post("DELETE").await.status(), 204);
    problem(server.get(&upload).await, 404, "not-found").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn connections_that_dawdle_are_closed_and_do_not_keep_others_out() {
    let settings = Settings { idle_seconds: Some(1), max_connections: Some(3), ..Settings::default() };
    let server = Server::with(settings).await;
    let address = server.url("").trim_start_matches("http://").to_owned();
    // Silent; in the middle of a head; silent after an answer.
    let mut held = Vec::new();
    for sent in ["", "GET /healthz HTT", "GET /healthz HTTP/1.1\r\nhost: localhost\r\n\r\n"] {
        let mut stream = TcpStream::connect(&address).await.unwrap();
        stream.write_all(sent.as_bytes()).await.unwrap();
        held.push(stream);
    }
    // All places are taken; one becomes free although nobody lets go.
    let waited = timeout(Duration::from_secs(30), server.get("/healthz")).await.unwrap();
    assert_eq!(waited.status(), 200);
    for mut stream in held {
        let mut rest = Vec::new();
        let end = timeout(Duration::from_secs(30), stream.read_to_end(&mut rest)).await;
        assert!(end.is_ok(), "the service closes it");
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_head_that_is_too_long_is_refused() {
    let server = Server::start().await;
    let long = server.client.get(server.url("/healthz")).header("x-long", "x".repeat(200_000));
    let answer = long.send().await.map(|answer| answer.status().as_u16());
    assert!(answer.is_err() || answer.is_ok_and(|status| status == 431), "it must not be read whole");
    assert_eq!(server.get("/healthz").await.status(), 200);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn other_sites_are_told_nothing_unless_they_are_listed() {
    let server = Server::start().await;
    let asked = |server: &Server, method: Method, origin: &str| {
        let request =
            server.client.request(method, server.url("/healthz")).header("origin", origin.to_owned());
        request.header("access-control-request-method", "GET").send()
    };
    let answer = asked(&server, Method::GET, "https://viewer.example").await.unwrap();
    assert!(!answer.headers().keys().any(|name| name.as_str().starts_with("access-control")));
    for (name, value) in [("x-content-type-options", "nosniff"), ("referrer-policy", "no-referrer")] {
        assert_eq!(answer.headers()[name], value);
    }
    let policy = answer.headers()["content-security-policy"].to_str().unwrap();
    assert!(policy.contains("frame-ancestors 'none'") && !policy.contains("unsafe"), "{policy}");
    let page = server.get("/").await;
    let policy = page.headers()["content-security-policy"].to_str().unwrap();
    assert!(policy.contains("frame-ancestors 'none'") && !policy.contains("unsafe"), "{policy}");
    server.stop().await;

    let origins = vec!["https://viewer.example".to_owned()];
    let server = Server::with(Settings { cors_origins: Some(origins), ..Settings::default() }).await;
    for (origin, allowed) in [("https://viewer.example", true), ("https://evil.example", false)] {
        for method in [Method::GET, Method::OPTIONS] {
            let answer = asked(&server, method, origin).await.unwrap();
            let told = answer.headers().get("access-control-allow-origin").is_some_and(|o| o == origin);
            assert_eq!(told, allowed, "{origin}");
        }
    }
    server.stop().await;
}
