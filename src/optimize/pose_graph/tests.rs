use nalgebra::Rotation3;
use std::f64::consts::PI;

use super::super::levenberg_marquardt::laws::assert_gradient;
use super::super::test_scene::{
    assert_poses_near, disturbed, poses, rng, vector, with_control, with_threads,
};
use super::*;

const LEVER: EdgeMetric = EdgeMetric::LeverArm(1.5);

fn edge(truth: &[Pose], i: usize, j: usize) -> PoseEdge {
    let i_from_j = truth[i].inverse() * truth[j];
    PoseEdge { i, j, i_from_j, centroid_in_j: Vector3::new(0.5, 2.0, 0.3), weight: 1.0, metric: LEVER }
}

/// Every scan tied to its next three, around a ring.
fn ring(truth: &[Pose]) -> Vec<PoseEdge> {
    let n = truth.len();
    (1..4).flat_map(|step| (0..n).map(move |i| (i, (i + step) % n))).map(|(i, j)| edge(truth, i, j)).collect()
}

fn adjust(poses: &[Pose], edges: &[PoseEdge], held: &[bool]) -> PoseGraphAdjustment {
    let minimise = MinimiseOptions { relative_cost: 1e-14, ..MinimiseOptions::default() };
    let options = PoseGraphOptions { minimise, ..PoseGraphOptions::with_final_scale(0.08) };
    with_control(|control| adjust_pose_graph(poses, edges, held, &options, control)).unwrap()
}

fn fails(poses: &[Pose], edges: &[PoseEdge], held: &[bool]) -> PoseGraphError {
    let options = PoseGraphOptions::with_final_scale(0.08);
    with_control(|control| adjust_pose_graph(poses, edges, held, &options, control)).unwrap_err()
}

#[test]
fn the_gradient_is_the_numerical_one_also_near_pi() {
    let mut rng = rng(1);
    let truth = poses(5, &mut rng);
    let mut edges = ring(&truth);
    let full = Matrix6::from_fn(|r, c| if r == c { 2.0 } else { 0.1 * (r + c) as f64 / 10.0 });
    edges[2].metric = EdgeMetric::Full(full);
    edges[3].weight = 2.5;
    // An edge that is wrong by almost half a turn.
    let turn = Pose::new(Rotation3::new(Vector3::new(0.0, PI - 0.05, 0.0)), Vector3::new(0.2, 0.1, 0.0));
    edges[4].i_from_j = turn * edges[4].i_from_j;
    let start = disturbed(&truth, 0.02, 0.3, &mut rng);
    let held = [true, false, false, false, false];
    for kernel in [Kernel::Squared, Kernel::GemanMcClure(1.0)] {
        let problem = GraphProblem { edges: &edges, held: &held, kernel };
        assert_gradient(&problem, &start, 5, 1e-6);
    }
}

#[test]
fn poses_are_recovered_and_wrong_edges_rejected() {
    let mut rng = rng(2);
    let truth = poses(12, &mut rng);
    let mut edges = ring(&truth);
    let wrong = [1, 8, 13, 20, 25, 30];
    for k in wrong {
        edges[k].i_from_j = Pose::new(Rotation3::new(vector(&mut rng, 1.5)), vector(&mut rng, 3.0));
    }
    let start = disturbed(&truth, 0.2, 0.5, &mut rng);
    let result = adjust(&start, &edges, &[false; 12]);
    // The kernel never quite forgets an edge that is wrong by metres.
    assert_poses_near(&result.poses, &truth, 1e-4, 1e-4);
    assert_eq!(result.anchors, [0]);
    for (k, inlier) in result.inliers.iter().enumerate() {
        assert_eq!(*inlier, !wrong.contains(&k), "edge {k} disagrees by {} m", result.residuals[k]);
        assert_eq!(*inlier, result.weights[k] >= 0.25);
    }
    assert!(result.levels > 5 && result.report.converged());
}

