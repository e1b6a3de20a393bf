//! Two poses of a pair that both look right: a second look at half the voxel, where what tells them apart can be seen. The ends of a
//! near-symmetric hall differ by a bench and a plant; seen coarsely that is little, seen finely a wrong pose puts them into free space.

use super::dense::{Counts, look};
use super::icp::icp;
use crate::features::Scan;
use crate::geometry::Pose;

/// Counts that stand for chance: some violations, and some judged points.
const CHANCE: (f64, f64) = (3.0, 300.0);
/// Surfaces that lie this near, in voxels of the second look, lie on each other: packing and sampling do as much.
const NO_DISTANCE: f64 = 0.05;
/// Where fewer points lie on the other's surface, nothing can be said of how well they fit.
const LEAST_CONTACTS: u32 = 100;
/// Where a smaller share of them does, the scans are apart, and their fit speaks for nothing.
const LEAST_OVERLAP: f64 = 0.1;
/// What a contrast of two poses is worth as log-odds: of violations, of distances. Fitted to right and wrong poses of the same pairs in halls, houses,
/// offices and indoor depth-camera scenes.
const WORTH: (f64, f64) = (1.5, 2.8);
/// Log-odds from which it decides. It then finds two thirds and more of the wrong poses that look right in halls, and hardly ever takes the right
/// one for wrong, except in rows of identical rooms, where one pair in four says either.
const DECISIVE: f64 = 1.0;

/// What two scans say of a pose (b to a, local frames) at half the voxel, both directions together, once it is aligned as finely. `None`
/// where either scan has no finer surfaces ([`Scan::fine`]).
#[must_use]
pub fn look_finely(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Counts> {
    let (a, b) = (a.fine()?, b.fine()?);
    let aligned = icp(&a, &b, a_from_b);
    Some(look(&a, &b, &aligned, 1).plus(&look(&b, &a, &aligned.inverse(), 1)))
}

/// Whether the second counts are clearly worse, both taken with voxels of this size (metres): they say so by the shares of judged points
/// that lie in free space, and by the root mean square distances of surfaces that meet. Never where too little meets to tell, or so little
/// at the first pose that it is no overlap.
#[must_use]
pub fn is_clearly_worse(pose: &Counts, other: &Counts, voxel: f64) -> bool {
    let few = pose.inliers.min(other.inliers) < LEAST_CONTACTS;
    if few || pose.overlap() < LEAST_OVERLAP {
        return false;
    }
    // Logarithms of ratios, 0 where both are alike.
    let violation = log_violation(other) - log_violation(pose);
    let apart = log_distance(other, voxel) - log_distance(pose, voxel);
    WORTH.0 * violation + WORTH.1 * apart > DECISIVE
}

fn log_violation(counts: &Counts) -> f64 {
    let judged = f64::from(counts.violations) + f64::from(counts.inliers);
    ((f64::from(counts.violations) + CHANCE.0) / (judged + CHANCE.1)).ln()
}

fn log_distance(counts: &Counts, voxel: f64) -> f64 {
    let square = f64::from(counts.plane_square) / f64::from(counts.inliers.max(1));
    (square + (NO_DISTANCE * voxel).powi(2)).sqrt().ln()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::control::Seed;
    use crate::features::{PreparedScan, choose_resolution, natural_resolution};
    use crate::pairwise::test_survey::prepared;
    use crate::simulate::{BuildingOptions, Layout, Sensor, SurveyOptions, simulate};

    #[test]
    fn a_pose_at_which_little_meets_is_never_the_better_one() {
        let counts = |inliers: u32, violations: u32, apart: f32| Counts {
            points: 30_000,
            inliers,
            violations,
            plane_square: inliers as f32 * apart * apart,
            ..Counts::default()
        };
        let (good, bad) = (counts(20_000, 30, 0.02), counts(19_000, 200, 0.03));
        assert!(is_clearly_worse(&good, &bad, 0.1) && !is_clearly_worse(&bad, &good, 0.1));
        for few in [counts(0, 0, 0.0), counts(40, 0, 0.01), counts(2_500, 0, 0.01)] {
            assert!(!is_clearly_worse(&few, &bad, 0.1), "{few:?}");
        }
        // Nor is one the worse one, whatever it puts into free space.
        for few in [counts(0, 5_000, 0.0), counts(40, 5_000, 0.03)] {
            assert!(!is_clearly_worse(&good, &few, 0.1), "{few:?}");
        }
        assert!(is_clearly_worse(&good, &counts(400, 5_000, 0.03), 0.1));
        assert!(!is_clearly_worse(&Counts::default(), &Counts::default(), 0.1));
    }

    #[test]
    fn noise_far_below_the_voxel_decides_nothing() {
        let exact = |apart: f32| Counts {
            points: 1000,
            inliers: 1000,
            plane_square: 1000.0 * apart * apart,
            ..Counts::default()
        };
        assert!(!is_clearly_worse(&exact(0.0), &exact(1e-4), 0.1));
        assert!(!is_clearly_worse(&exact(1e-7), &exact(1e-4), 0.1));
    }

    #[test]
    fn a_hall_that_is_turned_by_half_is_told_from_the_right_one() {
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
        let resolution = choose_resolution(&natural);
        let scans = prepared(&survey, resolution);
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
                let voxel = resolution / 2.0;
                assert!(!is_clearly_worse(&turned, &right, voxel), "{right:?} {turned:?}");
                decided += usize::from(is_clearly_worse(&right, &turned, voxel));
            }
        }
        assert!(decided >= 4, "{decided} of 6 pairs tell the ends of the hall apart");
        let (first, second) = (&scans[0].0, &scans[1].0);
        let bare = Scan::new(PreparedScan { fine: None, ..second.prepared.clone() });
        assert_eq!(look_finely(first, &bare, &Pose::identity()), None);
    }
}
