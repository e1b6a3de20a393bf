//! Assertions about poses for tests, failing in words a person can judge: degrees and millimetres.

use super::Pose;

/// Panics unless the two motions between the same frames are within `rad` radians and `metres` of each other.
///
/// The distance is that of the two translations, so it is measured where frame a's origin lands.
#[track_caller]
pub(crate) fn assert_pose_near(actual: &Pose, expected: &Pose, rad: f64, metres: f64) {
    let (angle, distance) = actual.difference(expected);
    // Written so that a value that is not a number fails too.
    let near = actual.is_finite() && angle <= rad && distance <= metres;
    assert!(
        near,
        "the poses differ by {:.3e} degrees and {:.3e} mm; at most {:.3e} degrees and {:.3e} mm are allowed",
        angle.to_degrees(),
        distance * 1e3,
        rad.to_degrees(),
        metres * 1e3,
    );
}

#[test]
#[should_panic(expected = "5.000e0 mm")]
fn a_pose_that_is_off_is_told_in_millimetres() {
    let moved = Pose::from_translation(nalgebra::Vector3::new(0.005, 0.0, 0.0));
    assert_pose_near(&moved, &Pose::identity(), 1e-3, 1e-3);
}
