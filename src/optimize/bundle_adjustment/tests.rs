use nalgebra::{Matrix3, Rotation3};
use proptest::prelude::*;
use rand::RngExt;

use super::super::Observation;
use super::super::levenberg_marquardt::laws::assert_gradient;
use super::super::test_scene::{
    assert_poses_near, disturbed, poses, rng, tracks, vector, with_control, with_threads,
};
use super::*;

fn adjust(poses: &[Pose], tracks: &[Track], held: &[bool], kernel: Kernel) -> BundleAdjustment {
    let minimise = MinimiseOptions { relative_cost: 1e-14, ..MinimiseOptions::default() };
    with_control(|control| adjust_bundle(poses, tracks, held, &BundleOptions { kernel, minimise }, control))
        .unwrap()
}

fn fails(poses: &[Pose], tracks: &[Track], held: &[bool]) -> BundleError {
    with_control(|control| adjust_bundle(poses, tracks, held, &BundleOptions::default(), control))
        .unwrap_err()
}

fn first_held(scans: usize) -> Vec<bool> {
    (0..scans).map(|scan| scan == 0).collect()
}

/// Moves a share of all observations by 0.6 to 2 metres.
fn with_outliers(tracks: &mut [Track], share: f64, seed: u64) {
    let mut rng = rng(seed);
    for o in tracks.iter_mut().flat_map(|track| &mut track.observations) {
        if rng.random_bool(share) {
            o.point_in_scan += vector(&mut rng, 1.0).normalize() * rng.random_range(0.6..2.0);
        }
    }
}

#[test]
fn the_gradient_is_the_numerical_one() {
    let mut rng = rng(1);
    let truth = poses(4, &mut rng);
    let mut tracks = tracks(&truth, 30, 3, &mut rng);
    tracks[3].held_landmark = Some(vector(&mut rng, 3.0));
    // Two keypoints of one scan in a track.
    tracks[5].observations[1].scan = tracks[5].observations[0].scan;
    tracks[6].observations[0].weight = 3.0;
    let start = disturbed(&truth, 0.1, 0.2, &mut rng);
    let held = [false, true, false, false];
    for kernel in [Kernel::Squared, Kernel::Huber(0.2), Kernel::Cauchy(0.2), Kernel::GemanMcClure(0.4)] {
        let terms = LandmarkTerms { tracks: &tracks, kernel, factor: 0.7 };
        let problem = BundleProblem { terms, held: &held };
        let mut landmarks = terms.place(&start);
        for _ in 0..2000 {
            landmarks = terms.follow(&start, &start, &landmarks);
        }
        assert_gradient(&problem, &BundleState { poses: start.clone(), landmarks }, 4, 1e-7);
    }
}

#[test]
fn poses_are_recovered_exactly_from_a_start_that_is_far_off() {
    let mut rng = rng(2);
    let truth = poses(8, &mut rng);
    let tracks = tracks(&truth, 400, 3, &mut rng);
    let start = disturbed(&truth, 0.3, 0.8, &mut rng);
    let result = adjust(&start, &tracks, &first_held(8), Kernel::Squared);
    assert_poses_near(&result.poses, &truth, 1e-8, 1e-8);
    assert!(result.track_rms.iter().all(|rms| *rms < 1e-8));
    assert!(result.report.converged(), "{:?}", result.report);
}

#[test]
fn wrong_observations_do_not_move_the_poses_under_a_robust_kernel() {
    let mut rng = rng(3);
    let truth = poses(8, &mut rng);
    let mut tracks = tracks(&truth, 600, 4, &mut rng);
    with_outliers(&mut tracks, 0.1, 7);
    let start = disturbed(&truth, 0.02, 0.05, &mut rng);
    let robust = adjust(&start, &tracks, &first_held(8), Kernel::Tukey(0.3));
    assert_poses_near(&robust.poses, &truth, 1e-7, 1e-7);
    let plain = adjust(&start, &tracks, &first_held(8), Kernel::Squared);
    assert!(plain.poses[3].difference(&truth[3]).1 > 1e-2);
}

