//! What of the surfaces that two scans share tells their place from others. The corner of one room fits the corner of any other: three planes hold
//! a pose firmly, and say little of where it is. What coincides beyond the three largest planes says that.

use multiversion::multiversion;
use nalgebra::Vector3;

use super::contacts::{Contacts, Motion, meet};
use crate::features::Scan;
use crate::geometry::Pose;

/// A point with a point of the other scan this near, in voxels, coincides with it …
const NEAR_VOXELS: f32 = 1.5;
/// … if the cosine of their normals is more.
const SAME_SURFACE: f32 = 0.85;
/// Points this near a plane, in voxels, belong to it …
const THICKNESS_VOXELS: f32 = 1.5;
/// … if the cosine of their normals is more.
const SAME_PLANE: f32 = 0.9;
/// Planes that are taken away.
const PLANES: usize = 3;
/// Points that are looked at, at most, and points whose planes are tried for each that is taken away: evenly spread.
const POINTS: usize = 2000;
const TRIED: usize = 60;
/// Times that a plane is laid through the middle of its points anew.
const ROUNDS: usize = 2;

/// Points of two scans that coincide at a pose, of those that were looked at.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Coinciding {
    /// All of them.
    pub points: u32,
    /// Those that lie on none of the three planes that hold most of them.
    pub beyond_planes: u32,
}

impl Coinciding {
    /// Both sets of points together.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self { points: self.points + other.points, beyond_planes: self.beyond_planes + other.beyond_planes }
    }

    /// Share of the points that lie beyond the three largest planes; 0 without points.
    #[must_use]
    pub fn share(&self) -> f64 {
        f64::from(self.beyond_planes) / f64::from(self.points.max(1))
    }
}

/// Points of both scans, metres, and their normals, frame of a: one array a coordinate, so that planes are tried on many at once.
#[derive(Default)]
pub(super) struct SharedPoints {
    point: [Vec<f32>; 3],
    normal: [Vec<f32>; 3],
}

impl SharedPoints {
    pub(super) fn len(&self) -> usize {
        self.normal[0].len()
    }

    fn at(&self, index: usize) -> (Vector3<f32>, Vector3<f32>) {
        let of = |axes: &[Vec<f32>; 3]| Vector3::from_fn(|k, _| axes[k][index]);
        (of(&self.point), of(&self.normal))
    }

    fn push(&mut self, point: [f32; 3], normal: [f32; 3]) {
        for k in 0..3 {
            self.point[k].push(point[k]);
            self.normal[k].push(normal[k]);
        }
    }

    /// Adds the points of a that those of a block coincide with, one for each of these.
    pub(super) fn extend(&mut self, block: &Contacts, a: &Scan) {
        let reach = NEAR_VOXELS * a.prepared.resolution as f32;
        for i in 0..block.len {
            if block.square[i] < reach * reach && block.agreement(i) > SAME_SURFACE {
                let met = &a.surfels[block.near(i)];
                self.push(met.position, met.normal);
            }
        }
    }

    /// At most so many of them, evenly spread.
    #[must_use]
    pub(super) fn evenly(&self, most: usize) -> Self {
        let step = self.len().div_ceil(most).max(1);
        let of =
            |axes: &[Vec<f32>; 3]| axes.each_ref().map(|axis| axis.iter().step_by(step).copied().collect());
        Self { point: of(&self.point), normal: of(&self.normal) }
    }

    pub(super) fn normals(&self) -> impl Iterator<Item = Vector3<f32>> + '_ {
        (0..self.len()).map(|index| self.at(index).1)
    }

    fn keep(&mut self, kept: &[bool]) {
        for axis in self.point.iter_mut().chain(&mut self.normal) {
            let mut of_each = kept.iter();
            axis.retain(|_| of_each.next().is_some_and(|kept| *kept));
        }
    }
}

/// What of two scans coincides at a pose (b to a, local frames).
#[must_use]
pub fn coinciding(a: &Scan, b: &Scan, a_from_b: &Pose) -> Coinciding {
    let motion = Motion::of(a_from_b);
    let mut shared = SharedPoints::default();
    meet(a, b, &motion, (0, 1), |block, _| shared.extend(block, a));
    let looked_at = shared.evenly(POINTS);
    let points = looked_at.len() as u32;
    let [beyond_planes] = beyond_largest_planes(looked_at, a.prepared.resolution, [PLANES]);
    Coinciding { points, beyond_planes }
}

