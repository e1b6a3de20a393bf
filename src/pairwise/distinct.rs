//! What of the surfaces that two scans share tells their place from others. The corner of one room fits the corner of any other: three planes hold
//! a pose firmly, and say little of where it is. What coincides beyond the three largest planes says that.

use nalgebra::Vector3;

use super::contacts::{Contacts, Motion};
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

/// A point of both scans and its normal, metres, frame of a.
#[derive(Clone, Copy)]
pub(super) struct SharedPoint {
    pub point: Vector3<f32>,
    pub normal: Vector3<f32>,
}

/// What of two scans coincides at a pose (b to a, local frames).
#[must_use]
pub fn coinciding(a: &Scan, b: &Scan, a_from_b: &Pose) -> Coinciding {
    let motion = Motion::of(a_from_b);
    let (mut block, mut first, mut shared) = (Contacts::new(), 0, Vec::new());
    while let Some(next) = block.fill(a, b, &motion, first, 1) {
        first = next;
        shared_in(&block, a, &mut shared);
    }
    let looked_at = evenly(&shared, POINTS);
    let points = looked_at.len() as u32;
    let [beyond_planes] = beyond_largest_planes(looked_at, a.prepared.resolution, [PLANES]);
    Coinciding { points, beyond_planes }
}

/// Adds the points of a that those of a block coincide with, one for each of these.
pub(super) fn shared_in(block: &Contacts, a: &Scan, shared: &mut Vec<SharedPoint>) {
    let reach = NEAR_VOXELS * a.prepared.resolution as f32;
    for i in 0..block.len {
        if block.square[i] < reach * reach && block.agreement(i) > SAME_SURFACE {
            let met = &a.surfels[block.near(i)];
            shared.push(SharedPoint { point: met.position.into(), normal: met.normal.into() });
        }
    }
}

/// At most so many of them, evenly spread.
pub(super) fn evenly(shared: &[SharedPoint], most: usize) -> Vec<SharedPoint> {
    shared.iter().step_by(shared.len().div_ceil(most).max(1)).copied().collect()
}

/// How many of them lie on none of the largest planes, after so many of these (ascending) are taken away; `voxel` in metres.
pub(super) fn beyond_largest_planes<const N: usize>(
    mut left: Vec<SharedPoint>,
    voxel: f64,
    planes: [usize; N],
) -> [u32; N] {
    let thickness = THICKNESS_VOXELS * voxel as f32;
    let mut taken = 0;
    planes.map(|planes| {
        for _ in taken..planes {
            let Some(plane) = largest_plane(&left, thickness) else { break };
            left.retain(|one| !plane.holds(one));
        }
        taken = planes;
        left.len() as u32
    })
}

/// A plane of some thickness, seen from one side.
struct Plane {
    at: SharedPoint,
    /// Metres to either side.
    thickness: f32,
}

impl Plane {
    fn holds(&self, shared: &SharedPoint) -> bool {
        let SharedPoint { point, normal } = &self.at;
        normal.dot(&shared.normal) > SAME_PLANE && normal.dot(&(shared.point - point)).abs() < self.thickness
    }

    /// The same through the middle of its points, across the mean of their normals.
    fn settled(&self, shared: &[SharedPoint]) -> Self {
        let (mut point, mut normal, mut count) = (Vector3::zeros(), Vector3::zeros(), 0.0_f32);
        for one in shared.iter().filter(|one| self.holds(one)) {
            point += one.point;
            normal += one.normal;
            count += 1.0;
        }
        let at = match normal.try_normalize(f32::MIN_POSITIVE) {
            Some(normal) => SharedPoint { point: point / count, normal },
            None => self.at,
        };
        Self { at, ..*self }
    }
}

/// The plane that holds most points.
fn largest_plane(shared: &[SharedPoint], thickness: f32) -> Option<Plane> {
    let step = shared.len().div_ceil(TRIED).max(1);
    let count = |plane: &Plane| shared.iter().filter(|one| plane.holds(one)).count();
    let tried = shared.iter().step_by(step).map(|at| Plane { at: *at, thickness });
    let (mut best, mut most) = (None, 0);
    for plane in tried {
        let held = count(&plane);
        if held > most {
            (best, most) = (Some(plane), held);
        }
    }
    (0..ROUNDS).fold(best, |plane, _| plane.map(|plane| plane.settled(shared)))
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
