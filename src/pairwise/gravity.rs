//! Gravity: scans whose upward directions are known can only be turned about them, which rules out most poses of rooms, where walls,
//! floors and ceilings are alike.

use nalgebra::Vector3;

use crate::features::Scan;
use crate::geometry::Pose;

/// The cosine of the angle by which two upward directions may differ: 6 degrees, twice what a single one may be off. Levelled
/// scanners are off by hundredths of a degree, inertial sensors in the hand by one or two.
const COS_TILT: f64 = 0.994_521_895_368_273_3;

/// Whether two upward directions, unit vectors in one frame, may be the same.
#[must_use]
pub fn is_level(up: &Vector3<f64>, other: &Vector3<f64>) -> bool {
    up.dot(other) >= COS_TILT
}

/// Whether a pose leaves both scans upright, as far as they say where up is.
#[must_use]
pub fn is_upright(a: &Scan, b: &Scan, a_from_b: &Pose) -> bool {
    match (a.prepared.up, b.prepared.up) {
        (Some(in_a), Some(in_b)) => {
            is_level(&Vector3::from(in_a), &(a_from_b.rotation * Vector3::from(in_b)))
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{PointCloud, ScanKey};
    use crate::control::{CancelToken, Control, Seed, Silent};
    use crate::features::{PrepareOptions, SensorPosition, Stance, prepare};
    use nalgebra::Rotation3;

    fn plate(up: Option<[f64; 3]>) -> Scan {
        let points = (0..2500_u16).map(|i| [f32::from(i % 50) * 0.02, f32::from(i / 50) * 0.02, 1.0]);
        let cloud = PointCloud::from_points(points.collect());
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let stance = Stance { position: SensorPosition::Assumed, up };
        let options = PrepareOptions::at(0.04, Seed(0));
        Scan::new(prepare(ScanKey(1), &cloud, stance, &options, control).expect("a plate"))
    }

    #[test]
    fn scans_may_be_turned_about_gravity_and_hardly_against_it() {
        // The one has its z axis upward, the other its y axis downward, and neither a unit vector.
        let (a, b) = (plate(Some([0.0, 0.0, 9.81])), plate(Some([0.0, -2.0, 0.0])));
        let level = Rotation3::from_axis_angle(&Vector3::x_axis(), -std::f64::consts::FRAC_PI_2);
        for (turn, tilt_deg, upright) in
            [(0.0, 0.0, true), (2.0, 5.0, true), (2.0, 7.0, false), (0.0, 180.0, false)]
        {
            let about = Rotation3::from_axis_angle(&Vector3::z_axis(), turn);
            let tilt = Rotation3::from_axis_angle(&Vector3::y_axis(), f64::to_radians(tilt_deg));
            let pose = Pose::new(tilt * about * level, Vector3::new(3.0, 4.0, 5.0));
            assert_eq!(is_upright(&a, &b, &pose), upright, "{turn} {tilt_deg}");
            assert_eq!(is_upright(&b, &a, &pose.inverse()), upright);
            assert!(is_upright(&plate(None), &b, &pose) && is_upright(&a, &plate(None), &pose));
        }
    }
}
