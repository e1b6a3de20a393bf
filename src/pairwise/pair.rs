//! One pair of scans from descriptors to verified hypotheses: the pure function that the scan graph is made of.

use serde::{Deserialize, Serialize};

use super::appearance::appearance;
use super::consensus::{INLIER_VOXELS, agreement, centred_difference};
use super::dense::look;
use super::gravity::is_upright;
use super::icp::icp;
use super::matching::mutual_matches;
use super::second_look::contest;
use super::shortlist::shortlist;
use super::verifier::{Evidence, Verifier};
use crate::cloud::ScanKey;
use crate::features::Scan;
use crate::geometry::Pose;

/// Matches of a pair, at most.
const MAX_MATCHES: usize = 800;
/// Poses that are refined and verified, the most promising at a glance.
const REFINED: usize = 6;
/// Refined poses closer than this (rad, voxels) are one hypothesis.
const SAME_ANGLE: f64 = 0.085;
const SAME_VOXELS: f64 = 2.5;

/// An unordered pair of scans: `a < b`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct PairKey {
    /// The smaller key.
    pub a: ScanKey,
    /// The larger key.
    pub b: ScanKey,
}

impl PairKey {
    /// The pair of two different scans, in either order.
    #[must_use]
    pub fn of(x: ScanKey, y: ScanKey) -> Self {
        Self { a: x.min(y), b: x.max(y) }
    }
}

/// One pose of a pair with the evidence for it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Hypothesis {
    /// Maps scan b into scan a (local frames).
    pub a_from_b: Pose,
    /// What was counted.
    pub evidence: Evidence,
    /// Log-odds that the pose is right, from the pair alone: of the verifier, less what a second look takes.
    pub logit: f64,
}

/// Matches and verified hypotheses of one pair: a pure function of two prepared scans and a verifier.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairResult {
    /// Which pair.
    pub pair: PairKey,
    /// Keypoint numbers (in a, in b) that are mutual nearest neighbours, clearest first.
    pub matches: Vec<(u16, u16)>,
    /// Different poses, the likeliest first; the right one is often not the first.
    pub hypotheses: Vec<Hypothesis>,
}

/// Matches and verifies one pair. `x` and `y` may come in either order and must be different scans at one resolution.
#[must_use]
pub fn match_pair(x: &Scan, y: &Scan, verifier: &Verifier) -> PairResult {
    let (a, b) = if x.key() < y.key() { (x, y) } else { (y, x) };
    let pair = PairKey { a: a.key(), b: b.key() };
    let matches = mutual_matches(&a.prepared, &b.prepared, MAX_MATCHES);
    let mut hypotheses: Vec<Hypothesis> = Vec::with_capacity(REFINED);
    for candidate in shortlist(a, b, &matches, REFINED) {
        let a_from_b = icp(a, b, &candidate.a_from_b);
        let known = hypotheses.iter().any(|h| {
            let (angle, distance) = centred_difference(&h.a_from_b, &a_from_b, &b.centroid);
            angle < SAME_ANGLE && distance < SAME_VOXELS * a.prepared.resolution
        });
        if known || !is_upright(a, b, &a_from_b) {
            continue;
        }
        let agreeing = agreement(a, b, &matches, &a_from_b);
        let evidence = Evidence {
            b_on_a: look(a, b, &a_from_b, 1),
            a_on_b: look(b, a, &a_from_b.inverse(), 1),
            consensus: agreeing.score.max(candidate.score) as f32,
            match_inliers: agreeing.inliers as u32,
            matches: matches.len() as u32,
            range_images: [a, b].iter().filter(|scan| scan.prepared.range_image.is_some()).count() as u32,
            appearance: appearance(a, b, &a_from_b),
        };
        let logit = verifier.pair_logit(&evidence, a.prepared.resolution);
        hypotheses.push(Hypothesis { a_from_b, evidence, logit });
    }
    contest(a, b, &mut hypotheses);
    hypotheses.sort_by(|x, y| y.logit.total_cmp(&x.logit));
    PairResult { pair, matches: matches.iter().map(|m| (m.a, m.b)).collect(), hypotheses }
}

/// The matches that agree with a pose, in the order given.
pub fn inlier_matches<'m>(
    a: &Scan,
    b: &Scan,
    matches: &'m [(u16, u16)],
    a_from_b: &Pose,
) -> impl Iterator<Item = (u16, u16)> + 'm {
    let tolerance = INLIER_VOXELS * a.prepared.resolution;
    let keep: Vec<bool> = matches
        .iter()
        .map(|&(in_a, in_b)| {
            let residual = a_from_b.transform(&b.keypoint(in_b as usize)) - a.keypoint(in_a as usize);
            residual.norm_squared() < tolerance * tolerance
        })
        .collect();
    matches.iter().zip(keep).filter_map(|(m, keep)| keep.then_some(*m))
}
