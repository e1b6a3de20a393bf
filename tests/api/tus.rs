//! Resumable uploads: tus 1.0 over real HTTP.

use std::io::Write as _;
use std::time::Duration;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use cairn::config::Settings;
use futures_util::stream;
use reqwest::{Body, Method, RequestBuilder, Response};
use serde_json::Value;
use sha2::{Digest as _, Sha256};

use crate::server::{Server, problem, room};

/// A request that speaks tus.
fn tus(server: &Server, method: &str, path: &str) -> RequestBuilder {
    let method = Method::from_bytes(method.as_bytes()).unwrap();
    server.client.request(method, server.url(path)).header("tus-resumable", "1.0.0")
}

fn metadata(project: &str, more: &[(&str, &str)]) -> String {
    let project = project.rsplit('/').next().unwrap();
    let pairs = std::iter::once(("project", project)).chain(more.iter().copied());
    pairs.map(|(key, value)| format!("{key} {}", STANDARD.encode(value))).collect::<Vec<_>>().join(",")
}

fn announce(server: &Server, project: &str, length: usize) -> RequestBuilder {
    tus(server, "POST", "/v1/uploads")
        .header("upload-length", length)
        .header("upload-metadata", metadata(project, &[("filename", "a.ply")]))
}

/// Announces an upload and returns its path.
async fn begun(server: &Server, project: &str, length: usize) -> String {
    let answer = announce(server, project, length).send().await.unwrap();
    assert_eq!(answer.status(), 201);
    header(&answer, "location").to_owned()
}

fn patch(server: &Server, upload: &str, offset: usize, bytes: impl Into<Body>) -> RequestBuilder {
    tus(server, "PATCH", upload)
        .header("upload-offset", offset)
        .header("content-type", "application/offset+octet-stream")
        .body(bytes)
}

async fn offset(server: &Server, upload: &str) -> usize {
    let answer = tus(server, "HEAD", upload).send().await.unwrap();
    assert_eq!(answer.status(), 200);
    assert_eq!(header(&answer, "cache-control"), "no-store");
    header(&answer, "upload-offset").parse().unwrap()
}

