//! Inputs on disk, a folder a parser. Snapshots are made afresh, so that they are always of today's form.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use cairn::cloud::ScanKey;
use cairn::control::{CancelToken, Control, Seed, Silent};
use cairn::features::{PrepareOptions, PreparedScan, SensorPosition, prepare};
use cairn::mapping::{LiveModel, MappingOptions};
use cairn::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};

fn folder(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz/corpus").join(name)
}

/// The inputs of a parser, in the order of their names, and then what is made for it.
pub fn inputs(name: &str) -> Vec<Vec<u8>> {
    let mut paths: Vec<PathBuf> =
        fs::read_dir(folder(name)).into_iter().flatten().map(|entry| entry.unwrap().path()).collect();
    paths.sort();
    let mut inputs: Vec<Vec<u8>> = paths.iter().map(|path| fs::read(path).unwrap()).collect();
    match name {
        "snapshot" => inputs.push(model(&scans())),
        "prepared" => inputs.extend(scans().iter().map(|scan| scan.to_bytes().unwrap())),
        _ => {}
    }
    assert!(!inputs.is_empty(), "there is no corpus for {name}");
    inputs
}

/// Adds an input that led to an answer that none had led to.
pub fn keep(name: &str, input: &[u8]) {
    let hash = blake3::hash(input).to_hex();
    fs::create_dir_all(folder(name)).unwrap();
    fs::write(folder(name).join(&hash.as_str()[..16]), input).unwrap();
}

/// Three small scans of a room.
fn scans() -> Vec<Arc<PreparedScan>> {
    let options = SurveyOptions {
        building: BuildingOptions { rooms: 1, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(12_000),
        stations: 3,
        seed: Seed(1),
        ..SurveyOptions::default()
    };
    let token = CancelToken::new();
    let prepared = |scan: &cairn::simulate::SimulatedScan| {
        let key = ScanKey::of_hash(&blake3::hash(scan.name.as_bytes()), &[]);
        let (settings, control) =
            (PrepareOptions::at(0.15, Seed(0)), Control { cancel: &token, observer: &Silent });
        Arc::new(prepare(key, &scan.cloud, SensorPosition::Assumed, &settings, control).unwrap())
    };
    simulate(&options).unwrap().scans.iter().map(prepared).collect()
}

fn model(scans: &[Arc<PreparedScan>]) -> Vec<u8> {
    let mut model = LiveModel::new(MappingOptions::default());
    let token = CancelToken::new();
    model.register(scans.to_vec(), Control { cancel: &token, observer: &Silent }).unwrap();
    let snapshot = model.snapshot();
    assert!(!snapshot.components.is_empty(), "a model without a component is no test");
    snapshot.to_bytes().unwrap()
}
