//! Point-to-plane ICP of two scans, with a shrinking gate and a robust weight.

use multiversion::multiversion;
use nalgebra::{Matrix6, Vector3, Vector6};

use super::contacts::{Contacts, LANES, Motion, Numbers, meet};
use crate::features::Scan;
use crate::geometry::Pose;

/// Points of the moving scan used, at most, evenly spread over it: in the first half of the iterations, and in the second.
const POINTS: [usize; 2] = [600, 1200];
const ITERATIONS: usize = 10;
/// Correspondences farther than the gate are dropped; it shrinks from the first to the last iteration. Voxels.
const GATE_VOXELS: (f32, f32) = (4.0, 1.6);
/// Scale of the robust weight (1 + (r / scale)^2)^-2. Voxels.
const KERNEL_VOXELS: f32 = 0.8;
/// Normals must agree at least this well (cosine).
const MIN_NORMAL_DOT: f32 = 0.5;
/// A step smaller than this, in voxels at the scan's radius, ends the iteration once the gate is small.
const CONVERGED_VOXELS: f64 = 0.002;

/// Moves scan b onto scan a, starting from `a_from_b`. Directions that the overlap does not hold keep their start.
#[must_use]
pub fn icp(a: &Scan, b: &Scan, a_from_b: &Pose) -> Pose {
    let voxel = a.prepared.resolution;
    let strides = POINTS.map(|points| b.prepared.points.len().div_ceil(points).max(1));
    let mut pose = *a_from_b;
    for iteration in 0..ITERATIONS {
        let share = iteration as f32 / (ITERATIONS - 1) as f32;
        let gate = (GATE_VOXELS.0 + (GATE_VOXELS.1 - GATE_VOXELS.0) * share) * voxel as f32;
        let stride = strides[usize::from(share > 0.5)];
        let kernel = KERNEL_VOXELS * voxel as f32;
        let Some((hessian, gradient, centre)) = normal_equations(a, b, &pose, stride, gate, kernel) else {
            break;
        };
        let Some(step) = solve_held(&hessian, &gradient, b.rms_radius) else { break };
        pose = perturbed_about(&pose, &step, &centre).renormalised();
        let motion = step.fixed_rows::<3>(0).norm() * b.rms_radius + step.fixed_rows::<3>(3).norm();
        if share > 0.5 && motion < CONVERGED_VOXELS * voxel {
            break;
        }
    }
    pose
}

/// `pose` turned and shifted by a twist whose rotation is about `centre` (in the target frame).
#[must_use]
pub fn perturbed_about(pose: &Pose, twist: &Vector6<f64>, centre: &Vector3<f64>) -> Pose {
    let to_centre = Pose::from_translation(-centre);
    Pose::from_translation(*centre) * Pose::from_twist(twist) * to_centre * *pose
}

/// Gauss-Newton equations of the point-to-plane residuals, about the centre of the correspondences.
fn normal_equations(
    a: &Scan,
    b: &Scan,
    pose: &Pose,
    stride: usize,
    gate: f32,
    kernel: f32,
) -> Option<(Matrix6<f64>, Vector6<f64>, Vector3<f64>)> {
    let motion = Motion::of(pose);
    // Summed about a point that is known beforehand and near enough to the centre for single precision.
    let about = pose.transform(&b.centroid).cast::<f32>();
    let limits = Limits { about: about.into(), gate_square: gate * gate, per_kernel: 1.0 / kernel };
    let mut sums = [0.0_f64; SUMS];
    meet(a, b, &motion, (0, stride), |block, _| accumulate(block, &limits, &mut sums));
    let [count, x, y, z, rest @ ..] = sums;
    if count < 12.0 {
        return None;
    }
    let (gradient, hessian) = rest.split_at(6);
    let gradient = Vector6::from_column_slice(gradient);
    let mut entry = hessian.iter();
    let mut lower = Matrix6::zeros();
    for i in 0..6 {
        for j in 0..=i {
            lower[(i, j)] = *entry.next()?;
        }
    }
    lower.fill_upper_triangle_with_lower_triangle();
    // A turn about the centre moves the other point too: (q - c) x n = (q - p) x n - (c - p) x n.
    let shift = Vector3::new(x, y, z) / count;
    let mut to_centre = Matrix6::identity();
    to_centre.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-shift.cross_matrix()));
    let hessian = to_centre * lower * to_centre.transpose();
    Some((hessian, to_centre * gradient, about.cast() + shift))
}

