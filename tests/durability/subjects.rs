//! Scans of a simulated office, for tests that need jobs that take a while and models that can be judged.

use std::io::Cursor;

use cairn::cloud::PlyWriter;
use cairn::control::Seed;
use cairn::geometry::Pose;
use cairn::simulate::{BuildingOptions, Sensor, SimulatedScan, SurveyOptions, simulate};

/// A file to upload, and where its scan truly is.
pub struct Subject {
    pub name: String,
    pub file: Vec<u8>,
    pub truth: Pose,
}

/// Panoramic scans from so many places in an office of so many rooms.
pub fn subjects(rooms: usize, stations: usize) -> Vec<Subject> {
    let options = SurveyOptions {
        building: BuildingOptions { rooms, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(30_000),
        stations,
        seed: Seed(5),
        ..SurveyOptions::default()
    };
    simulate(&options).unwrap().scans.iter().map(subject).collect()
}

fn subject(scan: &SimulatedScan) -> Subject {
    let mut file = Cursor::new(Vec::new());
    let mut ply = PlyWriter::new(&mut file, false, &[]).unwrap();
    scan.cloud.points.iter().for_each(|p| ply.point(*p).unwrap());
    ply.finish().unwrap();
    Subject { name: format!("{}.ply", scan.name), file: file.into_inner(), truth: scan.model_from_scan }
}
