use nalgebra::Rotation3;
use rand::RngExt;

use super::super::Track;
use super::super::levenberg_marquardt::laws::assert_gradient;
use super::super::test_scene::{
    assert_poses_near, disturbed, poses, rng, tracks, vector, with_control, with_threads,
};
use super::*;
use crate::control::CancelToken;
use crate::geometry::Point;

/// Rectangles on which scans have points: a corner, its normals along two axes, their half widths.
#[derive(Clone, Copy)]
struct Patch {
    centre: Vector3<f64>,
    u: Vector3<f64>,
    v: Vector3<f64>,
}

impl Patch {
    fn normal(&self) -> Vector3<f64> {
        self.u.cross(&self.v).normalize()
    }
}

/// A room with tilted furniture, so that no motion is free.
fn room() -> Vec<Patch> {
    let patch = |centre: [f64; 3], u: [f64; 3], v: [f64; 3]| Patch {
        centre: centre.into(),
        u: u.into(),
        v: v.into(),
    };
    vec![
        patch([0.0, 0.0, -1.2], [3.0, 0.0, 0.0], [0.0, 2.5, 0.0]),
        patch([3.0, 0.0, 0.0], [0.0, 2.5, 0.0], [0.0, 0.0, 1.2]),
        patch([0.0, 2.5, 0.0], [0.0, 0.0, 1.2], [3.0, 0.0, 0.0]),
        patch([1.0, -1.0, -0.8], [0.6, 0.0, 0.2], [0.0, 0.5, 0.1]),
        patch([-1.5, 1.0, -0.4], [0.0, 0.6, 0.3], [0.4, 0.0, 0.4]),
    ]
}

/// A point, its patch and the error of the normal found for it.
type Sample = (Vector3<f64>, usize, Vector3<f64>);

/// Points that each scan samples for itself on the patches; partners are sought by projection onto the patch.
struct Samples {
    pairs: Vec<(usize, usize)>,
    truth: Vec<Pose>,
    /// In the frame of their scan.
    points: Vec<Vec<Sample>>,
    patches: Vec<Patch>,
}

impl Samples {
    /// With up to `noise` metres along each axis in points and ten times as many radians in normals.
    fn new(truth: &[Pose], patches: &[Patch], per_scan: usize, noise: f64, seed: u64) -> Self {
        let mut rng = rng(seed);
        let mut point = |model_from_scan: &Pose| {
            let k = rng.random_range(0..patches.len());
            let Patch { centre, u, v } = patches[k];
            let (a, b): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0));
            let in_model = centre + u * a + v * b + vector(&mut rng, 1.0) * noise;
            (model_from_scan.inverse().transform(&in_model), k, vector(&mut rng, 1.0) * (10.0 * noise))
        };
        let points = truth.iter().map(|pose| (0..per_scan).map(|_| point(pose)).collect()).collect();
        let n = truth.len();
        let pairs = (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|(i, j)| i != j).collect();
        Self { pairs, truth: truth.to_vec(), points, patches: patches.to_vec() }
    }
}

fn single(v: Vector3<f64>) -> Point {
    v.cast::<f32>().into()
}

impl Correspondences for Samples {
    fn pairs(&self) -> &[(usize, usize)] {
        &self.pairs
    }

    /// The foot of each point of j on the nearest patch as scan i sees it, if within the gate.
    fn associate(&self, pair: usize, i_from_j: &Pose, gate: f64) -> Vec<Correspondence> {
        let (i, j) = self.pairs[pair];
        let scan_from_model = self.truth[i].inverse();
        let near = |(point_in_j, patch, error): &Sample| {
            let normal = scan_from_model.rotation * self.patches[*patch].normal();
            let on_patch = scan_from_model.transform(&self.patches[*patch].centre);
            let point = i_from_j.transform(point_in_j);
            let distance = normal.dot(&(point - on_patch));
            (distance.abs() < gate).then(|| Correspondence {
                point_in_i: single(point - normal * distance),
                normal_in_i: single((normal + error).normalize()),
                point_in_j: single(*point_in_j),
                weight: 1.0,
            })
        };
        self.points[j].iter().filter_map(near).collect()
    }
}

fn first_held(scans: usize) -> Vec<bool> {
    (0..scans).map(|scan| scan == 0).collect()
}

fn adjust(surfaces: &Samples, start: &[Pose], tracks: &[Track], options: &DenseOptions) -> DenseAdjustment {
    let problem = DenseProblem { poses: start, held: &first_held(start.len()), surfaces, tracks };
    with_control(|control| adjust_dense(&problem, options, control)).unwrap()
}

