//! One pair of scans from descriptors to verified hypotheses: the pure function that the scan graph is made of.

use serde::{Deserialize, Serialize};

use super::consensus::{Consensus, ConsensusOptions, INLIER_VOXELS, centred_difference, consensus};
use super::dense::{look, quick_overlap};
use super::icp::icp;
use super::matching::mutual_matches;
use super::verifier::{Evidence, Verifier};
use crate::cloud::ScanKey;
use crate::features::Scan;
use crate::geometry::Pose;

/// Matches of a pair, at most.
const MAX_MATCHES: usize = 800;
/// Hypotheses that are refined and verified, the best by a quick dense look.
const REFINED: usize = 6;
const QUICK_STRIDE: usize = 4;

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
    /// Log-odds that the pose is right, from the pair alone.
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
    let options = ConsensusOptions::default();
    let mut ranked: Vec<(usize, Consensus)> = consensus(a, b, &matches, &options)
        .into_iter()
        .map(|candidate| (quick_overlap(a, b, &candidate.a_from_b, QUICK_STRIDE), candidate))
        .collect();
    ranked.sort_by(|x, y| y.0.cmp(&x.0).then(y.1.score.total_cmp(&x.1.score)));
    ranked.truncate(REFINED);
    let matches: Vec<(u16, u16)> = matches.iter().map(|m| (m.a, m.b)).collect();
    let mut hypotheses: Vec<Hypothesis> = Vec::with_capacity(ranked.len());
    for (_, candidate) in ranked {
        let a_from_b = icp(a, b, &candidate.a_from_b);
        let known = hypotheses.iter().any(|h| {
            let (angle, distance) = centred_difference(&h.a_from_b, &a_from_b, &b.centroid);
            angle < 0.5 * options.same_angle && distance < 0.5 * options.same_voxels * a.prepared.resolution
        });
        if known {
            continue;
        }
        let evidence = Evidence {
            b_on_a: look(a, b, &a_from_b, 1),
            a_on_b: look(b, a, &a_from_b.inverse(), 1),
            consensus: candidate.score as f32,
            match_inliers: inlier_matches(a, b, &matches, &a_from_b).count() as u32,
            matches: matches.len() as u32,
            range_images: [a, b].iter().filter(|scan| scan.prepared.range_image.is_some()).count() as u32,
        };
        let logit = verifier.pair.logit(&evidence.features(a.prepared.resolution));
        hypotheses.push(Hypothesis { a_from_b, evidence, logit });
    }
    hypotheses.sort_by(|x, y| y.logit.total_cmp(&x.logit));
    PairResult { pair, matches, hypotheses }
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
