//! Which way is up in a model whose frame may lie anyhow.
//!
//! Candidates are the directions that many flat patches face, the direction that stays put while the scans turn, and the
//! thinnest direction of the cloud. The best has flat patches (floors, tables), is steady in the frames of the scans
//! (sensors mostly turn about the vertical) and is thin (buildings are wide and low).

use nalgebra::{Matrix3, Rotation3, SymmetricEigen, Vector3};

use super::quantile;
use crate::geometry::{Point, voxel_groups};

/// The estimated frame.
pub(super) struct Upright {
    /// `upright_from_model`: z up, x along the longer horizontal side, walls along x and y.
    pub rotation: Rotation3<f64>,
    /// Whether large flat surfaces face up, as floors and ceilings do; a statue has none.
    pub has_rooms: bool,
}

/// About how many voxels the cloud is across.
const VOXELS_ACROSS: f32 = 60.0;

/// A patch's thickness is at most this share of its width.
const FLAT: f64 = 0.12;

/// Share of flat patches that face up or down where there are rooms.
const ROOM_SHARE: f64 = 0.18;

/// Finds the upright frame of points (metres, around their centre) of scans with these rotations.
pub(super) fn estimate(points: &[Vector3<f32>], model_from_scan: &[Rotation3<f64>]) -> Upright {
    let patches = flat_patches(points);
    let spread = principal_axes(points);
    let mean_rotation: Matrix3<f64> = model_from_scan.iter().map(|r| r.into_inner()).sum::<Matrix3<f64>>()
        / model_from_scan.len().max(1) as f64;
    let mut candidates = facing_directions(&patches);
    candidates.push(spread[0]);
    if let Some(u) = mean_rotation.svd(true, false).u {
        candidates.push(u.column(0).into_owned());
    }
    let mut best = (spread[0], f64::NEG_INFINITY);
    for candidate in candidates {
        let axis = refined(candidate, &patches);
        // The length of the mean of the axis in the frames of the scans: 1 when it never moves.
        let steady = (mean_rotation.transpose() * axis).norm();
        let thin = 1.0 / (0.2 + extent(points, &axis) / extent(points, &spread[2]).max(1e-9));
        let score = (0.05 + facing_share(&axis, &patches)) * (0.1 + steady.powi(2)) * thin;
        if score > best.1 {
            best = (axis, score);
        }
    }
    let share = facing_share(&best.0, &patches);
    let up = signed(best.0, &mean_rotation, points, share > ROOM_SHARE);
    Upright { rotation: horizontal_axes(&up, &patches, points), has_rooms: share > ROOM_SHARE }
}

/// The normals of voxels whose points lie flat.
fn flat_patches(points: &[Vector3<f32>]) -> Vec<Vector3<f64>> {
    let extents = (0..3).map(|axis| {
        let value = |share| quantile(points.iter().map(|p| p[axis]), share).unwrap_or_default();
        value(0.98) - value(0.02)
    });
    let size = extents.fold(0.0, f32::max) / VOXELS_ACROSS;
    if !(size.is_finite() && size > 0.0) {
        return Vec::new();
    }
    let plain: Vec<Point> = points.iter().map(|p| [p.x, p.y, p.z]).collect();
    voxel_groups(&plain, size)
        .iter()
        .filter(|group| group.len() >= 8)
        .filter_map(|group| {
            let members =
                || group.iter().filter_map(|&index| points.get(index as usize)).map(|p| p.cast::<f64>());
            let mean = members().sum::<Vector3<f64>>() / group.len() as f64;
            let covariance: Matrix3<f64> = members().map(|p| (p - mean) * (p - mean).transpose()).sum();
            let (values, axes) = sorted_eigen(covariance);
            (values[0] < FLAT * FLAT * values[1]).then_some(axes[0])
        })
        .collect()
}

/// Eigenvalues and unit eigenvectors, smallest first.
fn sorted_eigen(matrix: Matrix3<f64>) -> ([f64; 3], [Vector3<f64>; 3]) {
    let eigen = SymmetricEigen::new(matrix);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    (order.map(|i| eigen.eigenvalues[i]), order.map(|i| eigen.eigenvectors.column(i).into_owned()))
}

