//! Downloads: ranges, ETags, and versions that never change.

use reqwest::{Response, header};
use serde_json::Value;

use crate::server::{Server, problem, room};

async fn ranged(server: &Server, path: &str, range: &str) -> Response {
    server.client.get(server.url(path)).header(header::RANGE, range).send().await.unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn originals_are_served_in_ranges_and_not_sent_twice() {
    let server = Server::start().await;
    let project = server.project().await;
    let answer = server.accepted(&project, "a%20b.ply", room(0.0)).await;
    let path = format!("{project}/scans/{}/original", answer["scan"]["id"].as_str().unwrap());
    let whole = server.get(&path).await;
    let etag = whole.headers()["etag"].to_str().unwrap().to_owned();
    assert_eq!(whole.headers()["accept-ranges"], "bytes");
    let bytes = room(0.0);
    assert_eq!(whole.bytes().await.unwrap(), bytes);

    let part = ranged(&server, &path, "bytes=10-19").await;
    assert_eq!(part.status(), 206);
    assert_eq!(part.headers()["content-range"], format!("bytes 10-19/{}", bytes.len()));
    assert_eq!(part.headers()["content-length"], "10");
    assert_eq!(part.bytes().await.unwrap(), bytes[10..20]);
    let end = ranged(&server, &path, "bytes=-5").await;
    assert_eq!(end.bytes().await.unwrap(), bytes[bytes.len() - 5..]);

    let beyond = ranged(&server, &path, "bytes=999999999-").await;
    assert_eq!(beyond.headers()["content-range"], format!("bytes */{}", bytes.len()));
    problem(beyond, 416, "range-not-satisfiable").await;

    let held =
        server.client.get(server.url(&path)).header(header::IF_NONE_MATCH, &etag).send().await.unwrap();
    assert_eq!((held.status().as_u16(), held.headers()["etag"].to_str().unwrap()), (304, etag.as_str()));
    let stale = server.client.get(server.url(&path));
    let stale = stale.header(header::RANGE, "bytes=0-3").header(header::IF_RANGE, "\"another\"");
    assert_eq!(stale.send().await.unwrap().status(), 200);
    let head = server.client.head(server.url(&path)).send().await.unwrap();
    assert_eq!(head.headers()["content-length"], bytes.len().to_string().as_str());
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_cloud_of_a_version_is_the_same_file_for_ever() {
    let server = Server::start().await;
    let project = server.project().await;
    for i in 0..3u8 {
        server.registered(&project, &format!("{i}.ply"), room(f64::from(i) * 0.3)).await;
    }
    let model = server.json(&format!("{project}/model")).await;
    let version = &model["version"];
    let path = format!("{project}/cloud?voxel=0.1&version={version}&component=all");
    let first = server.get(&path).await;
    assert_eq!(first.status(), 200);
    assert_eq!(first.headers()["content-type"], "model/ply");
    let etag = first.headers()["etag"].clone();
    let bytes = first.bytes().await.unwrap();
    assert!(bytes.starts_with(b"ply\nformat binary_little_endian 1.0\n"));
    // A version that is published later changes nothing.
    server.registered(&project, "later.ply", room(0.7)).await;
    let again = server.get(&path).await;
    assert_eq!(again.headers()["etag"], etag);
    assert_eq!(again.bytes().await.unwrap(), bytes);
    let all = server.get(&format!("{project}/cloud?component=all&version={version}")).await;
    assert!(all.bytes().await.unwrap().len() > bytes.len(), "the filter leaves points out");
    problem(server.get(&format!("{project}/cloud?component=99")).await, 404, "not-found").await;
    problem(server.get(&format!("{project}/cloud?voxel=0")).await, 400, "invalid-field").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lost_file_is_a_failure_of_the_service_and_a_deleted_one_is_not_there() {
    let server = Server::start().await;
    let project = server.project().await;
    let (scan, _) = server.registered(&project, "a.ply", room(0.0)).await;
    let (other, _) = server.registered(&project, "b.ply", room(0.3)).await;
    let original = |scan: &Value| format!("{project}/scans/{}/original", scan["id"].as_str().unwrap());
    let etag = server.get(&original(&scan)).await.headers()["etag"].to_str().unwrap().to_owned();
    server.lose(etag.trim_matches('"'));
    problem(server.get(&original(&scan)).await, 500, "internal-error").await;
    assert_eq!(server.get(&original(&other)).await.status(), 200);

    server.lose(&server.word("SELECT content FROM versions WHERE number = 1").await);
    for path in ["versions/1", "poses?version=1", "graph?version=1"] {
        problem(server.get(&format!("{project}/{path}")).await, 500, "internal-error").await;
    }
    problem(server.get(&format!("{project}/versions/99")).await, 404, "not-found").await;
    let path = format!("{project}/scans/{}", other["id"].as_str().unwrap());
    assert_eq!(server.client.delete(server.url(&path)).send().await.unwrap().status(), 202);
    problem(server.get(&original(&other)).await, 404, "not-found").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn poses_come_in_every_form() {
    let server = Server::start().await;
    let project = server.project().await;
    for i in 0..3u8 {
        server.registered(&project, &format!("{i}.ply"), room(f64::from(i) * 0.3)).await;
    }
    let model = server.json(&format!("{project}/model")).await;
    let n = model["components"][0]["scans"].as_array().map_or(0, Vec::len);
    assert!(n > 1, "{model}");
    let text = |form: &str| {
        let path = format!("{project}/poses?format={form}");
        let server = &server;
        async move { server.get(&path).await.text().await.unwrap() }
    };
    let lines = |text: &str| text.lines().filter(|l| !l.starts_with('#')).count();
    assert_eq!(lines(&text("tum").await), n);
    assert_eq!(lines(&text("kitti").await), n);
    assert_eq!(lines(&text("3dmatch-log").await), 5 * n * (n - 1) / 2);
    let json = server.json(&format!("{project}/poses?format=json")).await;
    assert_eq!(json["version"], model["version"]);
    assert_eq!(json["scans"]["0.ply"]["component"], 0);
    assert_eq!(json["scans"]["0.ply"]["pose"][3][3], 1.0);
    server.stop().await;
}
