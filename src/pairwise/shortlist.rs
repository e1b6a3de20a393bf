//! The few poses of a pair that are worth refining, chosen from many at a glance: those on which matches agree (`consensus`) and
//! those that planes allow (`planar`). The glance weighs free space above all: poses that lay large planes flush onto each
//! other are many, and put walls where the other scan saw none.

use super::consensus::{Consensus, ConsensusOptions, agreement, centred_difference, consensus};
use super::dense::look;
use super::gravity::is_upright;
use super::matching::Match;
use super::planar::planar_poses;
use crate::features::Scan;
use crate::geometry::Pose;

/// Poses from planes that are looked at: first all of them at few points, then the best at more.
const PLANAR_POSES: usize = 200;
const PLANAR_KEPT: usize = 20;
/// Points of each scan in a first and in a second look, about.
const FIRST_LOOK: usize = 80;
const SECOND_LOOK: usize = 400;
/// Poses closer than this (rad, voxels) are refined to the same one.
const SAME_ANGLE: f64 = 0.17;
const SAME_VOXELS: f64 = 3.0;
/// What evidence is worth at a glance: the log of the points on the other's surface, the share of violations of free space, the share
/// of near points with a wrong normal, the log of the matches that agree.
const SURFACE: f64 = 0.35;
const VIOLATION: f64 = 30.0;
const WRONG_NORMAL: f64 = 2.0;
const AGREEMENT: f64 = 1.7;

/// At most `count` different poses, the most promising first, each with the matches that agree with it.
#[must_use]
pub fn shortlist(a: &Scan, b: &Scan, matches: &[Match], count: usize) -> Vec<Consensus> {
    let mut candidates = consensus(a, b, matches, &ConsensusOptions::default());
    candidates.retain(|candidate| is_upright(a, b, &candidate.a_from_b));
    // Without any range image planes that are flush cannot be told from planes that are the same.
    if [a, b].iter().any(|scan| scan.prepared.range_image.is_some()) {
        let mut planar: Vec<(f64, Pose)> = planar_poses(a, b, PLANAR_POSES)
            .into_iter()
            .map(|pose| (glance(a, b, &pose, FIRST_LOOK), pose))
            .collect();
        planar.sort_by(|x, y| y.0.total_cmp(&x.0));
        planar.truncate(PLANAR_KEPT);
        candidates.extend(planar.iter().map(|(_, pose)| agreement(a, b, matches, pose)));
    }
    let mut ranked: Vec<(f64, Consensus)> = candidates
        .into_iter()
        .map(|c| (glance(a, b, &c.a_from_b, SECOND_LOOK) + AGREEMENT * (c.inliers as f64).ln_1p(), c))
        .collect();
    ranked.sort_by(|x, y| y.0.total_cmp(&x.0).then(y.1.score.total_cmp(&x.1.score)));
    let mut chosen: Vec<Consensus> = Vec::with_capacity(count);
    for (_, candidate) in ranked {
        if chosen.len() == count {
            break;
        }
        let known = chosen.iter().any(|c| {
            let (angle, distance) = centred_difference(&c.a_from_b, &candidate.a_from_b, &b.centroid);
            angle < SAME_ANGLE && distance < SAME_VOXELS * a.prepared.resolution
        });
        if !known {
            chosen.push(candidate);
        }
    }
    chosen
}

/// How promising a pose looks from about `points` points of each scan. The higher the better; only values for one pair compare.
fn glance(a: &Scan, b: &Scan, a_from_b: &Pose, points: usize) -> f64 {
    let stride = |scan: &Scan| scan.prepared.points.len() / points;
    let seen = look(a, b, a_from_b, stride(b)).plus(&look(b, a, &a_from_b.inverse(), stride(a)));
    let against = |count: u32| f64::from(count) / f64::from(count + seen.inliers + 1);
    SURFACE * f64::from(seen.inliers).ln_1p()
        - VIOLATION * against(seen.violations)
        - WRONG_NORMAL * against(seen.wrong_normal)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;
    use crate::pairwise::mutual_matches;
    use crate::pairwise::test_survey::prepared;
    use crate::simulate::{Sensor, SurveyOptions, simulate};

    #[test]
    fn rooms_that_see_each_other_through_a_door_are_found_by_their_planes() {
        let office = simulate(&SurveyOptions {
            sensor: Sensor::panoramic(20_000),
            stations: 10,
            least_overlap: 0.1,
            seed: Seed(5),
            ..SurveyOptions::default()
        })
        .expect("the options are valid");
        let scans = prepared(&office, 0.15);
        let (mut pairs, mut by_matches, mut listed) = (0, 0, 0);
        for (i, (b, model_from_b)) in scans.iter().enumerate() {
            for (a, model_from_a) in &scans[..i] {
                let truth = model_from_a.inverse() * *model_from_b;
                let overlap = look(a, b, &truth, 2).overlap().min(look(b, a, &truth.inverse(), 2).overlap());
                if !(0.1..0.4).contains(&overlap) {
                    continue;
                }
                pairs += 1;
                let matches = mutual_matches(&a.prepared, &b.prepared, 800);
                let right = |candidate: &Consensus| {
                    let (angle, distance) = centred_difference(&candidate.a_from_b, &truth, &b.centroid);
                    angle < 0.14 && distance < 0.75
                };
                by_matches +=
                    usize::from(consensus(a, b, &matches, &ConsensusOptions::default()).iter().any(right));
                listed += usize::from(shortlist(a, b, &matches, 6).iter().any(right));
            }
        }
        assert!(pairs >= 6, "{pairs} pairs overlap a little");
        assert!(
            10 * listed >= 8 * pairs && listed > by_matches,
            "of {pairs} pairs {listed} have the right pose listed, {by_matches} by their matches alone"
        );
    }
}
