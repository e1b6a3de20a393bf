//! Dense surfaces of scans against each other: correspondences for alignment, and the verdict on a join.

use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::component::Component;
use crate::cloud::ScanKey;
use crate::features::Scan;
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::optimize::{Correspondence, Correspondences};
use crate::pairwise::{Counts, Motion, PairKey, look, look_leniently, meet, perturbed_about, quick_overlap};

/// Cosine by which normals of corresponding points agree at least.
const MIN_NORMAL_DOT: f32 = 0.5;
/// A pair of scans overlaps when this share of a coarse sample lies on the other.
const LEAST_OVERLAP: f64 = 0.04;
/// It touches the other with this share.
const LEAST_TOUCH: f64 = 0.01;
const COARSE_POINTS: usize = 300;
/// Pairs and points used to align two components.
const ALIGN_PAIRS: usize = 16;
const ALIGN_POINTS: usize = 6000;
const ALIGN_ITERATIONS: usize = 12;
const ALIGN_GATE_VOXELS: (f64, f64) = (4.0, 1.6);
const ALIGN_KERNEL_VOXELS: f64 = 0.8;
/// Points of a scan used to judge a join.
const JUDGE_POINTS: usize = 1500;
/// Points of a scan used to judge a component's own pairs.
const INSIDE_POINTS: usize = 400;
/// Scans whose centroids are farther apart than this many times their summed RMS radii share nothing.
const NEAR_RADII: f64 = 2.5;

/// Every how many points to take so that at most `most` are taken.
fn stride(scan: &Scan, most: usize) -> usize {
    scan.prepared.points.len().div_ceil(most.max(1)).max(1)
}

/// Points of `j`, every `stride`-th from `offset`, with their nearest surface points in `i` within `gate` metres.
#[must_use]
pub fn associate(
    i: &Scan,
    j: &Scan,
    i_from_j: &Pose,
    gate: f64,
    stride: usize,
    offset: usize,
) -> Vec<Correspondence> {
    let motion = Motion::of(i_from_j);
    let square_gate = (gate as f32).powi(2);
    let mut found = Vec::with_capacity(j.prepared.points.len() / stride);
    meet(i, j, &motion, (offset, stride), |block, first| {
        for k in 0..block.len {
            if block.square[k] < square_gate && block.agreement(k) > MIN_NORMAL_DOT {
                let near = block.near(k);
                found.push(Correspondence {
                    point_in_i: i.prepared.points[near],
                    normal_in_i: i.prepared.normals[near],
                    point_in_j: j.prepared.points[first + k * stride],
                    weight: 1.0,
                });
            }
        }
    });
    found
}

/// Whether two scans at given poses in one frame can share anything at all, by their centroids and radii.
pub(super) fn may_overlap(x: &Scan, x_pose: &Pose, y: &Scan, y_pose: &Pose) -> bool {
    let distance = (x_pose.transform(&x.centroid) - y_pose.transform(&y.centroid)).norm();
    distance < NEAR_RADII * (x.rms_radius + y.rms_radius)
}

/// Share of a coarse sample of either scan on the surface of the other, the larger.
pub(super) fn coarse_overlap_of_either(i: &Scan, j: &Scan, i_from_j: &Pose) -> f64 {
    coarse_overlap(i, j, i_from_j).max(coarse_overlap(j, i, &i_from_j.inverse()))
}

/// Share of a coarse sample of `j` on the surface of `i`.
fn coarse_overlap(i: &Scan, j: &Scan, i_from_j: &Pose) -> f64 {
    let stride = stride(j, COARSE_POINTS);
    let looked = j.prepared.points.len().div_ceil(stride);
    quick_overlap(i, j, i_from_j, stride) as f64 / looked.max(1) as f64
}

/// A pair of scans of two components with the pose between them.
struct Crossing<'g> {
    i: &'g Scan,
    j: &'g Scan,
    a_from_i: Pose,
    b_from_j: Pose,
    overlap: f64,
}

/// The pairs of scans, one of each component, that overlap at a pose; the most overlap first.
fn crossings<'g>(graph: &'g ScanGraph, a: &Component, b: &Component, a_from_b: &Pose) -> Vec<Crossing<'g>> {
    let pairs: Vec<_> = a.poses.iter().flat_map(|x| b.poses.iter().map(move |y| (x, y))).collect();
    let mut found: Vec<Crossing<'g>> = pairs
        .par_iter()
        .filter_map(|((i, a_from_i), (j, b_from_j))| {
            let (i, j): (&Scan, &Scan) = (graph.scan(**i)?, graph.scan(**j)?);
            let a_from_j = *a_from_b * **b_from_j;
            if !may_overlap(i, a_from_i, j, &a_from_j) {
                return None;
            }
            let i_from_j = a_from_i.inverse() * a_from_j;
            let overlap = coarse_overlap_of_either(i, j, &i_from_j);
            Some(Crossing { i, j, a_from_i: **a_from_i, b_from_j: **b_from_j, overlap })
        })
        .collect();
    found.sort_by(|x, y| {
        y.overlap.total_cmp(&x.overlap).then((x.i.key(), x.j.key()).cmp(&(y.i.key(), y.j.key())))
    });
    found
}

