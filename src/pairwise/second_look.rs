//! Two poses of a pair that both look right: a second look at half the voxel, where what tells them apart can be seen. The ends of a
//! near-symmetric hall differ by a bench and a plant; seen coarsely that is little, seen finely a wrong pose puts them into free space.

use super::dense::{Counts, look};
use super::icp::icp;
use crate::features::Scan;
use crate::geometry::Pose;

/// Counts that stand for chance: some violations, and some judged points.
const CHANCE: (f64, f64) = (3.0, 300.0);
/// What a contrast is worth as log-odds: violations, distances. Fitted to right and wrong poses of the same pairs in halls, houses,
/// offices and indoor depth-camera scenes.
const WORTH: (f64, f64) = (1.5, 2.8);
/// Log-odds from which it decides. It then finds two thirds and more of the wrong poses that look right in halls, and hardly ever takes the right
/// one for wrong.
const DECISIVE: f64 = 1.0;

/// How much worse one pose is than another at half the voxel: logarithms of ratios, 0 where both are alike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contrast {
    /// Of the shares of judged points that lie in free space.
    pub violation: f64,
    /// Of the root mean square distances of surfaces that meet.
    pub apart: f64,
}

impl Contrast {
    /// How much worse the second counts are.
    #[must_use]
    pub fn between(pose: &Counts, other: &Counts) -> Self {
        Self {
            violation: log_violation(other) - log_violation(pose),
            apart: log_distance(other) - log_distance(pose),
        }
    }

    /// Whether the other pose is clearly worse.
    #[must_use]
    pub fn is_decisive(&self) -> bool {
        WORTH.0 * self.violation + WORTH.1 * self.apart > DECISIVE
    }
}

/// What two scans say of a pose (b to a, local frames) at half the voxel, both directions together, once it is aligned as finely. `None`
/// where either scan is no finer than its voxels, or has no range image.
#[must_use]
pub fn look_finely(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Counts> {
    let (a, b) = (a.fine()?, b.fine()?);
    let aligned = icp(&a, &b, a_from_b);
    Some(look(&a, &b, &aligned, 1).plus(&look(&b, &a, &aligned.inverse(), 1)))
}

fn log_violation(counts: &Counts) -> f64 {
    let judged = f64::from(counts.violations) + f64::from(counts.inliers);
    ((f64::from(counts.violations) + CHANCE.0) / (judged + CHANCE.1)).ln()
}

fn log_distance(counts: &Counts) -> f64 {
    let square = f64::from(counts.plane_square) / f64::from(counts.inliers.max(1));
    square.max(f64::MIN_POSITIVE).sqrt().ln()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::cloud::ScanKey;
    use crate::control::{CancelToken, Control, Seed, Silent};
    use crate::features::{PrepareOptions, SensorPosition, choose_resolution, natural_resolution, prepare};
    use crate::simulate::{BuildingOptions, Layout, Sensor, SurveyOptions, simulate};

    #[test]
    fn a_hall_that_is_turned_by_half_is_told_from_the_right_one() {
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let survey = simulate(&SurveyOptions {
            building: BuildingOptions { layout: Layout::Hall, ..BuildingOptions::default() },
            sensor: Sensor::panoramic(36_000),
            stations: 4,
            seed: Seed(3),
            ..SurveyOptions::default()
        })
        .expect("the options are valid");
        let natural: Vec<f64> =
            survey.scans.iter().map(|scan| natural_resolution(&scan.cloud.points)).collect();
        let options = PrepareOptions::at(choose_resolution(&natural), Seed(0));
        let scans: Vec<(Scan, Pose)> = (1..)
            .zip(&survey.scans)
            .map(|(key, scan)| {
                let prepared =
                    prepare(ScanKey(key), &scan.cloud, SensorPosition::default(), &options, control)
                        .expect("the scan is large enough");
                let model_from_local = scan.model_from_scan * prepared.local_from_scan().inverse();
                (Scan::new(prepared), model_from_local)
            })
            .collect();
        // The hall is as long one way as the other from its middle, where the building has its own.
        let middle = survey.scans.iter().fold(Vector3::zeros(), |sum, scan| {
            let points = &scan.cloud.points;
            let edge = |k: usize, least: bool| {
                let along =
                    points.iter().map(|p| scan.model_from_scan.transform(&Vector3::from(*p).cast())[k]);
                if least {
                    along.fold(f64::INFINITY, f64::min)
                } else {
                    along.fold(f64::NEG_INFINITY, f64::max)
                }
            };
            sum + Vector3::new(edge(0, true) + edge(0, false), edge(1, true) + edge(1, false), 0.0)
        }) / (2.0 * survey.scans.len() as f64);
        let half = Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
        let turned = Pose::new(half, middle - half * middle);
        let mut decided = 0;
        for (i, (b, model_from_b)) in scans.iter().enumerate() {
            for (a, model_from_a) in &scans[..i] {
                let truth = model_from_a.inverse() * *model_from_b;
                let wrong = model_from_a.inverse() * turned * *model_from_b;
                let seen = |pose| look_finely(a, b, pose).expect("the scans are fine enough");
                let (right, turned) = (seen(&truth), seen(&wrong));
                assert!(!Contrast::between(&turned, &right).is_decisive(), "{right:?} {turned:?}");
                decided += usize::from(Contrast::between(&right, &turned).is_decisive());
            }
        }
        assert!(decided >= 4, "{decided} of 6 pairs tell the ends of the hall apart");
        let (first, second) = (&scans[0].0, &scans[1].0);
        let bare = Scan::new(crate::features::PreparedScan { fine: None, ..second.prepared.clone() });
        assert_eq!(look_finely(first, &bare, &Pose::identity()), None);
    }
}
