//! Two poses of a pair that both look right: a second look at half the voxel, where what tells them apart can be seen. The ends of a
//! near-symmetric hall differ by a bench and a plant; seen coarsely that is little, seen finely a wrong pose puts them into free space.

use super::dense::{Counts, look};
use super::icp::icp;
use super::pair::Hypothesis;
use crate::features::Scan;
use crate::geometry::Pose;

/// Counts that stand for chance: some violations, and some judged points.
const CHANCE: (f64, f64) = (3.0, 300.0);
/// Surfaces that lie this near, in voxels of the second look, lie on each other: packing and sampling do as much.
const NO_DISTANCE: f64 = 0.05;
/// Where fewer points lie on the other's surface, nothing can be said of how well they fit.
const LEAST_CONTACTS: u32 = 100;
/// Where a smaller share of them does, the scans are apart, and their fit speaks for nothing.
const LEAST_OVERLAP: f64 = 0.1;
/// What a contrast of two poses is worth as log-odds: of violations, of distances. Fitted to right and wrong poses of the same pairs in halls, houses,
/// offices and indoor depth-camera scenes.
const WORTH: (f64, f64) = (1.5, 2.8);
/// Log-odds from which it decides. It then finds two thirds and more of the wrong poses that look right in halls, and hardly ever takes the right
/// one for wrong, except in rows of identical rooms, where one pair in four says either.
const DECISIVE: f64 = 1.0;

/// Poses of a pair with less log-odds than this are out of the running, …
const LEAST: f64 = -3.0;
/// … and those that are this far behind the likeliest.
const BEHIND: f64 = 6.0;
/// What the log-odds of a pose are lowered by that clearly loses against another. Those of the other are left as they are: both may be
/// wrong.
const LOST: f64 = 4.0;