/// What is summed over the correspondences: their number, their positions, the gradient, the lower triangle of the Hessian.
const SUMS: usize = 1 + 3 + 6 + 21;

struct Limits {
    about: [f32; 3],
    gate_square: f32,
    per_kernel: f32,
}

#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn accumulate(block: &Contacts, limits: &Limits, sums: &mut [f64; SUMS]) {
    let mut parts = [[0.0_f32; LANES]; SUMS];
    for first in (0..block.lanes()).step_by(LANES) {
        let lanes = |of: &Numbers| -> [f32; LANES] { std::array::from_fn(|lane| of[first + lane]) };
        let [nx, ny, nz] = block.surface.each_ref().map(lanes);
        let [mx, my, mz] = block.normal.each_ref().map(lanes);
        let [dx, dy, dz] = block.offset.each_ref().map(lanes);
        let [x, y, z] = block.point.each_ref().map(lanes);
        let square = lanes(&block.square);
        let mut used = [0.0; LANES];
        let mut weighted = [0.0; LANES];
        let mut weight = [0.0; LANES];
        let mut position = [[0.0; LANES]; 3];
        let mut jacobian = [[0.0; LANES]; 6];
        for k in 0..LANES {
            let agreement = nx[k] * mx[k] + ny[k] * my[k] + nz[k] * mz[k];
            let residual = nx[k] * dx[k] + ny[k] * dy[k] + nz[k] * dz[k];
            let meets = (square[k] <= limits.gate_square) && (agreement >= MIN_NORMAL_DOT);
            let spread = 1.0 + (residual * limits.per_kernel) * (residual * limits.per_kernel);
            let robust = 1.0 / (spread * spread);
            used[k] = if meets { 1.0 } else { 0.0 };
            weight[k] = if meets { robust } else { 0.0 };
            weighted[k] = if meets { robust * residual } else { 0.0 };
            let (px, py, pz) = (x[k] - limits.about[0], y[k] - limits.about[1], z[k] - limits.about[2]);
            // Outside the block's length there may be anything, also what is no number.
            let (px, py, pz) = if meets { (px, py, pz) } else { (0.0, 0.0, 0.0) };
            position[0][k] = px;
            position[1][k] = py;
            position[2][k] = pz;
            jacobian[0][k] = py * nz[k] - pz * ny[k];
            jacobian[1][k] = pz * nx[k] - px * nz[k];
            jacobian[2][k] = px * ny[k] - py * nx[k];
            jacobian[3][k] = nx[k];
            jacobian[4][k] = ny[k];
            jacobian[5][k] = nz[k];
        }
        for k in 0..LANES {
            parts[0][k] += used[k];
            parts[1][k] += position[0][k];
            parts[2][k] += position[1][k];
            parts[3][k] += position[2][k];
        }
        for i in 0..6 {
            for k in 0..LANES {
                parts[4 + i][k] += weighted[k] * jacobian[i][k];
            }
        }
        let mut at = 10;
        for i in 0..6 {
            for j in 0..=i {
                for k in 0..LANES {
                    parts[at][k] += weight[k] * jacobian[i][k] * jacobian[j][k];
                }
                at += 1;
            }
        }
    }
    for (sum, parts) in sums.iter_mut().zip(&parts) {
        *sum += parts.iter().map(|x| f64::from(*x)).sum::<f64>();
    }
}

/// Solves for the step, with directions along which the surfaces slide freely held by a small prior.
pub(crate) fn solve_held(
    hessian: &Matrix6<f64>,
    gradient: &Vector6<f64>,
    radius: f64,
) -> Option<Vector6<f64>> {
    let strength = 1e-3 * hessian.fixed_view::<3, 3>(3, 3).trace();
    let mut held = *hessian;
    for k in 0..3 {
        held[(k, k)] += strength * radius * radius;
        held[(k + 3, k + 3)] += strength;
    }
    let step = -held.cholesky()?.solve(gradient);
    step.iter().all(|x| x.is_finite()).then_some(step)
}
