//! One pair of scans from descriptors to verified hypotheses: the pure function that the scan graph is made of.

use serde::{Deserialize, Serialize};

use super::appearance::appearance;
use super::consensus::{INLIER_VOXELS, agreement, centred_difference};
use super::dense::look;
use super::detail::detail;
use super::gravity::is_upright;
use super::icp::icp;
use super::matching::mutual_matches;
use super::second_look::contest;
use super::shortlist::shortlist;
use super::verifier::{Evidence, Verifier, is_looked_at_closely};
use crate::cloud::ScanKey;
use crate::features::Scan;
use crate::geometry::Pose;

/// Matches of a pair, at most.
const MAX_MATCHES: usize = 800;
/// Poses that are refined and verified, the most promising at a glance.
const REFINED: usize = 6;
/// Points of each scan, up to twice as many, by which a refined pose is judged first, …
const GLANCED: usize = 1500;
/// … and log-odds below which that is enough. Of ten thousand such poses, counted at every fourth point, none looked likelier right than wrong at
/// all points.
const HOPELESS: f64 = -5.0;
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

/// Matches and verifies one pair. `x` and `y` may come in either order and must be different scans at one resolution. The evidence for
/// poses that are hopeless is counted on some of the points, which stand for all.
#[must_use]
pub fn match_pair(x: &Scan, y: &Scan, verifier: &Verifier) -> PairResult {
    match_and_verify(x, y, verifier, false)
}

/// The same with all evidence counted on all points, and all poses looked at closely, whatever the verifier makes of them: what one is fitted to.
#[must_use]
pub fn match_pair_in_full(x: &Scan, y: &Scan, verifier: &Verifier) -> PairResult {
    match_and_verify(x, y, verifier, true)
}

fn match_and_verify(x: &Scan, y: &Scan, verifier: &Verifier, in_full: bool) -> PairResult {
    let (a, b) = if x.key() < y.key() { (x, y) } else { (y, x) };
    let pair = PairKey { a: a.key(), b: b.key() };
    let matches = mutual_matches(&a.prepared, &b.prepared, MAX_MATCHES);
    // Of small scans a glance is all there is to see.
    let glance = !in_full && [a, b].iter().any(|scan| scan.prepared.points.len() >= 2 * GLANCED);
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
        let appearance = appearance(a, b, &a_from_b);
        let verified = |points: usize| {
            let seen = |scan: &Scan, other: &Scan, scan_from_other: &Pose| {
                let stride = (other.prepared.points.len() / points).max(1);
                look(scan, other, scan_from_other, stride).times(stride)
            };
            let evidence = Evidence {
                b_on_a: seen(a, b, &a_from_b),
                a_on_b: seen(b, a, &a_from_b.inverse()),
                consensus: agreeing.score.max(candidate.score) as f32,
                match_inliers: agreeing.inliers as u32,
                matches: matches.len() as u32,
                range_images: [a, b].iter().filter(|scan| scan.prepared.range_image.is_some()).count() as u32,
                appearance,
                detail: None,
            };
            let logit = verifier.pair_logit(&evidence, a.prepared.resolution);
            Hypothesis { a_from_b, evidence, logit }
        };
        let glanced = glance.then(|| verified(GLANCED)).filter(|at_a_glance| at_a_glance.logit < HOPELESS);
        hypotheses.push(glanced.unwrap_or_else(|| verified(usize::MAX)));
    }
    let voxel = a.prepared.resolution;
    for hypothesis in &mut hypotheses {
        if in_full || is_looked_at_closely(verifier.pair.logit(&hypothesis.evidence.features(voxel))) {
            hypothesis.evidence.detail = detail(a, b, &hypothesis.a_from_b);
            hypothesis.logit = verifier.pair_logit(&hypothesis.evidence, voxel);
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;
    use crate::pairwise::shipped_verifier;
    use crate::pairwise::test_survey::prepared;
    use crate::simulate::{Sensor, SurveyOptions, simulate};

    #[test]
    fn only_what_is_hopeless_is_judged_by_some_of_the_points() {
        let office = simulate(&SurveyOptions {
            sensor: Sensor::panoramic(20_000),
            stations: 6,
            least_overlap: 0.1,
            seed: Seed(5),
            ..SurveyOptions::default()
        })
        .expect("the options are valid");
        let scans = prepared(&office, 0.15);
        let verifier = shipped_verifier();
        let (mut glanced, mut looked_at, mut closely) = (0, 0, 0);
        for (i, (a, _)) in scans.iter().enumerate() {
            for (b, _) in &scans[..i] {
                let quick = match_pair(a, b, &verifier);
                let full = match_pair_in_full(a, b, &verifier);
                assert_eq!(
                    (quick.matches.len(), quick.hypotheses.len()),
                    (full.matches.len(), full.hypotheses.len())
                );
                for known in &full.hypotheses {
                    let same = |h: &&Hypothesis| h.a_from_b == known.a_from_b;
                    let found = quick.hypotheses.iter().find(same).expect("the poses are the same");
                    let coarsely = |h: &Hypothesis| Evidence { detail: None, ..h.evidence };
                    let likely = is_looked_at_closely(
                        verifier.pair.logit(&found.evidence.features(a.prepared.resolution)),
                    );
                    assert_eq!(found.evidence.detail, known.evidence.detail.filter(|_| likely));
                    closely += usize::from(found.evidence.detail.is_some());
                    if coarsely(found) == coarsely(known) {
                        looked_at += 1;
                    } else {
                        assert!(
                            found.logit < HOPELESS && known.logit < 0.0,
                            "{} is {}",
                            found.logit,
                            known.logit
                        );
                        glanced += 1;
                    }
                }
            }
        }
        assert!(glanced > 10 && looked_at > 20, "{glanced} poses were hopeless, {looked_at} not");
        assert!(closely > 10 && closely < looked_at, "{closely} of {looked_at} were looked at closely");
    }
}