/// Point-to-plane alignment of component b on component a, all their overlapping pairs together. Directions that the overlap does
/// not hold keep their start. Lengths in metres.
#[must_use]
pub fn align(graph: &ScanGraph, a: &Component, b: &Component, a_from_b: &Pose, voxel: f64) -> Pose {
    let mut pairs = crossings(graph, a, b, a_from_b);
    pairs.retain(|p| p.overlap > LEAST_OVERLAP);
    pairs.truncate(ALIGN_PAIRS);
    let mut pose = *a_from_b;
    if pairs.is_empty() {
        return pose;
    }
    let points = ALIGN_POINTS / pairs.len();
    for iteration in 0..ALIGN_ITERATIONS {
        let share = iteration as f64 / (ALIGN_ITERATIONS - 1) as f64;
        let gate = (ALIGN_GATE_VOXELS.0 + (ALIGN_GATE_VOXELS.1 - ALIGN_GATE_VOXELS.0) * share) * voxel;
        let Some(next) = align_once(&pairs, &pose, gate, ALIGN_KERNEL_VOXELS * voxel, points) else { break };
        let moved = (next.inverse() * pose).angle() * pairs[0].j.rms_radius
            + (next.translation - pose.translation).norm();
        pose = next;
        if share > 0.5 && moved < 0.002 * voxel {
            break;
        }
    }
    pose
}

/// A point of b moved by the pose, the normal of its partner, and the distance between the two along it, in the frame of a.
type Row = (Vector3<f64>, Vector3<f64>, f64);

fn align_once(pairs: &[Crossing<'_>], pose: &Pose, gate: f64, kernel: f64, points: usize) -> Option<Pose> {
    let rows: Vec<Vec<Row>> = pairs
        .par_iter()
        .map(|p| {
            let a_from_j = *pose * p.b_from_j;
            let i_from_j = p.a_from_i.inverse() * a_from_j;
            associate(p.i, p.j, &i_from_j, gate, stride(p.j, points), 0)
                .iter()
                .map(|c| {
                    let moved = a_from_j.transform(&Vector3::from(c.point_in_j).cast());
                    let target = p.a_from_i.transform(&Vector3::from(c.point_in_i).cast());
                    let normal = p.a_from_i.rotation * Vector3::from(c.normal_in_i).cast::<f64>();
                    (moved, normal, normal.dot(&(moved - target)))
                })
                .collect()
        })
        .collect();
    let count = rows.iter().map(Vec::len).sum::<usize>();
    if count < 12 {
        return None;
    }
    let centre = rows.iter().flatten().map(|r| r.0).sum::<Vector3<f64>>() / count as f64;
    let spread = rows.iter().flatten().map(|r| (r.0 - centre).norm_squared()).sum::<f64>() / count as f64;
    let mut hessian = Matrix6::zeros();
    let mut gradient = Vector6::zeros();
    for (moved, normal, residual) in rows.iter().flatten() {
        let weight = (1.0 + (residual / kernel).powi(2)).powi(-2);
        let turn = (moved - centre).cross(normal);
        let j = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
        hessian.syger(weight, &j, &j, 1.0);
        gradient.axpy(weight * residual, &j, 1.0);
    }
    hessian.fill_upper_triangle_with_lower_triangle();
    let strength = 1e-3 * hessian.fixed_view::<3, 3>(3, 3).trace();
    for k in 0..3 {
        hessian[(k, k)] += strength * spread;
        hessian[(k + 3, k + 3)] += strength;
    }
    let step = -hessian.cholesky()?.solve(&gradient);
    step.iter().all(|x| x.is_finite()).then(|| perturbed_about(pose, &step, &centre).renormalised())
}

/// What all pairs of scans of two components say of a pose: counts over both directions, free space included.
#[must_use]
pub fn judge(graph: &ScanGraph, a: &Component, b: &Component, a_from_b: &Pose) -> Counts {
    crossings(graph, a, b, a_from_b)
        .par_iter()
        .map(|p| {
            let i_from_j = p.a_from_i.inverse() * *a_from_b * p.b_from_j;
            let there = look(p.i, p.j, &i_from_j, stride(p.j, JUDGE_POINTS));
            there.plus(&look(p.j, p.i, &i_from_j.inverse(), stride(p.i, JUDGE_POINTS)))
        })
        .collect::<Vec<_>>()
        .iter()
        .fold(Counts::default(), |sum, counts| sum.plus(counts))
}

/// What pairs other than some say at half the voxel of a pose of b in a: those that overlap most there, at most so many. Pairs that would
/// share no surface are not asked.
#[must_use]
pub fn judge_finely(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    a_from_b: &Pose,
    but: &[PairKey],
    most: usize,
) -> Counts {
    let mut pairs = crossings(graph, a, b, a_from_b);
    pairs.retain(|p| p.overlap > LEAST_TOUCH && !but.contains(&PairKey::of(p.i.key(), p.j.key())));
    pairs.truncate(most);
    let looks: Vec<Option<Counts>> = pairs
        .par_iter()
        .map(|p| look_leniently(p.i, p.j, &(p.a_from_i.inverse() * *a_from_b * p.b_from_j)))
        .collect();
    looks.iter().flatten().fold(Counts::default(), |sum, counts| sum.plus(counts))
}

/// What all pairs of scans inside a component say of its poses: how much its own data violate free space where nothing is wrong.
#[must_use]
pub fn judge_inside(graph: &ScanGraph, component: &Component) -> Counts {
    judge_each(graph, component).iter().fold(Counts::default(), |sum, (_, counts)| sum.plus(counts))
}

/// What each pair of scans of a component that can share anything says of its poses, over both directions.
#[must_use]
pub fn judge_each(graph: &ScanGraph, component: &Component) -> Vec<(PairKey, Counts)> {
    let members: Vec<(&Scan, Pose)> =
        component.poses.iter().filter_map(|(key, pose)| Some((graph.scan(*key)?.as_ref(), *pose))).collect();
    let pairs: Vec<(usize, usize)> =
        (0..members.len()).flat_map(|i| (i + 1..members.len()).map(move |j| (i, j))).collect();
    pairs
        .par_iter()
        .filter(|&&(i, j)| may_overlap(members[i].0, &members[i].1, members[j].0, &members[j].1))
        .map(|&(i, j)| {
            let ((x, x_pose), (y, y_pose)) = (&members[i], &members[j]);
            let x_from_y = x_pose.inverse() * *y_pose;
            let there = look(x, y, &x_from_y, stride(y, INSIDE_POINTS));
            let back = look(y, x, &x_from_y.inverse(), stride(x, INSIDE_POINTS));
            (PairKey::of(x.key(), y.key()), there.plus(&back))
        })
        .collect()
}

/// The overlapping pairs of one component as the joint dense adjustment reads them.
pub struct ComponentSurfaces<'g> {
    scans: Vec<&'g Scan>,
    pairs: Vec<(usize, usize)>,
    points: usize,
}

