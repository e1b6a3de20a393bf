//! Which hypotheses are right, which are wrong, and which of them nobody should learn from.

use serde::{Deserialize, Serialize};

use super::scene::MatchedPair;
use crate::features::Scan;
use crate::geometry::Pose;
use crate::pairwise::{Evidence, PairResult, centred_difference, icp, inlier_matches, look};

/// A hypothesis is right within this angle (rad) and distance (voxels, at the moved scan's centroid) of the truth: what the scan
/// graph takes for the same motion, and what refinement still pulls into place. Truth of real scans errs by a third of it.
const RIGHT: (f64, f64) = (8.0 * std::f64::consts::PI / 180.0, 4.0);
/// Beyond one of these it is wrong; between, a map may or may not be built on it.
const WRONG: (f64, f64) = (15.0 * std::f64::consts::PI / 180.0, 7.5);
/// Scans overlap if under the truth this share of one lies on the surface of the other.
pub(super) const LEAST_OVERLAP: f64 = 0.05;
/// A wrong hypothesis is a lookalike if in every respect at least this share of the scene's right poses looks no better.
const WORSE_TRUTHS: f64 = 0.25;
/// Fewer truths than this say nothing about what right poses look like.
const ENOUGH_TRUTHS: usize = 8;

/// What the truth says of a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Label {
    /// Near the truth, and the scans overlap.
    Right,
    /// Far from the truth.
    Wrong,
    /// Nothing to learn from.
    LeftOut(LeftOut),
}

/// Why nothing is learned from a hypothesis.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum LeftOut {
    /// Neither near the truth nor far from it.
    Borderline,
    /// Wrong, but all that can be counted is as for right poses, as in identical rooms.
    Lookalike,
    /// Near the truth by chance: the scans share nothing that could show it.
    NoOverlap,
}

/// What is known of a pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum TruePair {
    /// The true `a_from_b`, local frames.
    Placed(Pose),
    /// They are of different places.
    Apart,
}

/// A labelled pair and what its true pose looks like.
pub(super) struct Labelled {
    pub pair: MatchedPair,
    /// Of an overlapping pair.
    truth: Option<Evidence>,
}

/// Labels each hypothesis of a pair; `a` is the scan with the smaller key.
pub(super) fn label(a: &Scan, b: &Scan, result: PairResult, truth: &TruePair) -> Labelled {
    let TruePair::Placed(a_from_b) = truth else {
        let labels = vec![Label::Wrong; result.hypotheses.len()];
        return Labelled { pair: MatchedPair { result, labels, overlap: 0.0 }, truth: None };
    };
    let voxel = a.prepared.resolution;
    let within = |x: &Pose, (angle, voxels): (f64, f64)| {
        let difference = centred_difference(a_from_b, x, &b.centroid);
        difference.0 < angle && difference.1 < voxels * voxel
    };
    // The truth of real scans is off by more than the surfaces of a right hypothesis are.
    let refined = icp(a, b, a_from_b);
    let true_pose = if within(&refined, RIGHT) { refined } else { *a_from_b };
    let (b_on_a, a_on_b) = (look(a, b, &true_pose, 1), look(b, a, &true_pose.inverse(), 1));
    let overlap = b_on_a.overlap().max(a_on_b.overlap());
    let overlaps = overlap >= LEAST_OVERLAP;
    let labels = result
        .hypotheses
        .iter()
        .map(|hypothesis| {
            if !within(&hypothesis.a_from_b, WRONG) {
                Label::Wrong
            } else if !within(&hypothesis.a_from_b, RIGHT) {
                Label::LeftOut(LeftOut::Borderline)
            } else if overlaps {
                Label::Right
            } else {
                Label::LeftOut(LeftOut::NoOverlap)
            }
        })
        .collect();
    let match_inliers = inlier_matches(a, b, &result.matches, &true_pose).count() as u32;
    let truth = overlaps.then(|| Evidence {
        b_on_a,
        a_on_b,
        match_inliers,
        matches: result.matches.len() as u32,
        ..Evidence::default()
    });
    Labelled { pair: MatchedPair { result, labels, overlap }, truth }
}

/// In how many ways evidence is compared.
const RESPECTS: usize = 6;

/// By so much evidence may be worse than a right pose's and still look like it.
const SLACK: [f64; RESPECTS] = [0.1, 0.005, 0.02, 0.03, 0.05, 0.2];

/// Evidence as numbers, each larger the likelier a pose is right; where only ratios tell, as logarithms.
fn respects(evidence: &Evidence, voxel: f64) -> [f64; RESPECTS] {
    let both = evidence.both();
    let inliers = f64::from(both.inliers.max(1));
    [
        both.overlap().max(1e-3).ln(),
        -both.violation_share(),
        -f64::from(both.wrong_normal) / (f64::from(both.wrong_normal) + inliers),
        f64::from(both.tight) / inliers,
        -f64::from(both.plane_square) / (inliers * voxel * voxel),
        f64::from(evidence.match_inliers).ln_1p(),
    ]
}

/// Leaves out the wrong hypotheses that look about like right ones in every respect: against the pair's own truth where the scans overlap, against
/// the lesser of the scene's truths where they do not.
pub(super) fn leave_out_lookalikes(pairs: &mut [Labelled], voxel: f64) {
    let truths: Vec<[f64; RESPECTS]> =
        pairs.iter().filter_map(|pair| Some(respects(&pair.truth?, voxel))).collect();
    let usual: Option<[f64; RESPECTS]> = (truths.len() >= ENOUGH_TRUTHS).then(|| {
        std::array::from_fn(|k| {
            let mut values: Vec<f64> = truths.iter().map(|truth| truth[k]).collect();
            values.sort_by(f64::total_cmp);
            values[(WORSE_TRUTHS * (values.len() - 1) as f64) as usize]
        })
    });
    for Labelled { pair, truth } in pairs {
        let Some(right) = truth.map(|truth| respects(&truth, voxel)).or(usual) else { continue };
        for (label, hypothesis) in pair.labels.iter_mut().zip(&pair.result.hypotheses) {
            let mine = respects(&hypothesis.evidence, voxel);
            let like = (0..RESPECTS).all(|k| mine[k] >= right[k] - SLACK[k]);
            if *label == Label::Wrong && like {
                *label = Label::LeftOut(LeftOut::Lookalike);
            }
        }
    }
}
