//! A model that was read back from disk goes on exactly like one that stayed in memory.

use std::io::Cursor;

use cairn::cloud::PlyWriter;
use cairn::control::Seed;
use cairn::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};
use serde_json::{Value, json};

use crate::server::Server;

fn scans() -> Vec<Vec<u8>> {
    let options = SurveyOptions {
        building: BuildingOptions { rooms: 2, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(15_000),
        stations: 7,
        seed: Seed(3),
        ..SurveyOptions::default()
    };
    let survey = simulate(&options).unwrap();
    let file = |scan: &cairn::simulate::SimulatedScan| {
        let mut file = Cursor::new(Vec::new());
        let mut ply = PlyWriter::new(&mut file, false, &[]).unwrap();
        scan.cloud.points.iter().for_each(|p| ply.point(*p).unwrap());
        ply.finish().unwrap();
        file.into_inner()
    };
    survey.scans.iter().map(file).collect()
}

/// Registers the scans one after another, with a restart before those that `restarts` names, then adjusts. Returns poses
/// and standings without what differs between any two runs: the ids.
async fn run(scans: &[Vec<u8>], restarts: &[usize]) -> Value {
    let mut server = Server::start().await;
    let project = server.project().await;
    let mut ids = Vec::new();
    for (i, scan) in scans.iter().enumerate() {
        if restarts.contains(&i) {
            server = server.restart().await;
        }
        let (scan, job) = server.registered(&project, &format!("{i}.ply"), scan.clone()).await;
        assert_eq!(job["status"], "succeeded", "{job}");
        ids.push(scan["id"].as_str().unwrap().to_owned());
    }
    let url = server.url(&format!("{project}/jobs"));
    let body = json!({ "kind": "global-bundle-adjustment" });
    let job = server.client.post(url).json(&body).send().await.unwrap().json().await.unwrap();
    let outcome = server.ended(&job).await["outcome"].clone();
    let model = server.json(&format!("{project}/model")).await;
    server.stop().await;
    let mut text = json!({ "scans": model["scans"], "adjustment": outcome }).to_string();
    for (i, id) in ids.iter().enumerate() {
        text = text.replace(id, &format!("scan {i}"));
    }
    serde_json::from_str(&text).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restored_model_takes_the_next_scans_in_exactly_like_the_live_one() {
    let scans = scans();
    let (live, restored) = tokio::join!(run(&scans, &[]), run(&scans, &[3, 6]));
    let registered = |v: &Value| {
        v["scans"].as_array().unwrap().iter().filter(|s| s["outcome"]["status"] == "registered").count()
    };
    assert!(registered(&live) >= 5, "{live}");
    assert_eq!(live, restored);
}
