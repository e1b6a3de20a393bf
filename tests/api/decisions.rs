//! What the data cannot tell is listed, and clients decide it: joined, forbidden, kept, taken back.

use std::io::Cursor;

use cairn::cloud::PlyWriter;
use cairn::control::Seed;
use cairn::geometry::Pose;
use cairn::simulate::{BuildingOptions, Layout, SurveyOptions, simulate};
use nalgebra::{Rotation3, Vector3};
use reqwest::{Response, StatusCode};
use serde_json::{Value, json};

use crate::server::{Server, problem, room};

/// Scans of a corridor of rooms that are exact copies of one another.
fn twin_rooms() -> Vec<Vec<u8>> {
    let options = SurveyOptions {
        building: BuildingOptions {
            layout: Layout::TwinRooms,
            rooms: 4,
            density: 0.3,
            ..BuildingOptions::default()
        },
        stations: 8,
        seed: Seed(1),
        ..SurveyOptions::default()
    };
    let file = |scan: &cairn::simulate::SimulatedScan| {
        let mut file = Cursor::new(Vec::new());
        let mut ply = PlyWriter::new(&mut file, false, &[]).unwrap();
        scan.cloud.points.iter().for_each(|p| ply.point(*p).unwrap());
        ply.finish().unwrap();
        file.into_inner()
    };
    simulate(&options).unwrap().scans.iter().map(file).collect()
}

/// A pose that no evidence speaks for.
fn far_away() -> Pose {
    Pose::new(Rotation3::new(Vector3::new(0.0, 0.0, 1.0)), Vector3::new(100.0, -20.0, 3.0))
}

fn id(scan: &Value) -> &str {
    scan["id"].as_str().unwrap()
}

fn join(a: &Value, b: &Value, a_from_b: &Pose) -> Value {
    json!({ "verdict": "join", "scan_a": a["id"], "scan_b": b["id"], "a_from_b": a_from_b.to_rows() })
}

fn forbid(a: &Value, b: &Value) -> Value {
    json!({ "verdict": "forbid", "scan_a": a["id"], "scan_b": b["id"] })
}

async fn post(server: &Server, project: &str, body: &Value) -> Response {
    server.client.post(server.url(&format!("{project}/decisions"))).json(body).send().await.unwrap()
}

/// Decides, waits until the model obeys, and returns the decision.
async fn decided(server: &Server, project: &str, body: &Value) -> Value {
    let response = post(server, project, body).await;
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    let answer: Value = response.json().await.unwrap();
    let job = server.ended(&answer["job"]).await;
    assert_eq!((&job["kind"], &job["status"]), (&json!("decision"), &json!("succeeded")), "{job}");
    answer["decision"].clone()
}

async fn taken_back(server: &Server, project: &str, decision: &Value) {
    let url = server.url(&format!("{project}/decisions/{}", id(decision)));
    let response = server.client.delete(&url).send().await.unwrap();
    assert_eq!(response.status(), StatusCode::ACCEPTED);
    let job = server.ended(&response.json().await.unwrap()).await;
    assert_eq!(job["status"], "succeeded", "{job}");
    problem(server.client.delete(&url).send().await.unwrap(), 404, "not-found").await;
}

async fn rebuilt(server: &Server, project: &str) {
    let url = server.url(&format!("{project}/jobs"));
    let answer = server.client.post(url).json(&json!({ "kind": "rebuild" })).send().await.unwrap();
    assert_eq!(server.ended(&answer.json().await.unwrap()).await["status"], "succeeded");
}

/// Component and pose of a scan in the newest version, if it has them.
async fn place(server: &Server, project: &str, scan: &Value) -> Option<(u64, Pose)> {
    let outcome = server.json(&format!("{project}/scans/{}", id(scan))).await["outcome"].clone();
    let pose: [[f64; 4]; 4] = serde_json::from_value(outcome["model_from_scan"].clone()).ok()?;
    Some((outcome["component"].as_u64()?, Pose::from_rows(&pose).unwrap()))
}

