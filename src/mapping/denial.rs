//! Pairs that deny a component. Two scans of a component share much of what they see, and their surfaces lie well on each other; and yet one stands
//! in what the other saw to be empty, by far more than either does elsewhere, so that by themselves they are less sure than pairs that share as
//! much. Third scans talked them down. Where a scan is a little off, or bent, surfaces do not lie so well; and where one scan saw what is gone, it is in all such pairs. Where
//! surfaces lie well and no single scan is to blame, those third scans took alike places for one: identical rooms differ by a box on the
//! floor, and the ends of a corridor are not where its other scans see floor. Used by `finding` and `testimony`.

use std::collections::BTreeMap;

use super::component::Component;
use super::options::MappingOptions;
use super::testimony::Contradiction;
use crate::cloud::ScanKey;
use crate::graph::{Edge, ScanGraph};
use crate::pairwise::{Hypothesis, centred_difference};

/// A pair denies its pose when its own log-odds for it are below this, without the word of third scans: where so much coincides they are higher, …
const DENIES: f64 = 6.0;
/// … although this share of its points coincides: with less, log-odds are low because there is little to see.
const MUCH: f64 = 0.32;
/// What it looked at is where its scans are, within this angle …
const SAME_ANGLE: f64 = 2.0 * std::f64::consts::PI / 180.0;
/// … and so many voxels, …
const SAME_VOXELS: f64 = 3.0;
/// … and where surfaces meet, their distance is below this, root mean square, in voxels, …
const MOST_APART: f64 = 0.4;
/// … and below the share that coincides by this factor. Of scans that are bent it is more; and what a moving sensor saw around corners stands in
/// the free space of others, but they share little.
const TIGHT: f64 = 1.6;
/// It lies in free space by this many times the share that is usual for either scan …
const CONTRAST: f64 = 4.0;
/// … and this share more.
const FLOOR: f64 = 0.006;
/// A pair with log-odds above this shows what is usual for its scans.
const SURE: f64 = 2.0;
/// Sure pairs that a scan must have for anything to be usual.
const LEAST_SURE: usize = 3;
/// The share of a scan's sure pairs that show less than what is usual: in identical rooms most of its pairs may be wrong.
const USUAL: f64 = 0.25;
/// Alike places were taken for one when so many pairs deny it, without a scan that is in all of them, …
const DENIED_PAIRS: usize = 3;
/// … and of all pairs that share as much, this share does. Of scans that are where they belong hardly any pair does.
const DENIED_SHARE: f64 = 0.01;
/// Where this share of all pairs shares much, as all do in rooms that were folded onto each other, one pair is enough: what has changed there would
/// be seen by many. …
const CROWDED: f64 = 0.5;
/// … Or so many that are not by themselves enough, …
const CROWDED_PAIRS: usize = 2;
/// … of which each scan shares much with so many others, …
const LEAST_SHARING: usize = 6;
/// … and denies less than this share of them, as it would if it were to blame. …
const BLAMED_SHARE: f64 = 0.25;
/// … One that is enough lies in free space by this many times what is usual …
const STRONG_CONTRAST: f64 = 8.0;
/// … and this share more. Of seven identical rooms, the ends of whose corridor only one pair sees, it puts 1.9 % there; in halls of which half the
/// furniture was moved, no pair denies anything.
const STRONG_FLOOR: f64 = 0.012;

/// A pair as it stands in the component.
#[derive(Debug, Clone, Copy)]
struct Seen {
    contradiction: Contradiction,
    logit: f64,
    overlap: f64,
    violation: f64,
    fits_well: bool,
}

impl Seen {
    fn scans(&self) -> [ScanKey; 2] {
        [self.contradiction.pair.a, self.contradiction.pair.b]
    }

    fn shares_much(&self) -> bool {
        self.overlap >= MUCH
    }
}

/// A pair that denies a component.
#[derive(Debug, Clone, Copy)]
struct Denial {
    seen: Seen,
    /// By far more than what is usual.
    strong: bool,
}

/// What pairs deny of a component.
#[derive(Debug, Clone)]
pub struct Denials {
    /// The surest first.
    denying: Vec<Denial>,
    /// With how many others each scan shares much.
    sharing: BTreeMap<ScanKey, usize>,
    scans: usize,
}

