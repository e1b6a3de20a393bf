//! Uploads: streamed, limited, recognised, and never taken in twice.

use bytes::Bytes;
use cairn::config::Settings;
use futures_util::stream;
use reqwest::Body;
use serde_json::Value;

use crate::server::{Server, problem, room};

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_without_a_length_is_streamed_and_comes_back_byte_for_byte() {
    let server = Server::start().await;
    let project = server.project().await;
    let bytes = room(0.0);
    let answer = server.upload(&project, "name=a.ply", in_pieces(&bytes)).await;
    assert_eq!(answer.status(), 202);
    assert!(answer.headers()["location"].to_str().unwrap().starts_with("/v1/jobs/"));
    assert!(answer.headers().contains_key("retry-after"));
    let answer: Value = answer.json().await.unwrap();
    assert_eq!(answer["scan"]["bytes"], bytes.len());
    assert_eq!(answer["scan"]["blake3"], blake3::hash(&bytes).to_hex().as_str());
    let path = format!("{project}/scans/{}/original", answer["scan"]["id"].as_str().unwrap());
    assert_eq!(server.get(&path).await.bytes().await.unwrap(), bytes);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_over_the_limit_is_refused_whether_it_says_so_or_not() {
    let server = Server::with(Settings { max_upload_bytes: Some(100_000), ..Settings::default() }).await;
    let project = server.project().await;
    let bytes = room(0.0);
    let said = server.upload(&project, "name=a.ply", bytes.clone()).await;
    assert_eq!(problem(said, 413, "too-large").await["limit"], 100_000);
    let unsaid = server.upload(&project, "name=a.ply", in_pieces(&bytes)).await;
    assert_eq!(problem(unsaid, 413, "too-large").await["limit"], 100_000);
    assert!(server.json(&format!("{project}/scans")).await["items"].as_array().unwrap().is_empty());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scan_that_failed_is_tried_again_when_it_comes_again() {
    let server = Server::start().await;
    let project = server.project().await;
    let bad = b"0 0 0\n1 0 0\n0 1 0\n1 1 0\n".to_vec();
    let (first, job) = server.registered(&project, "four.xyz", bad.clone()).await;
    assert_eq!(job["status"], "failed", "{job}");
    let again = server.accepted(&project, "four%20again.xyz", bad).await;
    assert_eq!((&again["scan"]["id"], &again["duplicate"]), (&first["id"], &Value::from(false)));
    assert_eq!(again["scan"]["name"], "four again.xyz");
    assert_ne!(again["job"]["id"], job["id"]);
    assert_eq!(server.ended(&again["job"]).await["status"], "failed");
    let list = server.json(&format!("{project}/scans")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 1);
    assert_eq!(list["items"][0]["state"], "failed");
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_content_is_one_scan_and_read_otherwise_it_is_another() {
    let server = Server::start().await;
    let project = server.project().await;
    let first = server.accepted(&project, "a.ply", room(0.0)).await;
    let again = server.upload(&project, "name=b.ply", room(0.0)).await;
    assert_eq!(again.status(), 200);
    let again: Value = again.json().await.unwrap();
    assert_eq!((&first["duplicate"], &again["duplicate"]), (&false.into(), &true.into()));
    assert_eq!(again["scan"]["id"], first["scan"]["id"]);
    assert_eq!(again["job"]["id"], first["job"]["id"]);
    let in_feet = server.upload(&project, "name=c.ply&units=ft", room(0.0)).await;
    assert_eq!(in_feet.status(), 202);
    let in_feet: Value = in_feet.json().await.unwrap();
    assert_ne!(in_feet["scan"]["id"], first["scan"]["id"]);
    assert_eq!(in_feet["scan"]["metres_per_unit"], 0.3048);
    // Another project knows nothing of it.
    let other = server.project().await;
    assert_eq!(server.upload(&other, "name=a.ply", room(0.0)).await.status(), 202);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_an_upload_says_of_its_sensor_is_kept_and_heard() {
    let server = Server::start().await;
    let project = server.project().await;
    // The same room upright and, as it says, upside down: no pose may lay the one onto the other.
    let told = server.upload(&project, "name=a.ply&up=0,0,2&sensor_position=0,-0.5,0.5", room(0.0)).await;
    let told: Value = told.json().await.unwrap();
    assert_eq!(told["scan"]["up"], serde_json::json!([0.0, 0.0, 2.0]));
    assert_eq!(told["scan"]["sensor_position"], serde_json::json!([0.0, -0.5, 0.5]));
    let other = server.upload(&project, "name=b.ply&up=0,0,-1", room(0.1)).await;
    let other: Value = other.json().await.unwrap();
    for answer in [&told, &other] {
        server.ended(&answer["job"]).await;
    }
    let model = server.json(&format!("{project}/model")).await;
    assert_eq!(model["components"], serde_json::json!([]), "{model}");
    assert_eq!(server.accepted(&project, "c.ply", room(0.2)).await["scan"]["up"], Value::Null);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn parameters_that_make_no_sense_are_named() {
    let server = Server::start().await;
    let project = server.project().await;
    for (query, field) in [
        ("", "name"),
        ("name=", "name"),
        ("name=a%0Ab", "name"),
        ("name=a&units=furlong", "units"),
        ("name=a&units=0", "units"),
        ("name=a&units=1e300", "units"),
        ("name=a&sensor_position=1,2", "sensor_position"),
        ("name=a&sensor_position=1,2,nan", "sensor_position"),
        ("name=a&up=0,0,0", "up"),
        ("name=a&up=0,1", "up"),
        ("name=a&nmae=b", "nmae"),
    ] {
        let found = problem(server.upload(&project, query, room(0.0)).await, 400, "invalid-field").await;
        assert_eq!(found["field"], field, "{query}: {found}");
    }
    let nowhere = "/v1/projects/01ARZ3NDEKTSV4RRFFQ69G5FAV";
    problem(server.upload(nowhere, "name=a", room(0.0)).await, 404, "not-found").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_that_falls_silent_is_given_up() {
    let server = Server::with(Settings { upload_idle_seconds: Some(1), ..Settings::default() }).await;
    let project = server.project().await;
    let pieces = stream::unfold(0, |i| async move {
        if i > 0 {
            tokio::time::sleep(std::time::Duration::from_secs(30)).await;
        }
        Some((Ok::<_, std::io::Error>(Bytes::from_static(b"ply\n")), i + 1))
    });
    let answer = server.upload(&project, "name=a.ply", Body::wrap_stream(pieces)).await;
    problem(answer, 408, "upload-stalled").await;
    server.stop().await;
}

fn in_pieces(bytes: &[u8]) -> Body {
    let pieces: Vec<Result<Bytes, std::io::Error>> =
        bytes.chunks(5000).map(|c| Ok(Bytes::copy_from_slice(c))).collect();
    Body::wrap_stream(stream::iter(pieces))
}