fn options() -> DenseOptions {
    DenseOptions::with_gates(0.5, 0.05)
}

#[test]
fn scans_of_a_room_fall_into_place_exactly() {
    let mut rng = rng(1);
    let truth = poses(5, &mut rng);
    let surfaces = Samples::new(&truth, &room(), 600, 0.0, 1);
    let start = disturbed(&truth, 0.03, 0.08, &mut rng);
    let result = adjust(&surfaces, &start, &[], &options());
    assert_poses_near(&result.poses, &truth, 1e-5, 1e-5);
    assert!(result.blind_motions.iter().all(Vec::is_empty));
    assert_eq!(result.rounds.len(), 6);
    assert!(result.rounds.iter().all(|round| round.report.cost_after <= round.report.cost_before));
    assert!(result.covariances(&[1, 4]).is_ok());
}

#[test]
fn the_gradient_of_surfaces_holds_and_landmarks_is_the_numerical_one() {
    let mut rng = rng(2);
    let truth = poses(4, &mut rng);
    let surfaces = Samples::new(&truth, &room()[..2], 60, 0.01, 2);
    let start = disturbed(&truth, 0.02, 0.05, &mut rng);
    let tracks = tracks(&truth, 20, 3, &mut rng);
    let options = DenseOptions { least_correspondences: 5, hold_weight: 0.3, ..options() };
    let landmarks = LandmarkTerms { tracks: &tracks, kernel: Kernel::Squared, factor: 0.5 };
    let mut round =
        with_control(|control| Round::associate(&surfaces, &start, 0.5, &options, landmarks, control))
            .unwrap();
    round.held = first_held(4);
    assert!(round.pairs.iter().all(|pair| pair.hold.is_some_and(|hold| hold.motions > 0)));
    // Away from the reference of the holds, by as much as a round moves.
    let moved = disturbed(&start, 1e-4, 1e-3, &mut rng);
    let state = BundleState { landmarks: landmarks.place(&moved), poses: moved };
    assert_gradient(&round, &state, 4, 1e-6);
}

#[test]
fn scans_that_share_one_plane_do_not_slide_along_it() {
    let mut rng = rng(3);
    let truth = poses(3, &mut rng);
    let floor = &room()[..1];
    let surfaces = Samples::new(&truth, floor, 500, 0.003, 3);
    // Slid along the floor, turned about its normal, lifted and tilted.
    let slide = Pose::new(Rotation3::new(Vector3::z() * 0.05), Vector3::new(0.2, -0.1, 0.0));
    let tilt = Pose::new(Rotation3::new(Vector3::x() * 0.02), Vector3::z() * 0.05);
    let centre = Pose::from_translation(floor[0].centre);
    let lift = centre * tilt * centre.inverse();
    let slid: Vec<Pose> =
        truth.iter().enumerate().map(|(k, t)| if k == 0 { *t } else { slide * *t }).collect();
    let start: Vec<Pose> =
        slid.iter().enumerate().map(|(k, t)| if k == 0 { *t } else { lift * *t }).collect();
    let result = adjust(&surfaces, &start, &[], &options());
    assert_poses_near(&result.poses, &slid, 4e-3, 5e-3);
    assert!(result.blind_motions[1..].iter().all(|motions| motions.len() == 3));
    assert!(result.rounds.iter().all(|round| round.blind_pairs == round.pairs));
}

#[test]
fn landmarks_decide_where_planes_leave_a_motion_free() {
    let mut rng = rng(4);
    let truth = poses(3, &mut rng);
    let surfaces = Samples::new(&truth, &room()[..1], 300, 0.0, 4);
    let all = tracks(&truth, 100, 3, &mut rng);
    let start = disturbed(&truth, 0.02, 0.05, &mut rng);
    let options = DenseOptions { landmark_weight: 1.0, rounds: 12, ..options() };
    let result = adjust(&surfaces, &start, &all, &options);
    assert_poses_near(&result.poses, &truth, 2e-3, 2e-3);
}

#[test]
fn a_motion_that_one_neighbour_holds_is_corrected_although_another_is_blind_to_it() {
    let truth = poses(3, &mut rng(5));
    let surfaces = Samples::new(&truth, &room(), 600, 0.0, 5);
    // Scans 0 and 1 share the room; 2 shares it with 1, but only the floor with 0.
    let mixed = FloorOnly { inner: surfaces, pair: (0, 2) };
    let start = disturbed(&truth, 0.02, 0.05, &mut rng(6));
    let problem = DenseProblem { poses: &start, held: &first_held(3), surfaces: &mixed, tracks: &[] };
    let result = with_control(|control| adjust_dense(&problem, &options(), control)).unwrap();
    assert!(result.rounds.iter().all(|round| round.blind_pairs == 2));
    assert_poses_near(&result.poses, &truth, 1e-4, 1e-4);
}