#[test]
fn moving_the_start_moves_the_result() {
    let mut rng = rng(4);
    let truth = poses(5, &mut rng);
    let mut tracks = tracks(&truth, 200, 3, &mut rng);
    with_outliers(&mut tracks, 0.05, 3);
    let start = disturbed(&truth, 0.05, 0.1, &mut rng);
    let gauge = Pose::new(Rotation3::new(vector(&mut rng, 1.5)), vector(&mut rng, 100.0));
    let elsewhere: Vec<Pose> = start.iter().map(|pose| gauge * *pose).collect();
    let kernel = Kernel::Cauchy(0.2);
    let here = adjust(&start, &tracks, &first_held(5), kernel).poses;
    let there = adjust(&elsewhere, &tracks, &first_held(5), kernel).poses;
    let back: Vec<Pose> = there.iter().map(|pose| gauge.inverse() * *pose).collect();
    assert_poses_near(&back, &here, 1e-6, 1e-6);
}

#[test]
fn held_scans_and_held_landmarks_do_not_move() {
    let mut rng = rng(5);
    let truth = poses(6, &mut rng);
    let mut tracks = tracks(&truth, 200, 3, &mut rng);
    let fixed = vector(&mut rng, 2.0);
    tracks[0].held_landmark = Some(fixed);
    let start = disturbed(&truth, 0.1, 0.2, &mut rng);
    let held = [false, true, false, true, true, false];
    let result = adjust(&start, &tracks, &held, Kernel::Cauchy(0.3));
    for scan in [1, 3, 4] {
        assert_eq!(result.poses[scan], start[scan]);
    }
    assert_ne!(result.poses[0], start[0]);
    assert_eq!(result.landmarks[0], fixed);
    assert_eq!(result.anchors, Vec::<usize>::new());
}

#[test]
fn a_scan_is_located_by_held_landmarks_alone() {
    let mut rng = rng(6);
    let truth = poses(2, &mut rng);
    let mut tracks = tracks(&truth, 20, 1, &mut rng);
    tracks.retain(|track| track.observations[0].scan == 1);
    for track in &mut tracks {
        track.held_landmark = Some(truth[1].transform(&track.observations[0].point_in_scan));
    }
    let start = disturbed(&truth, 0.3, 1.0, &mut rng);
    let result = adjust(&start, &tracks, &[false, false], Kernel::Squared);
    assert_poses_near(&result.poses, &truth, 1e-9, 1e-9);
    assert_eq!((result.anchors, result.unlinked), (vec![], vec![0]));
}

#[test]
fn groups_that_share_no_landmark_are_anchored_and_lone_scans_stay() {
    let mut rng = rng(7);
    let truth = poses(7, &mut rng);
    let mut all = tracks(&truth[..3], 100, 3, &mut rng);
    for mut track in tracks(&truth[3..6], 100, 2, &mut rng) {
        track.observations.iter_mut().for_each(|o| o.scan += 3);
        all.push(track);
    }
    let start = disturbed(&truth, 0.1, 0.1, &mut rng);
    let result = adjust(&start, &all, &first_held(7), Kernel::Squared);
    assert_eq!((result.anchors, result.unlinked), (vec![3], vec![6]));
    assert_eq!((result.poses[3], result.poses[6]), (start[3], start[6]));
    let relative = |poses: &[Pose]| poses[3].inverse() * poses[5];
    assert_poses_near(&[relative(&result.poses)], &[relative(&truth)], 1e-8, 1e-8);
}

#[test]
fn landmarks_on_one_line_leave_finite_poses_and_no_covariance() {
    let mut rng = rng(8);
    let truth = poses(3, &mut rng);
    let mut all = tracks(&truth, 30, 3, &mut rng);
    for (k, track) in all.iter_mut().enumerate() {
        let landmark = Vector3::new(1.0, 2.0, -0.5) * (k as f64 * 0.1);
        track.observations.iter_mut().for_each(|o| {
            o.point_in_scan = truth[o.scan].inverse().transform(&landmark);
        });
    }
    let result = adjust(&disturbed(&truth, 0.1, 0.1, &mut rng), &all, &first_held(3), Kernel::Squared);
    assert!(result.poses.iter().all(Pose::is_finite) && result.report.cost_after < 1e-12);
}