fn header<'a>(answer: &'a Response, name: &str) -> &'a str {
    answer.headers().get(name).unwrap_or_else(|| panic!("{name} in {answer:?}")).to_str().unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_in_pieces_survives_a_restart_and_ends_as_the_scan_that_a_direct_one_would_be() {
    let mut server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let upload = begun(&server, &project, bytes.len()).await;
    let mut sent = 0;
    for piece in bytes.chunks(bytes.len() / 4 + 1) {
        assert_eq!(offset(&server, &upload).await, sent);
        let shown = server.json(&upload).await;
        assert_eq!((&shown["offset"], &shown["scan"]), (&sent.into(), &Value::Null));
        let answer = patch(&server, &upload, sent, piece.to_vec()).send().await.unwrap();
        sent += piece.len();
        assert_eq!(answer.status(), 204);
        assert_eq!(header(&answer, "upload-offset"), sent.to_string());
        assert_eq!(answer.headers().contains_key("upload-expires"), sent < bytes.len());
        if sent < bytes.len() {
            server = server.restart().await;
        } else {
            assert_eq!(header(&answer, "cairn-duplicate"), "false");
            let scan = server.json(header(&answer, "cairn-scan")).await;
            assert_eq!((&scan["name"], &scan["bytes"]), (&"a.ply".into(), &bytes.len().into()));
            assert_eq!(scan["blake3"], blake3::hash(&bytes).to_hex().as_str());
            let job = server.json(header(&answer, "cairn-job")).await;
            assert_eq!(server.ended(&job).await["status"], "succeeded");
        }
    }
    assert_eq!(server.files("uploads"), 0);
    // A client that lost the last answer finds the scan, and so does one that never saw it.
    let head = tus(&server, "HEAD", &upload).send().await.unwrap();
    assert_eq!(header(&head, "upload-offset"), header(&head, "upload-length"));
    let shown = server.json(&upload).await;
    assert_eq!(header(&head, "cairn-scan"), shown["scan"]["links"][1]["href"]);
    let direct: Value = server.upload(&project, "name=b.ply", bytes).await.json().await.unwrap();
    assert_eq!((&direct["duplicate"], &direct["scan"]["id"]), (&true.into(), &shown["scan"]["id"]));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn content_that_the_project_has_is_an_explicit_duplicate() {
    let server = Server::start().await;
    let project = server.project().await;
    let direct = server.accepted(&project, "a.ply", room(0.0)).await;
    let bytes = room(0.0);
    let answer = announce(&server, &project, bytes.len())
        .header("content-type", "application/offset+octet-stream")
        .body(bytes)
        .send()
        .await
        .unwrap();
    assert_eq!(answer.status(), 201);
    assert_eq!(header(&answer, "cairn-duplicate"), "true");
    assert!(header(&answer, "cairn-scan").ends_with(direct["scan"]["id"].as_str().unwrap()));
    let shown = server.json(header(&answer, "location")).await;
    assert_eq!((&shown["duplicate"], &shown["job"]["id"]), (&true.into(), &direct["job"]["id"]));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_came_before_a_broken_connection_is_kept() {
    let server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let upload = begun(&server, &project, bytes.len()).await;
    let half = bytes.len() / 2;
    {
        // Two thirds are announced, half of all comes, and the connection breaks.
        let mut raw = std::net::TcpStream::connect(server.url("").trim_start_matches("http://")).unwrap();
        let head = format!(
            "PATCH {upload} HTTP/1.1\r\nhost: localhost\r\ntus-resumable: 1.0.0\r\nupload-offset: 0\r\n\
             content-type: application/offset+octet-stream\r\ncontent-length: {}\r\n\r\n",
            bytes.len() * 2 / 3
        );
        raw.write_all(head.as_bytes()).unwrap();
        raw.write_all(&bytes[..half]).unwrap();
        raw.shutdown(std::net::Shutdown::Write).unwrap();
        // The answer says that it broke; then everything that came is safe.
        let mut answer = String::new();
        std::io::Read::read_to_string(&mut raw, &mut answer).unwrap_or_default();
    }
    let kept = offset(&server, &upload).await;
    assert_eq!(kept, half);
    let answer = patch(&server, &upload, kept, bytes[kept..].to_vec()).send().await.unwrap();
    let scan = server.json(header(&answer, "cairn-scan")).await;
    assert_eq!(scan["blake3"], blake3::hash(&bytes).to_hex().as_str());
    server.stop().await;
}

/// A body that sends `first` and then nothing more.
fn stuck(first: Vec<u8>) -> Body {
    Body::wrap_stream(stream::unfold(Some(first), |first| async move {
        match first {
            Some(first) => Some((Ok::<_, std::io::Error>(Bytes::from(first)), None)),
            None => std::future::pending().await,
        }
    }))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_later_request_takes_an_upload_over_from_one_that_hangs() {
    let server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let upload = begun(&server, &project, bytes.len()).await;
    let hanging = tokio::spawn(patch(&server, &upload, 0, stuck(bytes[..1000].to_vec())).send());
    // Looking does not disturb, and at some point the bytes are in the file.
    while server.files("uploads") == 0 {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    assert_eq!(server.json(&upload).await["offset"], 0);
    let kept = offset(&server, &upload).await;
    assert!(kept == 0 || kept == 1000, "{kept}");
    problem(hanging.await.unwrap().unwrap(), 409, "taken-over").await;
    let answer = patch(&server, &upload, kept, bytes[kept..].to_vec()).send().await.unwrap();
    assert_eq!(answer.status(), 204);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_request_that_falls_silent_is_given_up_and_its_bytes_are_kept() {
    let server = Server::with(Settings { upload_idle_seconds: Some(1), ..Settings::default() }).await;
    let project = server.project().await;
    let bytes = room(0.0);
    let upload = begun(&server, &project, bytes.len()).await;
    let answer = patch(&server, &upload, 0, stuck(bytes[..1000].to_vec())).send().await.unwrap();
    problem(answer, 408, "upload-stalled").await;
    assert_eq!(offset(&server, &upload).await, 1000);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_were_changed_on_the_way_are_refused_and_not_kept() {
    let server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let upload = begun(&server, &project, bytes.len()).await;
    let sha256 = STANDARD.encode(Sha256::digest(&bytes));
    let mut changed = bytes.clone();
    changed[70_000] ^= 1;
    for (name, value) in
        [("upload-checksum", format!("sha256 {sha256}")), ("content-digest", format!("sha-256=:{sha256}:"))]
    {
        let request = patch(&server, &upload, 0, changed.clone()).header(name, value);
        problem(request.send().await.unwrap(), 460, "checksum-mismatch").await;
        assert_eq!(offset(&server, &upload).await, 0, "{name}");
        let direct = server.client.post(server.url(&format!("{project}/scans?name=a.ply")));
        let digest = format!("sha-256=:{sha256}:");
        let direct = direct.header("content-digest", digest).body(changed.clone()).send().await.unwrap();
        problem(direct, 400, "digest-mismatch").await;
    }
    assert!(server.json(&format!("{project}/scans")).await["items"].as_array().unwrap().is_empty());
    let whole = patch(&server, &upload, 0, bytes).header("upload-checksum", format!("sha256 {sha256}"));
    assert_eq!(whole.send().await.unwrap().status(), 204);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_service_says_what_it_speaks_and_refuses_what_it_does_not() {
    let server = Server::with(Settings { max_upload_bytes: Some(1_000_000), ..Settings::default() }).await;
    let project = server.project().await;
    let upload = begun(&server, &project, 1000).await;
    let options = server.client.request(Method::OPTIONS, server.url("/v1/uploads")).send().await.unwrap();
    assert_eq!(options.status(), 204);
    assert_eq!(header(&options, "tus-version"), "1.0.0");
    assert_eq!(header(&options, "tus-max-size"), "1000000");
    assert_eq!(
        header(&options, "tus-extension"),
        "creation,creation-with-upload,checksum,expiration,termination"
    );
    assert_eq!(header(&options, "tus-checksum-algorithm"), "sha1,sha256,sha512");

    let old = server.client.head(server.url(&upload)).header("tus-resumable", "0.2.2").send().await.unwrap();
    assert_eq!((old.status().as_u16(), header(&old, "tus-version")), (412, "1.0.0"));
    let none = server.client.delete(server.url(&upload)).send().await.unwrap();
    problem(none, 412, "unsupported-tus-version").await;

    let answer = announce(&server, &project, 1_000_001).send().await.unwrap();
    assert_eq!(problem(answer, 413, "too-large").await["limit"], 1_000_000);
    problem(announce(&server, &project, 0).send().await.unwrap(), 422, "empty-upload").await;
    let nowhere = "01ARZ3NDEKTSV4RRFFQ69G5FAV";
    problem(announce(&server, nowhere, 5).send().await.unwrap(), 404, "not-found").await;
    let partial = announce(&server, &project, 5).header("upload-concat", "partial").send().await.unwrap();
    problem(partial, 400, "invalid-field").await;
    let typed = announce(&server, &project, 5).body("12345").send().await.unwrap();
    problem(typed, 415, "not-upload-bytes").await;
    let misspelled = metadata(&project, &[("name", "a.ply"), ("unit", "mm")]);
    let request = tus(&server, "POST", "/v1/uploads").header("upload-length", 5);
    let answer = request.header("upload-metadata", misspelled).send().await.unwrap();
    assert_eq!(problem(answer, 400, "invalid-field").await["field"], "unit");

    problem(patch(&server, &upload, 1, "x").send().await.unwrap(), 409, "offset-mismatch").await;
    let over = patch(&server, &upload, 0, room(0.0)).send().await.unwrap();
    assert_eq!(problem(over, 413, "past-end").await["limit"], 1000);
    let unsaid = Body::wrap_stream(stream::iter([Ok::<_, std::io::Error>(room(0.0))]));
    problem(patch(&server, &upload, 0, unsaid).send().await.unwrap(), 413, "past-end").await;
    let unknown = patch(&server, &upload, 0, "x").header("upload-checksum", "crc32 AAAAAA==");
    problem(unknown.send().await.unwrap(), 400, "invalid-field").await;
    let typed = tus(&server, "PATCH", &upload).header("upload-offset", 0).body("x").send().await.unwrap();
    problem(typed, 415, "not-upload-bytes").await;
    assert_eq!(offset(&server, &upload).await, 0);
    for path in ["/v1/uploads/01ARZ3NDEKTSV4RRFFQ69G5FAV", "/v1/uploads/x"] {
        assert_eq!(tus(&server, "HEAD", path).send().await.unwrap().status(), 404);
        problem(patch(&server, path, 0, "x").send().await.unwrap(), 404, "not-found").await;
    }
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_can_be_taken_back_and_one_that_expired_is_gone() {
    let server = Server::start().await;
    let project = server.project().await;
    let upload = begun(&server, &project, 1000).await;
    patch(&server, &upload, 0, "1 2 3\n").send().await.unwrap();
    assert_eq!(server.files("uploads"), 1);
    assert_eq!(tus(&server, "DELETE", &upload).send().await.unwrap().status(), 204);
    assert_eq!(server.files("uploads"), 0);
    assert_eq!(tus(&server, "HEAD", &upload).send().await.unwrap().status(), 404);

    let upload = begun(&server, &project, 1000).await;
    server.sql("UPDATE uploads SET expires_ms = 1").await;
    assert_eq!(tus(&server, "HEAD", &upload).send().await.unwrap().status(), 410);
    problem(patch(&server, &upload, 0, "x").send().await.unwrap(), 410, "upload-expired").await;
    problem(server.get(&upload).await, 410, "upload-expired").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn content_that_cannot_become_a_scan_ends_the_upload_at_once() {
    let server = Server::start().await;
    let project = server.project().await;
    let upload = begun(&server, &project, 1_000_000).await;
    let answer = patch(&server, &upload, 0, vec![0; 20_000]).send().await.unwrap();
    problem(answer, 415, "unknown-format").await;
    assert_eq!(tus(&server, "HEAD", &upload).send().await.unwrap().status(), 404);
    let answer = announce(&server, &project, 6)
        .header("content-type", "application/offset+octet-stream")
        .body("1 2 3\n")
        .send()
        .await
        .unwrap();
    problem(answer, 422, "wrong-extension").await;
    assert_eq!(server.files("uploads"), 0);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_post_may_stand_for_another_method() {
    let server = Server::start().await;
    let project = server.project().await;
    let upload = begun(&server, &project, 1000).await;
    let post = |method: &'static str| tus(&server, "POST", &upload).header("x-http-method-override", method);
    let answer = post("PATCH")
        .header("upload-offset", 0)
        .header("content-type", "application/offset+octet-stream")
        .body("1 2 3\n")
        .send()
        .await
        .unwrap();
    assert_eq!((answer.status().as_u16(), header(&answer, "upload-offset")), (204, "6"));
    let answer = post("HEAD").send().await.unwrap();
    assert_eq!((answer.status().as_u16(), header(&answer, "upload-offset")), (200, "6"));
    problem(post("PUT").send().await.unwrap(), 405, "method-not-allowed").await;
    assert_eq!(post("DELETE").send().await.unwrap().status(), 204);
    assert_eq!(post("GET").send().await.unwrap().status(), 404);
    server.stop().await;
}
