//! Point-to-plane ICP of two scans, with a shrinking gate and a robust weight.

use nalgebra::{Matrix6, Vector3, Vector6};

use crate::features::Scan;
use crate::geometry::{Point, Pose};

/// Points of the moving scan used, at most: evenly spread over it.
const MAX_POINTS: usize = 1200;
const ITERATIONS: usize = 10;
/// Correspondences farther than the gate are dropped; it shrinks from the first to the last iteration. Voxels.
const GATE_VOXELS: (f32, f32) = (4.0, 1.6);
/// Scale of the robust weight (1 + (r / scale)^2)^-2. Voxels.
const KERNEL_VOXELS: f64 = 0.8;
/// Normals must agree at least this well (cosine).
const MIN_NORMAL_DOT: f32 = 0.5;
/// A step smaller than this, in voxels at the scan's radius, ends the iteration once the gate is small.
const CONVERGED_VOXELS: f64 = 0.002;

/// Moves scan b onto scan a, starting from `a_from_b`. Directions that the overlap does not hold keep their start.
#[must_use]
pub fn icp(a: &Scan, b: &Scan, a_from_b: &Pose) -> Pose {
    let voxel = a.prepared.resolution;
    let stride = b.prepared.points.len().div_ceil(MAX_POINTS).max(1);
    let mut pose = *a_from_b;
    for iteration in 0..ITERATIONS {
        let share = iteration as f32 / (ITERATIONS - 1) as f32;
        let gate = (GATE_VOXELS.0 + (GATE_VOXELS.1 - GATE_VOXELS.0) * share) * voxel as f32;
        let Some((hessian, gradient, centre)) =
            normal_equations(a, b, &pose, stride, gate, KERNEL_VOXELS * voxel)
        else {
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
    kernel: f64,
) -> Option<(Matrix6<f64>, Vector6<f64>, Vector3<f64>)> {
    let rotation = pose.rotation.matrix().cast::<f32>();
    let translation = pose.translation.cast::<f32>();
    let mut rows: Vec<(Vector3<f64>, Vector3<f64>, f64)> = Vec::with_capacity(MAX_POINTS);
    let mut centre = Vector3::zeros();
    for (point, normal) in b.prepared.points.iter().zip(&b.prepared.normals).step_by(stride) {
        let q = rotation * Vector3::from(*point) + translation;
        let moved: Point = [q.x, q.y, q.z];
        let Some(near) = a.grid.nearest(&moved) else { continue };
        let target = Vector3::from(a.prepared.points[near]);
        let offset = q - target;
        if offset.norm_squared() > gate * gate {
            continue;
        }
        let target_normal = Vector3::from(a.prepared.normals[near]);
        if target_normal.dot(&(rotation * Vector3::from(*normal))) < MIN_NORMAL_DOT {
            continue;
        }
        let q = q.cast::<f64>();
        centre += q;
        rows.push((q, target_normal.cast(), f64::from(target_normal.dot(&offset))));
    }
    if rows.len() < 12 {
        return None;
    }
    centre /= rows.len() as f64;
    let mut hessian = Matrix6::zeros();
    let mut gradient = Vector6::zeros();
    for (q, normal, residual) in &rows {
        let weight = (1.0 + (residual / kernel).powi(2)).powi(-2);
        let turn = (q - centre).cross(normal);
        let j = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
        hessian.syger(weight, &j, &j, 1.0);
        gradient.axpy(weight * residual, &j, 1.0);
    }
    hessian.fill_upper_triangle_with_lower_triangle();
    Some((hessian, gradient, centre))
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