/// `a_from_b` in the newest version, if the two are in one component.
async fn between(server: &Server, project: &str, a: &Value, b: &Value) -> Option<Pose> {
    let (component_a, model_from_a) = place(server, project, a).await?;
    let (component_b, model_from_b) = place(server, project, b).await?;
    (component_a == component_b).then(|| model_from_a.inverse() * model_from_b)
}

fn assert_near(found: Option<Pose>, wanted: &Pose, metres: f64) {
    let found = found.expect("the two should be in one component");
    let (angle, distance) = found.difference(wanted);
    assert!(angle < 0.17 && distance < metres, "{:.2} deg and {distance:.3} m away", angle.to_degrees());
}

#[tokio::test(flavor = "multi_thread")]
async fn alike_rooms_are_left_open_with_their_rivals_listed_and_a_client_decides() {
    let server = Server::start().await;
    let project = server.project().await;
    let mut uploads = Vec::new();
    for (i, bytes) in twin_rooms().into_iter().enumerate() {
        uploads.push(server.accepted(&project, &format!("{i}.ply"), bytes).await);
    }
    for upload in &uploads {
        assert_eq!(server.ended(&upload["job"]).await["status"], "succeeded");
    }
    let scans: Vec<&Value> = uploads.iter().map(|u| &u["scan"]).collect();
    // Which scans came together must not matter here.
    rebuilt(&server, &project).await;
    let model = server.json(&format!("{project}/model")).await;
    let graph = server.json(&format!("{project}/graph")).await;
    assert_eq!(model["open_joins"], graph["open_joins"]);
    let open = &model["open_joins"][0];
    let named = |end: &Value| {
        let index: usize = end["name"].as_str().unwrap().trim_end_matches(".ply").parse().unwrap();
        assert_eq!(end["id"], scans[index]["id"]);
        index
    };
    let (a, b) = (named(&open["scan_a"]), named(&open["scan_b"]));
    assert!(open["refusal"]["reason"].is_string() && open["scans_a"].as_u64() >= open["scans_b"].as_u64());
    assert_eq!(between(&server, &project, scans[a], scans[b]).await, None, "what is open is not joined");

    // A listed pose is chosen by its index, seen from either of the two.
    let listed: [[f64; 4]; 4] = serde_json::from_value(open["poses"][0]["a_from_b"].clone()).unwrap();
    let body = json!({ "verdict": "join", "scan_a": scans[b]["id"], "scan_b": scans[a]["id"], "pose": 0,
        "version": model["version"] });
    let decision = decided(&server, &project, &body).await;
    let listed = Pose::from_rows(&listed).unwrap();
    assert_near(between(&server, &project, scans[a], scans[b]).await, &listed, 1.0);

    // The opposite replaces it.
    decided(&server, &project, &forbid(scans[a], scans[b])).await;
    assert_eq!(between(&server, &project, scans[a], scans[b]).await, None);
    let list = server.json(&format!("{project}/decisions")).await;
    assert_eq!(list["items"].as_array().unwrap().len(), 1, "{list}");
    problem(server.get(&format!("{project}/decisions/{}", id(&decision))).await, 404, "not-found").await;
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_decision_holds_for_later_scans_rebuilds_restarts_and_new_engines_until_it_is_taken_back() {
    let server = Server::start().await;
    let project = server.project().await;
    let (a, _) = server.registered(&project, "a.ply", room(0.0)).await;
    let (b, _) = server.registered(&project, "b.ply", room(0.2)).await;
    let measured = between(&server, &project, &a, &b).await.expect("the two overlap");

    let ban = decided(&server, &project, &forbid(&b, &a)).await;
    assert_eq!(between(&server, &project, &a, &b).await, None);
    let model = server.json(&format!("{project}/model")).await;
    assert_eq!(model["decisions"], json!([ban["id"]]));
    for scan in model["scans"].as_array().unwrap() {
        assert_eq!(scan["outcome"], json!({ "status": "waiting", "reason": "forbidden" }));
    }

    let mut server = server.restart().await;
    assert_eq!(server.json(&format!("{project}/decisions/{}", id(&ban))).await, ban);
    let (c, _) = server.registered(&project, "c.ply", room(0.1)).await;
    assert_eq!(between(&server, &project, &a, &b).await, None, "not even by way of a third scan");
    for another_engine in [false, true] {
        if another_engine {
            server = server.restart_with_a_model_of_another_engine().await;
        }
        rebuilt(&server, &project).await;
        assert_eq!(between(&server, &project, &a, &b).await, None);
    }
    taken_back(&server, &project, &ban).await;
    assert_near(between(&server, &project, &a, &b).await, &measured, 0.1);

    // A join goes with its scan.
    decided(&server, &project, &join(&a, &c, &far_away())).await;
    assert_near(between(&server, &project, &a, &c).await, &far_away(), 0.5);
    let response =
        server.client.delete(server.url(&format!("{project}/scans/{}", id(&c)))).send().await.unwrap();
    server.ended(&response.json().await.unwrap()).await;
    assert_eq!(server.json(&format!("{project}/decisions")).await["items"], json!([]));
    assert_eq!(server.json(&format!("{project}/model")).await["decisions"], json!([]));
    server.stop().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_decision_that_makes_no_sense_is_refused_with_the_name_of_its_field() {
    let server = Server::start().await;
    let (project, other) = (server.project().await, server.project().await);
    let (a, _) = server.registered(&project, "a.ply", room(0.0)).await;
    let (b, _) = server.registered(&project, "b.ply", room(0.2)).await;
    let (elsewhere, _) = server.registered(&other, "a.ply", room(0.0)).await;
    let good = join(&a, &b, &far_away());
    let with = |field: &str, value: Value| {
        let mut body = good.clone();
        body[field] = value;
        body
    };
    let entry = |row: usize, column: usize, value: f64| {
        let mut body = good.clone();
        body["a_from_b"][row][column] = json!(value);
        body
    };
    for (body, field) in [
        (with("verdict", json!("perhaps")), "verdict"),
        (with("scan_a", json!("nonsense")), "scan_a"),
        (with("scan_a", json!("01ARZ3NDEKTSV4RRFFQ69G5FAV")), "scan_a"),
        (with("scan_b", elsewhere["id"].clone()), "scan_b"),
        (with("scan_b", a["id"].clone()), "scan_b"),
        (with("a_from_b", Value::Null), "a_from_b"),
        (with("a_from_b", json!([1, 2, 3])), "a_from_b"),
        (entry(0, 0, 1e300), "a_from_b"),
        (entry(0, 3, 1e300), "a_from_b"),
        (entry(2, 2, -1.0), "a_from_b"),
        (entry(3, 3, 2.0), "a_from_b"),
        (with("pose", json!(0)), "pose"),
        (with("version", json!(1)), "version"),
        (with("a_from_c", json!(1)), "body"),
        (json!([]), "body"),
    ] {
        let found = problem(post(&server, &project, &body).await, 400, "invalid-field").await;
        assert_eq!(found["field"], field, "{found}");
    }
    let mut by_index = forbid(&a, &b);
    by_index["pose"] = json!(7);
    let found = problem(post(&server, &project, &by_index).await, 400, "invalid-field").await;
    assert_eq!(found["field"], "pose", "{found}");
    by_index["version"] = json!(99);
    let found = problem(post(&server, &project, &by_index).await, 400, "invalid-field").await;
    assert_eq!(found["field"], "version", "{found}");
    // JSON has no number that is not finite; a text that spells one is no JSON.
    let text = good.to_string().replace("100.0", "1e999");
    let sent = server.client.post(server.url(&format!("{project}/decisions"))).body(text);
    let sent = sent.header("content-type", "application/json").send().await.unwrap();
    let found = problem(sent, 400, "invalid-field").await;
    assert!(found["detail"].as_str().unwrap().contains("a_from_b"), "{found}");
    let nowhere = "/v1/projects/01ARZ3NDEKTSV4RRFFQ69G5FAV";
    problem(post(&server, nowhere, &good).await, 404, "not-found").await;
    assert_eq!(server.json(&format!("{project}/decisions")).await["items"], json!([]));
    server.stop().await;
}
