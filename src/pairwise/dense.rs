//! Dense evidence for a pose of two scans: do their surfaces coincide, and does either put a surface where the other
//! saw free space?

use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use super::contacts::{Contacts, LANES, Motion, meet};
use crate::features::Scan;
use crate::geometry::Pose;

/// A point with a point of the other scan this near, in voxels, lies on its surface if the normals agree …
pub(super) const NEAR_VOXELS: f32 = 2.4;
const TIGHT_VOXELS: f32 = 1.2;
/// … by this cosine. Normals more opposite than its negative are the other side of a thin wall and say nothing.
pub(super) const NORMAL_DOT: f32 = 0.6;

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

    /// What these counts of every `stride`-th point stand for.
    #[must_use]
    pub fn times(&self, stride: usize) -> Self {
        let many = |count: u32| count.saturating_mul(u32::try_from(stride).unwrap_or(u32::MAX));
        Self {
            points: many(self.points),
            inliers: many(self.inliers),
            tight: many(self.tight),
            wrong_normal: many(self.wrong_normal),
            violations: many(self.violations),
            on_seen_surface: many(self.on_seen_surface),
            plane_square: self.plane_square * stride as f32,
        }
    }

    /// Share of the points that lie on the other's surface.
    #[must_use]
    pub fn overlap(&self) -> f64 {
        share(self.inliers, self.points)
    }

    /// Points that face another way among those that are near the other's surface.
    #[must_use]
    pub fn wrong_normal_share(&self) -> f64 {
        share(self.wrong_normal, self.wrong_normal + self.inliers)
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
    look_through(scan, other, scan_from_other, stride, |_| ())
}

/// The same, and shows every block of points on the way.
pub(super) fn look_through(
    scan: &Scan,
    other: &Scan,
    scan_from_other: &Pose,
    stride: usize,
    mut show: impl FnMut(&Contacts),
) -> Counts {
    let near = Near::at(scan.prepared.resolution as f32);
    let motion = Motion::of(scan_from_other);
    let mut counts = Counts::default();
    meet(scan, other, &motion, (0, stride.max(1)), |block, _| {
        counts = counts.plus(&on_surface(block, &near));
        show(block);
        if let Some(image) = &scan.prepared.range_image {
            // So near a surface nothing can be clearly in front of it: only the other points are judged.
            let (violations, on_seen_surface) = image.judge_all(block.farther_than(near.square));
            counts.violations += violations;
            counts.on_seen_surface += on_seen_surface;
        }
    });
    counts
}

/// Number of points of `other`, every `stride`-th looked at, near the surface of `scan`: the quick first look at a pose.
#[must_use]
pub fn quick_overlap(scan: &Scan, other: &Scan, scan_from_other: &Pose, stride: usize) -> usize {
    let near = Near::at(scan.prepared.resolution as f32);
    let motion = Motion::of(scan_from_other);
    let mut inliers = 0;
    meet(scan, other, &motion, (0, stride.max(1)), |block, _| inliers += on_surface(block, &near).inliers);
    inliers as usize
}

/// Squared distances, square metres.
struct Near {
    square: f32,
    tight: f32,
}

impl Near {
    fn at(voxel: f32) -> Self {
        Self { square: (NEAR_VOXELS * voxel).powi(2), tight: (TIGHT_VOXELS * voxel).powi(2) }
    }
}

/// What is counted of a block without free space.
fn on_surface(block: &Contacts, near: &Near) -> Counts {
    let mut counts = Counts { points: block.len as u32, ..Counts::default() };
    count(block, near, &mut counts);
    counts
}

#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn count(block: &Contacts, near: &Near, counts: &mut Counts) {
    let ([nx, ny, nz], [sx, sy, sz], [dx, dy, dz]) = (&block.normal, &block.surface, &block.offset);
    let (mut inliers, mut tight, mut wrong) = ([0_u32; LANES], [0_u32; LANES], [0_u32; LANES]);
    let mut plane = [0.0_f32; LANES];
    for first in (0..block.lanes()).step_by(LANES) {
        for lane in 0..LANES {
            let i = first + lane;
            let agreement = sx[i] * nx[i] + sy[i] * ny[i] + sz[i] * nz[i];
            let to_plane = sx[i] * dx[i] + sy[i] * dy[i] + sz[i] * dz[i];
            let close = block.square[i] < near.square;
            let inlier = close && (agreement > NORMAL_DOT);
            inliers[lane] += u32::from(inlier);
            tight[lane] += u32::from(inlier && (block.square[i] < near.tight));
            wrong[lane] += u32::from(close && !inlier && (agreement > -NORMAL_DOT));
            plane[lane] += if inlier { to_plane * to_plane } else { 0.0 };
        }
    }
    counts.inliers += inliers.iter().sum::<u32>();
    counts.tight += tight.iter().sum::<u32>();
    counts.wrong_normal += wrong.iter().sum::<u32>();
    counts.plane_square += plane.iter().sum::<f32>();
}
