//! Dense evidence for a pose of two scans: do their surfaces coincide, and does either put a surface where the other
//! saw free space?

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::features::{Scan, Visibility};
use crate::geometry::{Point, Pose};

/// A point with a point of the other scan this near, in voxels, lies on its surface if the normals agree …
const NEAR_VOXELS: f32 = 2.4;
const TIGHT_VOXELS: f32 = 1.2;
/// … by this cosine. Normals more opposite than its negative are the other side of a thin wall and say nothing.
const NORMAL_DOT: f32 = 0.6;

/// Counts over the points of one scan, seen against the other.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Counts {
    /// Points looked at.
    pub points: u32,
    /// On the other's surface: near, with like normals.
    pub inliers: u32,
    /// Of those, the ones at half that distance.
    pub tight: u32,
    /// Near, but with a clearly different normal.
    pub wrong_normal: u32,
    /// In what the other saw as free space.
    pub violations: u32,
    /// At the depth that the other saw.
    pub on_seen_surface: u32,
    /// Sum of squared point-to-plane distances of the inliers, square metres.
    pub plane_square: f32,
}

impl Counts {
    /// Both sets of points together.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self {
            points: self.points + other.points,
            inliers: self.inliers + other.inliers,
            tight: self.tight + other.tight,
            wrong_normal: self.wrong_normal + other.wrong_normal,
            violations: self.violations + other.violations,
            on_seen_surface: self.on_seen_surface + other.on_seen_surface,
            plane_square: self.plane_square + other.plane_square,
        }
    }

    /// Share of the points that lie on the other's surface.
    #[must_use]
    pub fn overlap(&self) -> f64 {
        share(self.inliers, self.points)
    }

    /// Violations among the points that can be judged: those on the surface and those in free space.
    #[must_use]
    pub fn violation_share(&self) -> f64 {
        share(self.violations, self.violations + self.inliers)
    }
}

pub(super) fn share(part: u32, whole: u32) -> f64 {
    f64::from(part) / f64::from(whole.max(1))
}

/// Looks at every `stride`-th point of `other` against what `scan` holds and saw.
#[must_use]
pub fn look(scan: &Scan, other: &Scan, scan_from_other: &Pose, stride: usize) -> Counts {
    let voxel = scan.prepared.resolution as f32;
    let near_square = (NEAR_VOXELS * voxel).powi(2);
    let tight_square = (TIGHT_VOXELS * voxel).powi(2);
    let rotation = scan_from_other.rotation.matrix().cast::<f32>();
    let translation = scan_from_other.translation.cast::<f32>();
    let mut counts = Counts::default();
    for (point, normal) in other.prepared.points.iter().zip(&other.prepared.normals).step_by(stride.max(1)) {
        counts.points += 1;
        let q = rotation * Vector3::from(*point) + translation;
        let moved: Point = [q.x, q.y, q.z];
        if let Some(near) = scan.grid.nearest(&moved) {
            let offset = q - Vector3::from(scan.prepared.points[near]);
            let square = offset.norm_squared();
            if square < near_square {
                let surface_normal = Vector3::from(scan.prepared.normals[near]);
                let agreement = surface_normal.dot(&(rotation * Vector3::from(*normal)));
                if agreement > NORMAL_DOT {
                    counts.inliers += 1;
                    counts.tight += u32::from(square < tight_square);
                    counts.plane_square += surface_normal.dot(&offset).powi(2);
                } else if agreement > -NORMAL_DOT {
                    counts.wrong_normal += 1;
                }
                // So near a surface nothing can be clearly in front of it.
                continue;
            }
        }
        if let Some(image) = &scan.prepared.range_image {
            match image.judge(&moved) {
                Visibility::InFront => counts.violations += 1,
                Visibility::OnSurface => counts.on_seen_surface += 1,
                Visibility::Hidden | Visibility::Unknown => {}
            }
        }
    }
    counts
}

/// Number of points of `other`, every `stride`-th looked at, near the surface of `scan`: the quick first look at a pose.
#[must_use]
pub fn quick_overlap(scan: &Scan, other: &Scan, scan_from_other: &Pose, stride: usize) -> usize {
    look(scan, other, scan_from_other, stride).inliers as usize
}
