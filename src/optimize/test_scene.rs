//! Synthetic scenes with known poses for the tests of this layer.

use nalgebra::{Rotation3, Vector3, Vector6};
use rand::RngExt;

use super::{Observation, Track};
use crate::control::{CancelToken, Control, Seed, SeedRng, Silent};
use crate::geometry::Pose;
use crate::geometry::assert::assert_pose_near;

/// Runs a computation that nobody watches or cancels.
pub(super) fn with_control<T>(run: impl FnOnce(Control<'_>) -> T) -> T {
    let cancel = CancelToken::new();
    run(Control { cancel: &cancel, observer: &Silent })
}

/// Runs a computation on a pool of its own.
pub(super) fn with_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(run)
}

pub(super) fn rng(seed: u64) -> SeedRng {
    Seed(seed).derive("optimize tests", 0)
}

pub(super) fn vector(rng: &mut SeedRng, half_width: f64) -> Vector3<f64> {
    Vector3::from_fn(|_, _| rng.random_range(-half_width..half_width))
}

/// Scans anywhere in a room, turned by up to pi; the first at identity.
pub(super) fn poses(count: usize, rng: &mut SeedRng) -> Vec<Pose> {
    let mut pose = |k: usize| {
        let turn = vector(rng, 1.8);
        let shift = vector(rng, 3.0);
        if k == 0 { Pose::identity() } else { Pose::new(Rotation3::new(turn), shift) }
    };
    (0..count).map(&mut pose).collect()
}

/// Every pose but the first moved by up to so many radians and metres along each axis.
pub(super) fn disturbed(poses: &[Pose], rad: f64, metres: f64, rng: &mut SeedRng) -> Vec<Pose> {
    let mut one = |pose: &Pose| {
        let (w, v) = (vector(rng, rad), vector(rng, metres));
        pose.perturbed(&Vector6::new(w.x, w.y, w.z, v.x, v.y, v.z))
    };
    poses.iter().enumerate().map(|(k, pose)| if k == 0 { *pose } else { one(pose) }).collect()
}

/// Landmarks in the room, each seen without noise by `views` scans that follow one another.
pub(super) fn tracks(poses: &[Pose], count: usize, views: usize, rng: &mut SeedRng) -> Vec<Track> {
    let mut one = |j: usize| {
        let landmark = vector(rng, 4.0);
        let seen = (0..views).map(|k| (j + k) % poses.len());
        let observe = |scan: usize| Observation {
            scan,
            point_in_scan: poses[scan].inverse().transform(&landmark),
            weight: 1.0,
        };
        Track { observations: seen.map(observe).collect(), held_landmark: None }
    };
    (0..count).map(&mut one).collect()
}

#[track_caller]
pub(super) fn assert_poses_near(actual: &[Pose], expected: &[Pose], rad: f64, metres: f64) {
    assert_eq!(actual.len(), expected.len());
    for (a, b) in actual.iter().zip(expected) {
        assert_pose_near(a, b, rad, metres);
    }
}