/// How many of them lie on none of the largest planes, after so many of these (ascending) are taken away; `voxel` in metres.
pub(super) fn beyond_largest_planes<const N: usize>(
    mut left: SharedPoints,
    voxel: f64,
    planes: [usize; N],
) -> [u32; N] {
    let thickness = THICKNESS_VOXELS * voxel as f32;
    let (mut taken, mut held) = (0, Vec::new());
    planes.map(|planes| {
        for _ in taken..planes {
            let Some(plane) = largest_plane(&left, thickness, &mut held) else { break };
            hold(&plane, &left, &mut held);
            for held in &mut held {
                *held = !*held;
            }
            left.keep(&held);
        }
        taken = planes;
        left.len() as u32
    })
}

/// A plane of some thickness, seen from one side.
#[derive(Clone, Copy)]
struct Plane {
    /// A point of it, metres.
    point: Vector3<f32>,
    normal: Vector3<f32>,
    /// Metres to either side.
    thickness: f32,
}

impl Plane {
    /// The same through the middle of the points that it holds, across the mean of their normals.
    fn settled(&self, shared: &SharedPoints, held: &[bool]) -> Self {
        let (mut point, mut normal, mut count) = (Vector3::zeros(), Vector3::zeros(), 0.0_f32);
        for index in (0..shared.len()).filter(|index| held[*index]) {
            let (at, facing) = shared.at(index);
            point += at;
            normal += facing;
            count += 1.0;
        }
        match normal.try_normalize(f32::MIN_POSITIVE) {
            Some(normal) => Self { point: point / count, normal, ..*self },
            None => *self,
        }
    }
}

/// Which points a plane holds; gives their number.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512bw+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn hold(plane: &Plane, shared: &SharedPoints, held: &mut Vec<bool>) -> u32 {
    held.clear();
    held.resize(shared.len(), false);
    let n = held.len();
    let [x, y, z] = shared.point.each_ref().map(|axis| &axis[..n]);
    let [nx, ny, nz] = shared.normal.each_ref().map(|axis| &axis[..n]);
    let Plane { point, normal, thickness } = *plane;
    let mut count = 0;
    for i in 0..n {
        let agreement = normal.x * nx[i] + normal.y * ny[i] + normal.z * nz[i];
        let apart = normal.x * (x[i] - point.x) + normal.y * (y[i] - point.y) + normal.z * (z[i] - point.z);
        held[i] = (agreement > SAME_PLANE) & (apart.abs() < thickness);
        count += u32::from(held[i]);
    }
    count
}

/// The plane that holds most points. `held` is for the work.
fn largest_plane(shared: &SharedPoints, thickness: f32, held: &mut Vec<bool>) -> Option<Plane> {
    let step = shared.len().div_ceil(TRIED).max(1);
    let (mut best, mut most) = (None, 0);
    for index in (0..shared.len()).step_by(step) {
        let (point, normal) = shared.at(index);
        let plane = Plane { point, normal, thickness };
        let count = hold(&plane, shared, held);
        if count > most {
            (best, most) = (Some(plane), count);
        }
    }
    (0..ROUNDS).fold(best, |plane, _| {
        let plane = plane?;
        hold(&plane, shared, held);
        Some(plane.settled(shared, held))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::ScanKey;
    use crate::pairwise::test_survey;

    fn corner(edge: Option<f32>) -> Scan {
        test_survey::corner(ScanKey(1), edge)
    }

    #[test]
    fn a_corner_is_three_planes_and_what_stands_in_it_is_not() {
        let empty = coinciding(&corner(None), &corner(None), &Pose::identity());
        assert!(empty.points > 1000, "{empty:?}");
        assert!(empty.share() < 0.01, "only where the planes meet is a normal not quite clear: {empty:?}");
        let furnished = coinciding(&corner(Some(1.0)), &corner(Some(1.0)), &Pose::identity());
        let expected = 3.0 / (3.0 + 48.0);
        assert!((furnished.share() - expected).abs() < 0.01, "{furnished:?}");
        // What only one of them sees does not coincide.
        let either = coinciding(&corner(None), &corner(Some(1.0)), &Pose::identity());
        assert!(either.share() < 0.01, "{either:?}");
    }

    #[test]
    fn what_is_apart_does_not_coincide() {
        let away = Pose::from_translation(Vector3::new(9.0, 9.0, 9.0));
        let none = coinciding(&corner(None), &corner(None), &away);
        assert_eq!(none, Coinciding::default());
        assert_eq!(none.share(), 0.0);
    }
}