/// What two scans say of a pose (b to a, local frames) at half the voxel, both directions together, once it is aligned as finely. `None`
/// where either scan has no finer surfaces ([`Scan::fine`]).
#[must_use]
pub fn look_finely(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Counts> {
    let (a, b) = (a.fine()?, b.fine()?);
    let aligned = icp(&a, &b, a_from_b);
    Some(look(&a, &b, &aligned, 1).plus(&look(&b, &a, &aligned.inverse(), 1)))
}

/// The same, or what they say where they are without being aligned, whichever puts less into free space. Alignment can slide where little
/// overlaps; without it, what is a little off violates a little.
#[must_use]
pub fn look_leniently(a: &Scan, b: &Scan, a_from_b: &Pose) -> Option<Counts> {
    let aligned = look_finely(a, b, a_from_b)?;
    let (a, b) = (a.fine()?, b.fine()?);
    let plain = look(&a, &b, a_from_b, 1).plus(&look(&b, &a, &a_from_b.inverse(), 1));
    Some(if plain.violation_share() < aligned.violation_share() { plain } else { aligned })
}

/// Log-odds of one pose over another, from counts taken with voxels of this size (metres): by the shares of judged points that lie in free
/// space, and by the root mean square distances of surfaces that meet. Zero where too little meets to tell, or so little at the better pose
/// that it is no overlap.
#[must_use]
pub fn preference(pose: &Counts, other: &Counts, voxel: f64) -> f64 {
    if pose.inliers.min(other.inliers) < LEAST_CONTACTS {
        return 0.0;
    }
    // Logarithms of ratios, 0 where both are alike.
    let violation = log_violation(other) - log_violation(pose);
    let apart = log_distance(other, voxel) - log_distance(pose, voxel);
    let worth = WORTH.0 * violation + WORTH.1 * apart;
    let better = if worth > 0.0 { pose } else { other };
    if better.overlap() < LEAST_OVERLAP { 0.0 } else { worth }
}

/// Whether the second counts are clearly worse, both taken with voxels of this size (metres).
#[must_use]
pub fn is_clearly_worse(pose: &Counts, other: &Counts, voxel: f64) -> bool {
    preference(pose, other, voxel) > DECISIVE
}

/// Looks again at the poses of a pair that are in the running, if there are several, and lowers the log-odds of those that are clearly
/// worse than another.
pub(super) fn contest(a: &Scan, b: &Scan, hypotheses: &mut [Hypothesis]) {
    let best = hypotheses.iter().map(|h| h.logit).fold(f64::NEG_INFINITY, f64::max);
    let runs = |h: &&mut Hypothesis| h.logit > LEAST.max(best - BEHIND);
    let mut running: Vec<&mut Hypothesis> = hypotheses.iter_mut().filter(runs).collect();
    if running.len() < 2 {
        return;
    }
    let voxel = a.prepared.resolution / 2.0;
    let seen_finely = |h: &Hypothesis| match &h.evidence.detail {
        Some(detail) => Some(detail.looked_at()),
        None => look_finely(a, b, &h.a_from_b),
    };
    let seen: Option<Vec<Counts>> = running.iter().map(|h| seen_finely(h)).collect();
    let Some(seen) = seen else { return };
    for (hypothesis, mine) in running.iter_mut().zip(&seen) {
        if seen.iter().any(|other| is_clearly_worse(other, mine, voxel)) {
            hypothesis.logit -= LOST;
        }
    }
}

fn log_violation(counts: &Counts) -> f64 {
    let judged = f64::from(counts.violations) + f64::from(counts.inliers);
    ((f64::from(counts.violations) + CHANCE.0) / (judged + CHANCE.1)).ln()
}

fn log_distance(counts: &Counts, voxel: f64) -> f64 {
    let square = f64::from(counts.plane_square) / f64::from(counts.inliers.max(1));
    (square + (NO_DISTANCE * voxel).powi(2)).sqrt().ln()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::PreparedScan;
    use crate::pairwise::test_survey::{Hall, hall};
    use crate::pairwise::{Evidence, detail};

    #[test]
    fn a_pose_at_which_little_meets_is_never_the_better_one() {
        let counts = |inliers: u32, violations: u32, apart: f32| Counts {
            points: 30_000,
            inliers,
            violations,
            plane_square: inliers as f32 * apart * apart,
            ..Counts::default()
        };
        let (good, bad) = (counts(20_000, 30, 0.02), counts(19_000, 200, 0.03));
        assert!(is_clearly_worse(&good, &bad, 0.1) && !is_clearly_worse(&bad, &good, 0.1));
        for few in [counts(0, 0, 0.0), counts(40, 0, 0.01), counts(2_500, 0, 0.01)] {
            assert!(!is_clearly_worse(&few, &bad, 0.1), "{few:?}");
        }
        // Nor is one the worse one, whatever it puts into free space.
        for few in [counts(0, 5_000, 0.0), counts(40, 5_000, 0.03)] {
            assert!(!is_clearly_worse(&good, &few, 0.1), "{few:?}");
        }
        assert!(is_clearly_worse(&good, &counts(400, 5_000, 0.03), 0.1));
        assert!(!is_clearly_worse(&Counts::default(), &Counts::default(), 0.1));
    }

    #[test]
    fn noise_far_below_the_voxel_decides_nothing() {
        let exact = |apart: f32| Counts {
            points: 1000,
            inliers: 1000,
            plane_square: 1000.0 * apart * apart,
            ..Counts::default()
        };
        assert!(!is_clearly_worse(&exact(0.0), &exact(1e-4), 0.1));
        assert!(!is_clearly_worse(&exact(1e-7), &exact(1e-4), 0.1));
    }

    #[test]
    fn a_hall_that_is_turned_by_half_is_told_from_the_right_one() {
        let Hall { scans, resolution, turned } = hall(4);
        let mut decided = 0;
        for (i, (b, model_from_b)) in scans.iter().enumerate() {
            for (a, model_from_a) in &scans[..i] {
                let truth = model_from_a.inverse() * *model_from_b;
                let wrong = model_from_a.inverse() * turned * *model_from_b;
                let seen = |pose| look_finely(a, b, pose).expect("the scans are fine enough");
                let (right, turned) = (seen(&truth), seen(&wrong));
                let voxel = resolution / 2.0;
                assert!(!is_clearly_worse(&turned, &right, voxel), "{right:?} {turned:?}");
                decided += usize::from(is_clearly_worse(&right, &turned, voxel));
            }
        }
        assert!(decided >= 4, "{decided} of 6 pairs tell the ends of the hall apart");
        let (first, second) = (&scans[0].0, &scans[1].0);
        let bare = Scan::new(PreparedScan { fine: None, ..second.prepared.clone() });
        assert_eq!(look_finely(first, &bare, &Pose::identity()), None);
    }
    #[test]
    fn of_the_poses_of_a_pair_those_that_clearly_lose_are_believed_less() {
        let Hall { scans, turned, .. } = hall(3);
        let ((a, model_from_a), (b, model_from_b)) = (&scans[0], &scans[2]);
        let at = |pose: Pose, logit: f64| Hypothesis { a_from_b: pose, evidence: Evidence::default(), logit };
        let truth = model_from_a.inverse() * *model_from_b;
        let wrong = model_from_a.inverse() * turned * *model_from_b;
        let closely = |pose: Pose, logit: f64| {
            let evidence = Evidence { detail: detail(a, b, &pose), ..Evidence::default() };
            Hypothesis { evidence, ..at(pose, logit) }
        };
        // Whether it was seen closely before, or is looked at now.
        for mut both in [[at(wrong, 6.0), at(truth, 5.0)], [closely(wrong, 6.0), closely(truth, 5.0)]] {
            contest(a, b, &mut both);
            assert!(both[0].logit < both[1].logit && both[1].logit == 5.0, "{both:?}");
        }
        // Who is alone, or far ahead, has no rival to be compared with.
        for logits in [vec![6.0], vec![6.0, -4.0]] {
            let mut alone: Vec<Hypothesis> = logits.iter().map(|logit| at(wrong, *logit)).collect();
            contest(a, b, &mut alone);
            assert!(alone.iter().zip(&logits).all(|(after, before)| after.logit == *before));
        }
    }
}