#[test]
fn moving_the_start_moves_the_result() {
    let mut rng = rng(3);
    let truth = poses(8, &mut rng);
    let mut edges = ring(&truth);
    for edge in &mut edges {
        edge.i_from_j =
            Pose::new(Rotation3::new(vector(&mut rng, 0.005)), vector(&mut rng, 0.01)) * edge.i_from_j;
    }
    let start = disturbed(&truth, 0.1, 0.2, &mut rng);
    let gauge = Pose::new(Rotation3::new(vector(&mut rng, 1.5)), vector(&mut rng, 100.0));
    let elsewhere: Vec<Pose> = start.iter().map(|pose| gauge * *pose).collect();
    let here = adjust(&start, &edges, &[false; 8]).poses;
    let there = adjust(&elsewhere, &edges, &[false; 8]).poses;
    let back: Vec<Pose> = there.iter().map(|pose| gauge.inverse() * *pose).collect();
    assert_poses_near(&back, &here, 1e-6, 1e-6);
}

#[test]
fn held_scans_stay_and_groups_are_anchored() {
    let mut rng = rng(4);
    let truth = poses(6, &mut rng);
    let edges = [edge(&truth, 0, 1), edge(&truth, 2, 4), edge(&truth, 4, 3)];
    let start = disturbed(&truth, 0.1, 0.2, &mut rng);
    let result = adjust(&start, &edges, &[false, true, false, false, false, false]);
    assert_eq!((result.anchors, result.unlinked), (vec![2], vec![5]));
    for scan in [1, 2, 5] {
        assert_eq!(result.poses[scan], start[scan]);
    }
    let relative = |poses: &[Pose]| poses[2].inverse() * poses[3];
    assert_poses_near(&[relative(&result.poses)], &[relative(&truth)], 1e-8, 1e-8);
}

#[test]
fn a_turn_about_the_overlap_costs_only_its_lever_arm() {
    let truth = [Pose::identity(); 2];
    let edge = PoseEdge { centroid_in_j: Vector3::new(50.0, 0.0, 0.0), ..edge(&truth, 0, 1) };
    let about = Pose::from_translation(edge.centroid_in_j);
    let turn = Pose::new(Rotation3::new(Vector3::z() * 0.01), Vector3::zeros());
    let residual = edge.residual(&(about * turn * about.inverse()));
    let square = residual.dot(&(edge.metric.matrix() * residual));
    assert!((square.sqrt() - 0.015).abs() < 1e-9, "{square}");
}

#[test]
fn one_thread_and_two_give_the_same_bits() {
    let mut rng = rng(5);
    let truth = poses(20, &mut rng);
    let mut edges = ring(&truth);
    edges[7].i_from_j = Pose::identity();
    let start = disturbed(&truth, 0.1, 0.2, &mut rng);
    let run = |threads| {
        with_threads(threads, || {
            let result = adjust(&start, &edges, &[false; 20]);
            (result.poses, result.weights, result.report)
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn malformed_input_is_refused_by_name() {
    let two = [Pose::identity(); 2];
    let good = edge(&two, 0, 1);
    assert_eq!(fails(&two, &[], &[false; 2]), PoseGraphError::NoEdges);
    assert_eq!(fails(&two, &[good], &[false]), PoseGraphError::HeldMismatch { flags: 1, poses: 2 });
    for (i, j) in [(0, 2), (1, 1)] {
        let error = fails(&two, &[good, PoseEdge { i, j, ..good }], &[false; 2]);
        assert_eq!(error, PoseGraphError::BadEnds { edge: 1, i, j, scans: 2 });
    }
    for bad in [
        PoseEdge { weight: -1.0, ..good },
        PoseEdge { metric: EdgeMetric::LeverArm(f64::NAN), ..good },
        PoseEdge { i_from_j: Pose::from_translation(Vector3::repeat(f64::INFINITY)), ..good },
    ] {
        assert_eq!(fails(&two, &[bad], &[false; 2]), PoseGraphError::NotFinite { edge: 0 });
    }
    let mut options = PoseGraphOptions::with_final_scale(0.0);
    assert_eq!(options.validate().unwrap_err().name, "final_scale");
    options = PoseGraphOptions { anneal: 1.0, ..PoseGraphOptions::with_final_scale(1.0) };
    assert_eq!(options.validate().unwrap_err().name, "anneal");
}
