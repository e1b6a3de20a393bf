//! What shows of a pose at half the voxel, once it is aligned as finely. Most wrong poses that look right coarsely share walls and a floor: what
//! they have beyond large planes, how many ways their surfaces face, and how closely these meet, gives them away.

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

use super::dense::{Counts, look, look_through, share};
use super::distinct::{SharedPoints, beyond_largest_planes};
use super::icp::icp;
use crate::features::Scan;
use crate::geometry::Pose;

/// Numbers that describe it, with the log-odds that the pose has without.
pub const DETAIL_FEATURES: usize = 15;
/// Points of each scan that are looked at, at most; …
const POINTS: usize = 10_000;
/// … and points where surfaces coincide.
const SHARED_POINTS: usize = 1000;
/// After so many of the largest planes are taken away it is counted what is left.
const PLANES: [usize; SHARES] = [1, 2, 3, 5];
const SHARES: usize = 4;

/// Two scans at a pose, at half the voxel.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Detail {
    /// Points of b against a, every so many-th.
    pub b_on_a: Counts,
    /// Points of a against b, likewise.
    pub a_on_b: Counts,
    /// How many points each of those of b and of a stands for.
    pub stands_for: [u32; 2],
    /// Mean squares of the normals of a where points of b coincide with it, along the axis on which they are least and the one between: 0 and 0 for one
    /// wall, 1/3 and 1/3 where they face all ways.
    pub facing: [f32; 2],
    /// Shares of these points that lie beyond the largest plane, the two, three and five largest.
    pub beyond_planes: [f32; SHARES],
}

impl Detail {
    /// Both directions together, as many points as were looked at.
    #[must_use]
    pub fn looked_at(&self) -> Counts {
        self.b_on_a.plus(&self.a_on_b)
    }

    /// Both directions together, as of all points.
    fn of_all(&self) -> Counts {
        let [of_b, of_a] = self.stands_for.map(|points| points as usize);
        self.b_on_a.times(of_b).plus(&self.a_on_b.times(of_a))
    }

    /// The features of the regression: the log-odds without them, and what is told here. `voxel` is that of the scans, twice as long as here, in
    /// metres.
    #[must_use]
    pub fn features(&self, log_odds: f64, voxel: f64) -> [f64; DETAIL_FEATURES] {
        let both = self.of_all();
        let plane_rms =
            (f64::from(both.plane_square) / f64::from(both.inliers.max(1))).sqrt() / (voxel / 2.0);
        let [one, two, three, five] = self.beyond_planes.map(f64::from);
        [
            log_odds,
            f64::from(both.inliers).ln_1p(),
            f64::from(both.violations).ln_1p(),
            both.overlap(),
            both.violation_share(),
            self.b_on_a.violation_share().max(self.a_on_b.violation_share()),
            both.wrong_normal_share(),
            share(both.tight, both.inliers),
            plane_rms,
            f64::from(self.facing[0]),
            f64::from(self.facing[1]),
            one,
            two,
            three,
            five,
        ]
    }
}