impl Denials {
    /// Asks all pairs of a component, but for those that a client decided about.
    #[must_use]
    pub fn of(graph: &ScanGraph, component: &Component, options: &MappingOptions) -> Self {
        let mut seen: Vec<Seen> = Vec::new();
        for a in component.poses.keys() {
            for b in graph.neighbors(*a).filter(|b| b > a) {
                let asked = graph.edge(*a, b).filter(|edge| !options.decisions.concern(edge.pair));
                seen.extend(asked.and_then(|edge| as_it_stands(graph, component, edge)));
            }
        }
        let usual = usual(&seen);
        seen.retain(Seen::shares_much);
        let mut sharing = BTreeMap::new();
        for scan in seen.iter().flat_map(Seen::scans) {
            *sharing.entry(scan).or_default() += 1;
        }
        let denial = |seen: &Seen| {
            let [Some(x), Some(y)] = seen.scans().map(|scan| usual.get(&scan).copied()) else { return None };
            let usual = x.max(y);
            let denies = seen.fits_well && seen.logit < DENIES && seen.violation > CONTRAST * usual + FLOOR;
            let strong = seen.violation > STRONG_CONTRAST * usual + STRONG_FLOOR;
            denies.then_some(Denial { seen: *seen, strong })
        };
        let mut denying: Vec<Denial> = seen.iter().filter_map(denial).collect();
        denying.sort_by(|x, y| {
            let by_pair = x.seen.contradiction.pair.cmp(&y.seen.contradiction.pair);
            x.seen.logit.total_cmp(&y.seen.logit).then(by_pair)
        });
        Self { denying, sharing, scans: component.len() }
    }

    /// Whether no pair denies anything, although every scan shares much with another that could.
    #[must_use]
    pub fn nobody_denies(&self) -> bool {
        self.denying.is_empty() && self.sharing.len() == self.scans
    }

    /// The surest of the pairs that show that alike places were taken for one, if any do.
    #[must_use]
    pub fn shown(&self) -> Option<Contradiction> {
        let pairs_that_share = self.sharing.values().sum::<usize>() / 2;
        let several = self.denying.len() >= DENIED_PAIRS
            && self.denying.len() as f64 >= DENIED_SHARE * pairs_that_share as f64
            && self.nobody_is_in_all();
        let first = self.denying.first().filter(|_| several);
        let crowded =
            pairs_that_share as f64 >= CROWDED * (self.scans * self.scans.saturating_sub(1) / 2) as f64;
        first
            .or_else(|| self.outstanding(pairs_that_share).filter(|_| crowded))
            .map(|denial| denial.seen.contradiction)
    }

    /// Whether no scan is in all of the pairs.
    fn nobody_is_in_all(&self) -> bool {
        let in_all = |scan: ScanKey| self.denying.iter().all(|denial| denial.seen.scans().contains(&scan));
        self.denying.first().is_none_or(|first| !first.seen.scans().into_iter().any(in_all))
    }

    /// Where all see the same place: a pair that is enough by itself, or the surest of several, of scans that are not to blame.
    fn outstanding(&self, pairs_that_share: usize) -> Option<&Denial> {
        let stands_out = |scan: ScanKey| {
            let sharing = self.sharing.get(&scan).copied().unwrap_or_default();
            let denied = self.denying.iter().filter(|other| other.seen.scans().contains(&scan)).count();
            sharing >= LEAST_SHARING && (denied as f64) < BLAMED_SHARE * sharing as f64
        };
        let blameless = self.denying.iter().filter(|denial| denial.seen.scans().into_iter().all(stands_out));
        let found: Vec<&Denial> = blameless.collect();
        let several =
            found.len() >= CROWDED_PAIRS && found.len() as f64 >= DENIED_SHARE * pairs_that_share as f64;
        found.iter().find(|denial| denial.strong || several).copied()
    }
}

/// What a pair found of the pose that it has in the component. `None` if it did not look at that pose, or not at free space.
fn as_it_stands(graph: &ScanGraph, component: &Component, edge: &Edge) -> Option<Seen> {
    let (model_from_a, model_from_b) =
        (component.poses.get(&edge.pair.a)?, component.poses.get(&edge.pair.b)?);
    let b = graph.scan(edge.pair.b)?;
    let now = model_from_a.inverse() * *model_from_b;
    let voxel = b.prepared.resolution;
    let near = |h: &Hypothesis| {
        let (angle, distance) = centred_difference(&h.a_from_b, &now, &b.centroid);
        angle < SAME_ANGLE && distance < SAME_VOXELS * voxel
    };
    let found = edge.hypotheses.iter().map(|h| &h.hypothesis).filter(|h| near(h));
    let best = found.max_by(|x, y| x.logit.total_cmp(&y.logit)).filter(|h| h.evidence.range_images > 0)?;
    let counts = best.evidence.both();
    let apart = (f64::from(counts.plane_square) / f64::from(counts.inliers.max(1))).sqrt();
    Some(Seen {
        contradiction: Contradiction::of_pose(edge.pair, now),
        logit: best.logit,
        overlap: counts.overlap(),
        violation: counts.violation_share(),
        fits_well: apart < MOST_APART.min(counts.overlap() / TIGHT) * voxel,
    })
}