fn principal_axes(points: &[Vector3<f32>]) -> [Vector3<f64>; 3] {
    let mean = points.iter().map(|p| p.cast::<f64>()).sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let covariance: Matrix3<f64> = points
        .iter()
        .map(|p| {
            let off = p.cast::<f64>() - mean;
            off * off.transpose()
        })
        .sum();
    if covariance.iter().all(|x| x.is_finite()) {
        sorted_eigen(covariance).1
    } else {
        [Vector3::z(), Vector3::y(), Vector3::x()]
    }
}

/// Up to six directions that many patches face: the fullest first, then the fullest of the rest.
fn facing_directions(patches: &[Vector3<f64>]) -> Vec<Vector3<f64>> {
    let mut left: Vec<&Vector3<f64>> = patches.iter().step_by((patches.len() / 1500).max(1)).collect();
    let mut directions = Vec::new();
    while directions.len() < 6 && !left.is_empty() {
        let facing = |axis: &Vector3<f64>| left.iter().filter(|p| p.dot(axis).abs() > COS_FACING).count();
        let mut fullest = (0, Vector3::z());
        for patch in left.iter().step_by((left.len() / 300).max(1)) {
            let count = facing(patch);
            if count > fullest.0 {
                fullest = (count, **patch);
            }
        }
        directions.push(fullest.1);
        left.retain(|p| p.dot(&fullest.1).abs() < 0.9);
    }
    directions
}

/// Cosine of 10 degrees.
const COS_FACING: f64 = 0.985;

fn facing_share(axis: &Vector3<f64>, patches: &[Vector3<f64>]) -> f64 {
    let facing = patches.iter().filter(|p| p.dot(axis).abs() > COS_FACING).count();
    facing as f64 / patches.len().max(1) as f64
}

/// The mean of the normals near an axis.
fn refined(axis: Vector3<f64>, patches: &[Vector3<f64>]) -> Vector3<f64> {
    let mut axis = axis;
    for _ in 0..3 {
        let near = patches.iter().map(|p| (p, p.dot(&axis))).filter(|(_, cos)| cos.abs() > COS_FACING);
        let sum: Vector3<f64> = near.map(|(normal, cos)| normal * cos.signum()).sum();
        axis = sum.try_normalize(1e-9).unwrap_or(axis);
    }
    axis.try_normalize(1e-9).unwrap_or_else(Vector3::z)
}

fn extent(points: &[Vector3<f32>], axis: &Vector3<f64>) -> f64 {
    let axis = axis.cast::<f32>();
    let value = |share| quantile(points.iter().map(|p| p.dot(&axis)), share).unwrap_or_default();
    f64::from(value(0.98) - value(0.02))
}

/// The axis or its opposite. Levelled scanners have z up and cameras y down; otherwise the side with more mass is below.
fn signed(
    axis: Vector3<f64>,
    mean_rotation: &Matrix3<f64>,
    points: &[Vector3<f32>],
    has_rooms: bool,
) -> Vector3<f64> {
    let in_scans = mean_rotation.transpose() * axis;
    let evidence = if in_scans.z.abs() > 0.97 {
        in_scans.z
    } else if in_scans.y.abs() > 0.6 {
        if has_rooms { -in_scans.y } else { in_scans.y }
    } else {
        let direction = axis.cast::<f32>();
        let height = |share| quantile(points.iter().map(|p| p.dot(&direction)), share).unwrap_or_default();
        f64::from(f32::midpoint(height(0.02), height(0.98)) - height(0.5))
    };
    if evidence < 0.0 { -axis } else { axis }
}

/// Completes the frame: walls along the axes, the longer side along x.
fn horizontal_axes(up: &Vector3<f64>, patches: &[Vector3<f64>], points: &[Vector3<f32>]) -> Rotation3<f64> {
    let helper = if up.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
    let first = up.cross(&helper).normalize();
    let second = up.cross(&first);
    // Walls at right angles agree in four times their angle.
    let (mut cos, mut sin) = (0.0, 0.0);
    for wall in patches.iter().filter(|p| p.dot(up).abs() < 0.2) {
        let angle = 4.0 * wall.dot(&second).atan2(wall.dot(&first));
        cos += angle.cos();
        sin += angle.sin();
    }
    let angle = sin.atan2(cos) / 4.0;
    let mut x = first * angle.cos() + second * angle.sin();
    let mut y = up.cross(&x);
    if extent(points, &y) > extent(points, &x) {
        (x, y) = (y, -x);
    }
    Rotation3::from_matrix_unchecked(Matrix3::from_rows(&[x.transpose(), y.transpose(), up.transpose()]))
}