/// Looks closely at a pose (b to a, local frames), after aligning it as finely. `None` where either scan has no finer surfaces ([`Scan::fine`]).
#[must_use]
pub fn detail(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Detail> {
    let (a, b) = (a.fine()?, b.fine()?);
    Some(between(&a, &b, &icp(&a, &b, a_from_b)))
}

/// What shows between scans at a pose, as they are.
fn between(a: &Scan, b: &Scan, a_from_b: &Pose) -> Detail {
    let stride = |scan: &Scan| scan.prepared.points.len().div_ceil(POINTS).max(1);
    let (of_a, of_b) = (stride(a), stride(b));
    let mut shared = SharedPoints::default();
    let b_on_a = look_through(a, b, a_from_b, of_b, |block| shared.extend(block, a));
    let a_on_b = look(b, a, &a_from_b.inverse(), of_a);
    let shared = shared.evenly(SHARED_POINTS);
    let facing = facing(&shared);
    let points = shared.len().max(1) as f32;
    let beyond_planes =
        beyond_largest_planes(shared, a.prepared.resolution, PLANES).map(|left| left as f32 / points);
    Detail { b_on_a, a_on_b, stands_for: [of_b, of_a].map(|stride| stride as u32), facing, beyond_planes }
}

/// See [`Detail::facing`].
fn facing(shared: &SharedPoints) -> [f32; 2] {
    let sum: Matrix3<f32> = shared.normals().map(|normal| normal * normal.transpose()).sum();
    let mut squares: [f32; 3] = (sum / sum.trace().max(1.0)).symmetric_eigenvalues().into();
    squares.sort_by(f32::total_cmp);
    [squares[0].max(0.0), squares[1].max(0.0)]
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::cloud::ScanKey;
    use crate::pairwise::test_survey::{Hall, corner, hall};

    fn close(found: &[f32], expected: &[f32]) -> bool {
        found.iter().zip(expected).all(|(x, y)| (x - y).abs() < 0.02)
    }

    #[test]
    fn a_corner_faces_three_ways_and_is_three_planes() {
        let of = |edge: Option<f32>| {
            let scan = |key| corner(ScanKey(key), edge);
            between(&scan(1), &scan(2), &Pose::identity())
        };
        let bare = of(None);
        assert_eq!(bare.b_on_a, bare.a_on_b);
        assert!(bare.looked_at().overlap() > 0.95, "all but where the walls meet: {bare:?}");
        let third = 1.0 / 3.0;
        assert!(close(&bare.facing, &[third, third]), "{bare:?}");
        assert!(close(&bare.beyond_planes, &[2.0 * third, third, 0.0, 0.0]), "{bare:?}");
        // A box with edges of 2 m has a quarter of each wall's area on each side.
        let furnished = of(Some(2.0));
        assert!(
            close(&furnished.beyond_planes, &[11.0 / 15.0, 7.0 / 15.0, 0.2, 1.0 / 15.0]),
            "{furnished:?}"
        );
    }

    #[test]
    fn surfaces_along_one_wall_face_one_way_and_what_is_apart_none() {
        let (a, b) = (corner(ScanKey(1), None), corner(ScanKey(2), None));
        // The other room's corner lies 3 m along two walls and is turned by half about the third, so that little but that coincides.
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI);
        let along = between(&a, &b, &Pose::new(turn, Vector3::new(6.0, 6.0, 0.0)));
        assert!(close(&along.facing, &[0.0, 0.0]) && close(&along.beyond_planes, &[0.0; 4]), "{along:?}");
        assert!(along.looked_at().inliers > 100, "{along:?}");
        let apart = between(&a, &b, &Pose::from_translation(Vector3::new(9.0, 9.0, 9.0)));
        let points = apart.looked_at().points;
        let nothing = Counts { points, ..Counts::default() };
        assert_eq!((apart.looked_at(), apart.facing, apart.beyond_planes), (nothing, [0.0; 2], [0.0; 4]));
        assert!(apart.features(0.5, 0.1).iter().all(|x| x.is_finite()));
    }

    #[test]
    fn it_is_seen_after_alignment_at_half_the_voxel_and_not_without_finer_surfaces() {
        let Hall { scans, resolution, .. } = hall(3);
        let ((a, model_from_a), (b, model_from_b)) = (&scans[0], &scans[1]);
        let truth = model_from_a.inverse() * *model_from_b;
        let exact = detail(a, b, &truth).expect("the scans are fine enough");
        let [fine_a, fine_b] = [a, b].map(|scan| scan.fine().expect("the scans are fine enough"));
        let [of_b, of_a] = exact.stands_for;
        for (counts, stands_for, scan) in [(exact.a_on_b, of_a, fine_a), (exact.b_on_a, of_b, fine_b)] {
            let all = scan.prepared.points.len();
            assert!(counts.points as usize <= POINTS && all > POINTS, "{} of {all}", counts.points);
            assert_eq!(counts.points, (all as u32).div_ceil(stands_for));
        }
        let nudged = Pose::from_translation(Vector3::new(0.3 * resolution, 0.0, 0.0)) * truth;
        let aligned = detail(a, b, &nudged).expect("the scans are fine enough");
        let [straight, back] = [exact, aligned].map(|seen| seen.features(0.0, resolution)[8]);
        assert!((straight - back).abs() < 0.05 * straight, "{straight} and {back} of a voxel");
        let mut coarse = a.prepared.clone();
        coarse.fine = None;
        assert_eq!(detail(&Scan::new(coarse), b, &truth), None);
    }
}