#[test]
fn the_covariance_of_a_pair_is_twice_that_of_one_keypoint_over_their_number() {
    let corners = (0..8).map(|k| Vector3::from_fn(|axis, _| if k >> axis & 1 == 0 { -1.0 } else { 1.0 }));
    let observe = |scan, p: Vector3<f64>| Observation { scan, point_in_scan: p, weight: 1.0 };
    let all: Vec<Track> = corners
        .map(|p| Track { observations: vec![observe(0, p), observe(1, p)], held_landmark: None })
        .collect();
    let result = adjust(&[Pose::identity(); 2], &all, &[true, false], Kernel::Squared);
    let covariance = result.covariances(&[1]).unwrap()[0];
    let translation: Matrix3<f64> = covariance.fixed_view::<3, 3>(3, 3).into();
    assert!((translation - Matrix3::identity() * (2.0 / 8.0)).amax() < 1e-12);
    assert_eq!(result.covariances(&[0]), Err(BlockSolverError::NotFree { variable: 0 }));
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let mut rng = rng(9);
    let truth = poses(10, &mut rng);
    let mut tracks = tracks(&truth, 3000, 3, &mut rng);
    with_outliers(&mut tracks, 0.1, 5);
    let start = disturbed(&truth, 0.05, 0.1, &mut rng);
    let run = |threads| {
        with_threads(threads, || {
            let result = adjust(&start, &tracks, &first_held(10), Kernel::Cauchy(0.1));
            (result.poses, result.landmarks, result.report)
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn malformed_input_is_refused_by_name() {
    let two = [Pose::identity(); 2];
    let track = |scan, weight| Track {
        observations: vec![Observation { scan, point_in_scan: Vector3::zeros(), weight }],
        held_landmark: None,
    };
    assert_eq!(fails(&two, &[], &[false; 2]), BundleError::NoTracks);
    assert_eq!(fails(&two, &[track(0, 1.0)], &[false; 3]), BundleError::HeldMismatch { flags: 3, poses: 2 });
    let unknown = TrackError::UnknownScan { track: 1, scan: 2, scans: 2 };
    assert_eq!(fails(&two, &[track(0, 1.0), track(2, 1.0)], &[false; 2]), unknown.into());
    assert_eq!(fails(&two, &[Track::default()], &[false; 2]), TrackError::Empty { track: 0 }.into());
    for weight in [-1.0, f64::NAN, f64::INFINITY] {
        assert_eq!(fails(&two, &[track(0, weight)], &[false; 2]), TrackError::NotFinite { track: 0 }.into());
    }
    let lost = Pose::from_translation(Vector3::new(f64::NAN, 0.0, 0.0));
    let error = fails(&[two[0], lost], &[track(0, 1.0)], &[false; 2]);
    assert_eq!(error, BundleError::PoseNotFinite { scan: 1 });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn the_true_cost_never_rises(seed in 0..1000u64, kind in 0..4, share in 0.0..0.5f64) {
        let kernel = [Kernel::Squared, Kernel::Huber(0.1), Kernel::Cauchy(0.1), Kernel::Tukey(0.3)][kind as usize];
        let mut rng = rng(seed);
        let truth = poses(5, &mut rng);
        let mut tracks = tracks(&truth, 60, 3, &mut rng);
        with_outliers(&mut tracks, share, seed);
        let start = disturbed(&truth, 0.5, 1.0, &mut rng);
        let result = adjust(&start, &tracks, &[false; 5], kernel);
        prop_assert!(result.report.cost_after <= result.report.cost_before);
        prop_assert!(result.poses.iter().all(Pose::is_finite));
    }
}