/// Samples of which one pair of scans sees only the first patch in common.
struct FloorOnly {
    inner: Samples,
    pair: (usize, usize),
}

impl Correspondences for FloorOnly {
    fn pairs(&self) -> &[(usize, usize)] {
        self.inner.pairs()
    }

    fn associate(&self, pair: usize, i_from_j: &Pose, gate: f64) -> Vec<Correspondence> {
        let all = self.inner.associate(pair, i_from_j, gate);
        let (i, j) = self.inner.pairs[pair];
        if (i.min(j), i.max(j)) != self.pair {
            return all;
        }
        let floor = single(self.inner.truth[i].inverse().rotation * self.inner.patches[0].normal());
        all.into_iter().filter(|c| c.normal_in_i == floor).collect()
    }
}

#[test]
fn held_scans_do_not_move_and_scans_without_surface_in_common_are_named() {
    let mut rng = rng(7);
    let truth = poses(4, &mut rng);
    let mut surfaces = Samples::new(&truth, &room(), 300, 0.0, 7);
    surfaces.points[3].clear();
    let start = disturbed(&truth, 0.02, 0.05, &mut rng);
    surfaces.pairs.retain(|(i, j)| *i != 3 && *j != 3);
    let held = [false, true, false, false];
    let problem = DenseProblem { poses: &start, held: &held, surfaces: &surfaces, tracks: &[] };
    let result = with_control(|control| adjust_dense(&problem, &options(), control)).unwrap();
    assert_eq!((result.poses[1], result.poses[3]), (start[1], start[3]));
    assert_eq!((result.anchors, result.unlinked), (vec![], vec![3]));
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let mut rng = rng(8);
    let truth = poses(5, &mut rng);
    let surfaces = Samples::new(&truth, &room(), 200, 0.005, 8);
    let all = tracks(&truth, 1200, 3, &mut rng);
    let start = disturbed(&truth, 0.02, 0.05, &mut rng);
    let run = |threads| {
        with_threads(threads, || {
            let result = adjust(&surfaces, &start, &all, &options());
            (result.poses, result.landmarks, result.rounds)
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn malformed_input_and_nothing_in_common_are_refused_by_name() {
    let two = [Pose::identity(); 2];
    let mut surfaces = Samples::new(&two, &room(), 5, 0.0, 9);
    let fails = |surfaces: &Samples, held: &[bool], poses: &[Pose]| {
        let problem = DenseProblem { poses, held, surfaces, tracks: &[] };
        with_control(|control| adjust_dense(&problem, &options(), control)).unwrap_err()
    };
    let nothing = DenseError::NothingInCommon { least: 30, gate: 0.5 };
    assert_eq!(fails(&surfaces, &[false; 2], &two), nothing);
    assert_eq!(fails(&surfaces, &[false], &two), DenseError::HeldMismatch { flags: 1, poses: 2 });
    let lost = [two[0], Pose::from_translation(Vector3::repeat(f64::NAN))];
    assert_eq!(fails(&surfaces, &[false; 2], &lost), DenseError::PoseNotFinite { scan: 1 });
    surfaces.pairs.push((1, 1));
    let bad = DenseError::BadPair { pair: 2, i: 1, j: 1, scans: 2 };
    assert_eq!(fails(&surfaces, &[false; 2], &two), bad);
    let wide = DenseOptions { first_gate: 0.01, ..options() };
    assert_eq!(wide.validate().unwrap_err().name, "first_gate");
}

#[test]
fn a_cancelled_adjustment_is_an_error() {
    let two = [Pose::identity(); 2];
    let surfaces = Samples::new(&two, &room(), 100, 0.0, 10);
    let cancel = CancelToken::new();
    cancel.cancel();
    let control = Control { cancel: &cancel, observer: &crate::control::Silent };
    let problem = DenseProblem { poses: &two, held: &[false; 2], surfaces: &surfaces, tracks: &[] };
    let error = adjust_dense(&problem, &options(), control).unwrap_err();
    assert!(matches!(error, DenseError::Minimise(MinimiseError::Cancelled(_))));
}