/// By scan, the share of judged points in free space that is usual for it, by its sure pairs.
fn usual(seen: &[Seen]) -> BTreeMap<ScanKey, f64> {
    let mut shares: BTreeMap<ScanKey, Vec<f64>> = BTreeMap::new();
    for pair in seen.iter().filter(|pair| pair.logit > SURE) {
        for scan in pair.scans() {
            shares.entry(scan).or_default().push(pair.violation);
        }
    }
    shares.retain(|_, shares| shares.len() >= LEAST_SURE);
    let usual = |mut shares: Vec<f64>| {
        shares.sort_by(f64::total_cmp);
        shares[(shares.len() as f64 * USUAL) as usize]
    };
    shares.into_iter().map(|(scan, shares)| (scan, usual(shares))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::mapping::test_hall::Model;

    fn is_denied(said: &[((u128, u128), f64, u32)], inliers: u32, apart_voxels: f32) -> bool {
        is_denied_by(6, said, inliers, apart_voxels)
    }

    fn is_denied_by(
        stations: usize,
        said: &[((u128, u128), f64, u32)],
        inliers: u32,
        apart_voxels: f32,
    ) -> bool {
        let model = Model::new(stations);
        let graph = model.graph_where(said, inliers, apart_voxels);
        Denials::of(&graph, &model.component, &MappingOptions::default()).shown().is_some()
    }

    #[test]
    fn where_all_see_the_same_place_one_pair_is_enough_unless_one_of_its_scans_is_off() {
        let no = |pair, violations| (pair, -3.0, violations);
        assert!(is_denied_by(8, &[no((1, 2), 40)], 600, 0.1));
        assert!(!is_denied_by(8, &[no((1, 2), 16)], 600, 0.1), "that may be chance");
        assert!(is_denied_by(8, &[no((1, 2), 16), no((3, 4), 16)], 600, 0.1), "twice it is none");
        assert!(!is_denied_by(8, &[no((1, 2), 16), no((1, 3), 16)], 600, 0.1), "scan 1 is off");
        assert!(!is_denied_by(8, &[no((1, 2), 40), no((1, 3), 40)], 600, 0.1), "scan 1 is off");
        assert!(!is_denied_by(6, &[no((1, 2), 40)], 600, 0.1), "few would see what has changed");
    }

    #[test]
    fn pairs_of_different_scans_deny_a_component_and_one_scan_that_is_off_does_not() {
        let no = |pair| (pair, -3.0, 40);
        assert!(!is_denied(&[], 600, 0.1));
        assert!(is_denied(&[no((1, 2)), no((3, 4)), no((5, 6))], 600, 0.1));
        assert!(is_denied(&[no((1, 2)), no((2, 3)), no((1, 3))], 600, 0.1), "either of three may be off");
        assert!(!is_denied(&[no((1, 2)), no((1, 3)), no((1, 4))], 600, 0.1), "scan 1 is off");
        assert!(!is_denied(&[no((1, 2)), no((3, 4))], 600, 0.1), "two pairs may err");
    }

    #[test]
    fn who_sees_little_or_nothing_in_free_space_denies_nothing() {
        let all =
            |logit: f64, violations: u32| [(1, 2), (3, 4), (5, 6)].map(|pair| (pair, logit, violations));
        assert!(!is_denied(&all(-3.0, 8), 600, 0.1), "that is usual");
        assert!(!is_denied(&all(7.0, 40), 600, 0.1), "they are sure all the same");
        let no = all(-3.0, 40);
        assert!(is_denied(&no, 600, 0.1));
        assert!(!is_denied(&no, 200, 0.1), "they share little");
        assert!(!is_denied(&no, 600, 0.6), "they are bent");
        assert!(!is_denied(&all(-3.0, 40), 360, 0.3), "they share too little for how well they fit");
    }

    #[test]
    fn a_pose_that_a_pair_did_not_look_at_is_not_denied() {
        let no = [(1, 2), (3, 4), (5, 6)].map(|pair| (pair, -3.0, 40));
        let model = Model::new(6);
        let graph = model.graph_where(&no, 600, 0.1);
        let options = MappingOptions::default();
        let mut moved = model.component.clone();
        assert!(Denials::of(&graph, &moved, &options).shown().is_some());
        for scan in [1, 3] {
            let pose = moved.poses.get_mut(&ScanKey(scan)).expect("a scan of the hall");
            *pose = Pose::from_translation(nalgebra::Vector3::x() * 30.0) * *pose;
        }
        assert_eq!(Denials::of(&graph, &moved, &options).shown(), None);
        // Nobody denies what nobody looked at; that says nothing.
        let sound = model.graph_where(&[], 600, 0.1);
        assert!(Denials::of(&sound, &model.component, &options).nobody_denies());
        let mut lone = model.component.clone();
        lone.poses.insert(ScanKey(1), moved.poses[&ScanKey(1)]);
        assert!(!Denials::of(&sound, &lone, &options).nobody_denies());
    }
}