impl<'g> ComponentSurfaces<'g> {
    /// Finds the overlapping pairs at the component's poses with at least one scan that is `free`; `points` of each scan are used
    /// in each pair.
    #[must_use]
    pub fn new(
        graph: &'g ScanGraph,
        component: &Component,
        free: impl Fn(&ScanKey) -> bool,
        points: usize,
    ) -> Self {
        let members: Vec<(&'g Scan, Pose)> = component
            .poses
            .iter()
            .filter_map(|(key, pose)| Some((graph.scan(*key)?.as_ref(), *pose)))
            .collect();
        let candidates: Vec<(usize, usize)> =
            (0..members.len()).flat_map(|i| (i + 1..members.len()).map(move |j| (i, j))).collect();
        let is_free: Vec<bool> = members.iter().map(|(scan, _)| free(&scan.key())).collect();
        let pairs = candidates
            .par_iter()
            .filter(|&&(i, j)| {
                let ((x, x_pose), (y, y_pose)) = (&members[i], &members[j]);
                if !(is_free[i] || is_free[j]) || !may_overlap(x, x_pose, y, y_pose) {
                    return false;
                }
                let x_from_y = x_pose.inverse() * *y_pose;
                coarse_overlap_of_either(x, y, &x_from_y) > LEAST_OVERLAP
            })
            .flat_map_iter(|&(i, j)| [(i, j), (j, i)])
            .collect();
        Self { scans: members.into_iter().map(|(scan, _)| scan).collect(), pairs, points }
    }

    /// Root mean square point-to-plane distance within `gate` metres over points that the adjustment never sees; `poses` in the
    /// order of the component's scans. Metres; farther points count as `gate`.
    #[must_use]
    pub fn held_out_rms(&self, poses: &[Pose], gate: f64) -> f64 {
        let sums: Vec<(f64, usize)> = self
            .pairs
            .par_iter()
            .map(|&(i, j)| {
                let i_from_j = poses[i].inverse() * poses[j];
                let stride = 2 * stride(self.scans[j], self.points);
                let found = associate(self.scans[i], self.scans[j], &i_from_j, gate, stride, stride / 2);
                let square = |c: &Correspondence| {
                    let moved = i_from_j.transform(&Vector3::from(c.point_in_j).cast());
                    Vector3::from(c.normal_in_i)
                        .cast()
                        .dot(&(moved - Vector3::from(c.point_in_i).cast()))
                        .powi(2)
                };
                (found.iter().map(square).sum(), found.len())
            })
            .collect();
        let (square, count) = sums.iter().fold((0.0, 0), |(s, n), (square, count)| (s + square, n + count));
        (square / count.max(1) as f64).sqrt()
    }
}

impl Correspondences for ComponentSurfaces<'_> {
    fn pairs(&self) -> &[(usize, usize)] {
        &self.pairs
    }

    fn associate(&self, pair: usize, i_from_j: &Pose, gate: f64) -> Vec<Correspondence> {
        let (i, j) = self.pairs[pair];
        // Even multiples only: the odd ones are held out.
        associate(self.scans[i], self.scans[j], i_from_j, gate, 2 * stride(self.scans[j], self.points), 0)
    }
}
