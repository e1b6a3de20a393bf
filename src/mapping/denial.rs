//! Pairs that deny a component. Two scans of a component share much of what they see, and their surfaces lie well on each other; and yet one stands
//! in what the other saw to be empty, by far more than either does elsewhere, so that by themselves they are less sure than pairs that share as
//! much. Third scans talked them down. Where a scan is a little off, or bent, surfaces do not lie so well; and where one scan saw what is gone, it is in all such pairs. Where
//! surfaces lie well and no single scan is to blame, those third scans took alike places for one: identical rooms differ by a box on the
//! floor, and the ends of a corridor are not where its other scans see floor. Used by `undo`.

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

/// A pair as it stands in the component.
struct Seen {
    contradiction: Contradiction,
    logit: f64,
    overlap: f64,
    violation: f64,
    fits_well: bool,
}

/// The surest of the pairs that deny a component, if they show that alike places were taken for one. Pairs that a client decided about are not
/// asked.
#[must_use]
pub fn denied(graph: &ScanGraph, component: &Component, options: &MappingOptions) -> Option<Contradiction> {
    let mut seen: Vec<Seen> = Vec::new();
    for a in component.poses.keys() {
        for b in graph.neighbors(*a).filter(|b| b > a) {
            let asked = graph.edge(*a, b).filter(|edge| !options.decisions.concern(edge.pair));
            seen.extend(asked.and_then(|edge| as_it_stands(graph, component, edge)));
        }
    }
    let usual = usual(&seen);
    let shares_much = |pair: &&Seen| pair.overlap >= MUCH;
    let denies = |pair: &&Seen| {
        let scans = [pair.contradiction.pair.a, pair.contradiction.pair.b];
        let usual = scans.map(|scan| usual.get(&scan).copied());
        let [Some(x), Some(y)] = usual else { return false };
        pair.fits_well && pair.logit < DENIES && pair.violation > CONTRAST * x.max(y) + FLOOR
    };
    let mut denying: Vec<&Seen> = seen.iter().filter(shares_much).filter(denies).collect();
    denying.sort_by(|x, y| x.logit.total_cmp(&y.logit).then(x.contradiction.pair.cmp(&y.contradiction.pair)));
    let enough = denying.len() as f64 >= DENIED_SHARE * seen.iter().filter(shares_much).count() as f64;
    (enough && denying.len() >= DENIED_PAIRS && nobody_is_in_all(&denying)).then(|| denying[0].contradiction)
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
        for scan in [pair.contradiction.pair.a, pair.contradiction.pair.b] {
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

/// Whether no scan is in all of the pairs.
fn nobody_is_in_all(pairs: &[&Seen]) -> bool {
    let scans = |seen: &Seen| [seen.contradiction.pair.a, seen.contradiction.pair.b];
    let Some(first) = pairs.first() else { return true };
    scans(first).iter().all(|scan| pairs.iter().any(|pair| !scans(pair).contains(scan)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Counts, Evidence, PairKey, PairResult};

    /// A hall whose pairs say this of the pose they have, log-odds and points in free space: by default they are sure, with little in free space.
    fn hall_of(said: &[((u128, u128), f64, u32)], inliers: u32, apart_voxels: f32) -> (Model, ScanGraph) {
        let model = Model::new(6);
        let mut graph = model.graph.clone();
        let result = |a: u128, b: u128| {
            let (logit, violations) = said
                .iter()
                .find(|(pair, ..)| *pair == (a, b))
                .map_or((8.0, 2), |(_, logit, violations)| (*logit, *violations));
            let apart = apart_voxels * model.hall.resolution as f32;
            let plane_square = inliers as f32 * apart * apart;
            let counts = Counts { points: 1000, inliers, violations, plane_square, ..Counts::default() };
            let evidence =
                Evidence { b_on_a: counts, a_on_b: counts, range_images: 2, ..Evidence::default() };
            let a_from_b = model.contradiction((a, b), true).a_from_b;
            PairResult {
                pair: PairKey::of(ScanKey(a), ScanKey(b)),
                matches: Vec::new(),
                hypotheses: vec![Hypothesis { a_from_b, evidence, logit }],
            }
        };
        let pairs = (1..=6).flat_map(|a| (a + 1..=6).map(move |b| (a, b)));
        graph.add_results(pairs.map(|(a, b)| result(a, b)), &MappingOptions::default().support);
        (model, graph)
    }

    fn is_denied(said: &[((u128, u128), f64, u32)], inliers: u32, apart_voxels: f32) -> bool {
        let (model, graph) = hall_of(said, inliers, apart_voxels);
        denied(&graph, &model.component, &MappingOptions::default()).is_some()
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
        let (model, graph) = hall_of(&no, 600, 0.1);
        let options = MappingOptions::default();
        let mut moved = model.component.clone();
        assert!(denied(&graph, &moved, &options).is_some());
        for scan in [1, 3] {
            let pose = moved.poses.get_mut(&ScanKey(scan)).expect("a scan of the hall");
            *pose = Pose::from_translation(nalgebra::Vector3::x() * 30.0) * *pose;
        }
        assert_eq!(denied(&graph, &moved, &options), None);
    }
}
