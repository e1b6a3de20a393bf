//! Scans of simulated surveys with known poses for the tests of this layer.

use crate::cloud::ScanKey;
use crate::control::{CancelToken, Control, Seed, Silent};
use crate::features::{PrepareOptions, Scan, SensorPosition, prepare};
use crate::geometry::Pose;
use crate::simulate::Survey;

/// The scans of a survey, prepared at a resolution in metres, with keys from 1 on; each with its true pose, `model_from_local`.
pub(super) fn prepared(survey: &Survey, resolution: f64) -> Vec<(Scan, Pose)> {
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
