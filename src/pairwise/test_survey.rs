//! Scans of simulated surveys with known poses for the tests of this layer and those above.

use nalgebra::{Rotation3, Vector3};

use crate::cloud::ScanKey;
use crate::control::{CancelToken, Control, Seed, Silent};
use crate::features::{
    PrepareOptions, PreparedScan, Scan, SensorPosition, choose_resolution, natural_resolution, prepare,
};
use crate::geometry::Pose;
use crate::simulate::{BuildingOptions, Layout, Sensor, Survey, SurveyOptions, simulate};

/// The scans of a survey, prepared at a resolution in metres, with keys from 1 on; each with its true pose, `model_from_local`.
pub(crate) fn prepared(survey: &Survey, resolution: f64) -> Vec<(Scan, Pose)> {
    let token = CancelToken::new();
    let control = Control { cancel: &token, observer: &Silent };
    let options = PrepareOptions::at(resolution, Seed(0));
    (1..)
        .zip(&survey.scans)
        .map(|(key, scan)| {
            let prepared = prepare(ScanKey(key), &scan.cloud, SensorPosition::default(), &options, control)
                .expect("the scan is large enough");
            let model_from_local = scan.model_from_scan * prepared.local_from_scan().inverse();
            (Scan::new(prepared), model_from_local)
        })
        .collect()
}

/// The corner of a room with edges of 4 m along the axes, a point every 5 cm, and the box of this edge in it, metres, if there is one.
pub(crate) fn corner(key: ScanKey, edge: Option<f32>) -> Scan {
    let mut prepared = PreparedScan { resolution: 0.05, ..PreparedScan::empty(key) };
    let mut square = |k: usize, size: f32, offset: f32| {
        let steps = (size / 0.05) as usize;
        for at in 0..steps * steps {
            let mut point = [offset; 3];
            point[(k + 1) % 3] = 0.025 + (at / steps) as f32 * 0.05;
            point[(k + 2) % 3] = 0.025 + (at % steps) as f32 * 0.05;
            let mut normal = [0.0; 3];
            normal[k] = 1.0;
            prepared.points.push(point);
            prepared.normals.push(normal);
        }
    };
    for k in 0..3 {
        square(k, 4.0, 0.0);
        if let Some(edge) = edge {
            square(k, edge, edge);
        }
    }
    Scan::new(prepared)
}

/// Scans of a near-symmetric hall.
pub(crate) struct Hall {
    /// Each with its true pose, `model_from_local`; keys from 1 on.
    pub scans: Vec<(Scan, Pose)>,
    /// Voxel size, metres.
    pub resolution: f64,
    /// From where a scan is to where it nearly fits as well: half a turn about the middle of the hall.
    pub turned: Pose,
}

/// A hall with so many panoramic scans.
pub(crate) fn hall(stations: usize) -> Hall {
    let survey = simulate(&SurveyOptions {
        building: BuildingOptions { layout: Layout::Hall, ..BuildingOptions::default() },
        sensor: Sensor::panoramic(36_000),
        stations,
        seed: Seed(3),
        ..SurveyOptions::default()
    })
    .expect("the options are valid");
    let natural: Vec<f64> = survey.scans.iter().map(|scan| natural_resolution(&scan.cloud.points)).collect();
    let resolution = choose_resolution(&natural);
    // The hall is as long one way as the other from its middle, where the building has its own.
    let middle = survey.scans.iter().fold(Vector3::zeros(), |sum, scan| {
        let points = &scan.cloud.points;
        let edge = |k: usize, least: bool| {
            let along = points.iter().map(|p| scan.model_from_scan.transform(&Vector3::from(*p).cast())[k]);
            if least { along.fold(f64::INFINITY, f64::min) } else { along.fold(f64::NEG_INFINITY, f64::max) }
        };
        sum + Vector3::new(edge(0, true) + edge(0, false), edge(1, true) + edge(1, false), 0.0)
    }) / (2.0 * survey.scans.len() as f64);
    let half = Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
    let turned = Pose::new(half, middle - half * middle);
    Hall { scans: prepared(&survey, resolution), resolution, turned }
}
