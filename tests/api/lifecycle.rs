//! From a project to its poses and back to nothing.

use reqwest::StatusCode;
use serde_json::{Value, json};

use crate::server::{Server, problem, room};

#[tokio::test(flavor = "multi_thread")]
async fn scans_are_uploaded_and_become_a_model_with_poses_and_a_cloud() {
    let server = Server::start().await;
    let project = server.project().await;
    assert_eq!(server.json(&format!("{project}/model")).await["version"], 0);
    let mut ids = Vec::new();
    for i in 0..3u8 {
        let name = format!("scan%20{i}.ply");
        let (scan, job) = server.registered(&project, &name, room(f64::from(i) * 0.2)).await;
        assert_eq!(job["status"], "succeeded", "{job}");
        assert_eq!(job["progress"], 100);
        assert!(matches!(job["outcome"]["status"].as_str(), Some("registered" | "waiting")), "{job}");
        ids.push(scan["id"].clone());
    }
    let model = server.json(&format!("{project}/model")).await;
    let known: Vec<Value> = model["scans"].as_array().unwrap().iter().map(|s| s["scan"].clone()).collect();
    assert_eq!(known, ids, "scans are listed in order of arrival");
    let version = model["version"].as_u64().unwrap();
    assert!(version >= 1);
    assert_eq!(server.json(&format!("{project}/versions/{version}")).await, model);
    let poses = server.json(&format!("{project}/poses")).await;
    assert_eq!(poses["scans"].as_object().unwrap().len(), 3);
    let list = server.json(&format!("{project}/scans?limit=2")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 2);
    let next = list["next"].as_str().unwrap();
    let rest = server.json(&format!("{project}/scans?limit=2&cursor={next}")).await;
    assert_eq!(rest["items"][0]["id"], ids[2]);
    assert_eq!(rest["items"][0]["points"], 40 * 40 * 15);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restart_keeps_scans_jobs_and_the_model() {
    let server = Server::start().await;
    let project = server.project().await;
    let (scan, job) = server.registered(&project, "a.ply", room(0.0)).await;
    let model = server.json(&format!("{project}/model")).await;
    let server = server.restart().await;
    assert_eq!(server.json(&format!("{project}/model")).await, model);
    assert_eq!(server.json(&format!("/v1/jobs/{}", job["id"].as_str().unwrap())).await, job);
    let path = format!("{project}/scans/{}", scan["id"].as_str().unwrap());
    let bytes = server.get(&format!("{path}/original")).await.bytes().await.unwrap();
    assert_eq!(bytes, room(0.0));
    // The model is extended from its snapshot now, not from memory.
    let (_, job) = server.registered(&project, "b.ply", room(0.3)).await;
    assert_eq!(job["status"], "succeeded", "{job}");
    assert_eq!(server.json(&format!("{project}/model")).await["scans"].as_array().unwrap().len(), 2);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deleted_scan_is_gone_at_once_and_then_from_the_model() {
    let server = Server::start().await;
    let project = server.project().await;
    let (first, _) = server.registered(&project, "a.ply", room(0.0)).await;
    let (second, _) = server.registered(&project, "b.ply", room(0.3)).await;
    let path = format!("{project}/scans/{}", first["id"].as_str().unwrap());
    let response = server.client.delete(server.url(&path)).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    problem(server.get(&path).await, 404, "not-found").await;
    let job = server.ended(&response.json().await.unwrap()).await;
    assert_eq!(job["outcome"]["status"], "removed", "{job}");
    let model = server.json(&format!("{project}/model")).await;
    assert_eq!(model["scans"].as_array().unwrap().len(), 1);
    assert_eq!(model["scans"][0]["scan"], second["id"]);
    // The same content may come again, as a new scan.
    let (again, job) = server.registered(&project, "a.ply", room(0.0)).await;
    assert_eq!(job["status"], "succeeded", "{job}");
    assert_ne!(again["id"], first["id"]);
    assert_eq!(server.json(&format!("{project}/model")).await["scans"].as_array().unwrap().len(), 2);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deleted_project_takes_its_jobs_with_it_and_leaves_others_alone() {
    let server = Server::start().await;
    let (project, other) = (server.project().await, server.project().await);
    let answer = server.accepted(&project, "a.ply", room(0.0)).await;
    let response = server.client.delete(server.url(&project)).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::NO_CONTENT);
    problem(server.get(&project).await, 404, "not-found").await;
    let job = format!("/v1/jobs/{}", answer["job"]["id"].as_str().unwrap());
    problem(server.get(&job).await, 404, "not-found").await;
    let (_, job) = server.registered(&other, "a.ply", room(0.0)).await;
    assert_eq!(job["status"], "succeeded", "{job}");
    assert_eq!(server.json("/v1/projects").await["items"].as_array().unwrap().len(), 1);
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_requests_are_told_what_is_wrong() {
    let server = Server::start().await;
    let post = |body: Value| server.client.post(server.url("/v1/projects")).json(&body).send();
    for (body, field) in [
        (json!({ "name": "" }), "name"),
        (json!({ "name": "a\u{0}b" }), "name"),
        (json!({ "name": "a", "resolution": -1.0 }), "resolution"),
        (json!({ "name": "a", "seed": 1_u64 << 60 }), "seed"),
        (json!({ "name": "a", "nmae": "b" }), "body"),
        (json!([]), "body"),
    ] {
        let found = problem(post(body).await.unwrap(), 400, "invalid-field").await;
        assert_eq!(found["field"], field, "{found}");
    }
    problem(server.get("/v1/projects?limit=0").await, 400, "invalid-field").await;
    problem(server.get("/v1/projects/nonsense").await, 404, "not-found").await;
    problem(server.get("/v1/nothing").await, 404, "not-found").await;
    let patch = server.client.patch(server.url("/v1/projects")).send().await.unwrap();
    problem(patch, 405, "method-not-allowed").await;
    let project = server.project().await;
    problem(server.get(&format!("{project}/versions/7")).await, 404, "not-found").await;
    problem(server.get(&format!("{project}/poses?format=bvh")).await, 400, "invalid-field").await;
    problem(server.get(&format!("{project}/cloud")).await, 404, "not-found").await;
    server.stop().await;
}
