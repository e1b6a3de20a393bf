//! How much the pairs of a scan look right although they are not, and what that takes from each of them: a scan that sees little beside a floor and
//! two walls fits many places of a building about as well, one that sees what is there once fits none but its own. What the verifier's features
//! leave of that shows in the other pairs of both scans, most of which are wrong: they are the cohort against which a pair is judged,
//! as a voice is against those of other speakers in speaker verification (Auckenthaler, Carey and Lloyd-Thomas, "Score normalization for
//! text-independent speaker verification systems", Digital Signal Processing 10, 2000; both sides as in Kenny, "Bayesian speaker
//! verification with heavy-tailed priors", Odyssey 2010).

use std::collections::BTreeMap;

use super::scan_graph::Edge;
use crate::cloud::ScanKey;

/// Wrong pairs of the project's mean odds that each scan is taken to have beside its own.
const IMAGINED: f64 = 10.0;
/// One pair counts at most as these log-odds: a single one that looks right and is not says little of the scan.
const LOUDEST: f64 = 3.0;

/// Odds that wrong pairs would have by themselves, and how many they are.
#[derive(Debug, Clone, Copy, Default)]
struct Odds {
    sum: f64,
    pairs: f64,
}

impl Odds {
    /// What a pair adds: as far as third scans do not hold it for right, its likeliest pose.
    fn of(edge: &Edge) -> Self {
        let log_odds = edge.hypotheses.iter().map(|h| h.hypothesis.logit).fold(f64::NEG_INFINITY, f64::max);
        let wrong = 1.0 / (1.0 + edge.plain_score.exp());
        if wrong.is_nan() {
            Self::default()
        } else {
            Self { sum: wrong * log_odds.min(LOUDEST).exp(), pairs: wrong }
        }
    }

    fn plus(self, other: Self) -> Self {
        Self { sum: self.sum + other.sum, pairs: self.pairs + other.pairs }
    }

    fn minus(self, other: Self) -> Self {
        Self { sum: (self.sum - other.sum).max(0.0), pairs: (self.pairs - other.pairs).max(0.0) }
    }

    /// Log-odds of a wrong pair in the mean.
    fn mean(self) -> f64 {
        (self.sum / self.pairs).ln()
    }
}

/// The odds of the wrong pairs of each scan, and of all.
#[derive(Debug, Clone, Default)]
pub(super) struct Cohorts {
    of_scan: BTreeMap<ScanKey, Odds>,
    all: Odds,
}

impl Cohorts {
    /// Of these edges, by their plain scores.
    pub fn of<'e>(edges: impl Iterator<Item = &'e Edge>) -> Self {
        let mut found = Self::default();
        for edge in edges {
            let odds = Odds::of(edge);
            found.all = found.all.plus(odds);
            for scan in [edge.pair.a, edge.pair.b] {
                let known = found.of_scan.entry(scan).or_default();
                *known = known.plus(odds);
            }
        }
        found
    }

    /// What the log-odds of a pair's hypotheses are to be raised by for how much the other pairs of its scans look right: below zero where that is
    /// more than in the whole project.
    pub fn correction(&self, edge: &Edge) -> f64 {
        let typical = self.all.mean();
        if !typical.is_finite() {
            return 0.0;
        }
        let imagined = Odds { sum: IMAGINED * typical.exp(), pairs: IMAGINED };
        let own = Odds::of(edge);
        let excess = |scan: &ScanKey| {
            let odds = self.of_scan.get(scan).copied().unwrap_or_default();
            odds.minus(own).plus(imagined).mean() - typical
        };
        -excess(&edge.pair.a) - excess(&edge.pair.b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::graph::Supported;
    use crate::pairwise::{Evidence, Hypothesis, PairKey};

    /// All pairs of twenty scans, with these log-odds, of which third scans hold those for right that are above five.
    fn edges(log_odds: impl Fn(u128, u128) -> f64) -> Vec<Edge> {
        let edge = |(a, b): (u128, u128)| {
            let logit = log_odds(a, b);
            let hypothesis = Hypothesis { a_from_b: Pose::identity(), evidence: Evidence::default(), logit };
            Edge {
                pair: PairKey::of(ScanKey(a), ScanKey(b)),
                matches: Vec::new(),
                hypotheses: vec![Supported { hypothesis, support: 0.0, score: logit }],
                plain_score: if logit > 5.0 { logit } else { -9.0 },
                correction: 0.0,
            }
        };
        (0..20).flat_map(|a| (a + 1..20).map(move |b| (a, b))).map(edge).collect()
    }

    fn correction(edges: &[Edge], a: u128, b: u128) -> f64 {
        let pair = PairKey::of(ScanKey(a), ScanKey(b));
        let edge = edges.iter().find(|edge| edge.pair == pair).expect("all pairs were tried");
        Cohorts::of(edges.iter()).correction(edge)
    }

    #[test]
    fn pairs_of_a_scan_that_fits_everywhere_are_worth_less() {
        let plain = edges(|a, _| if a == 0 { -1.0 } else { -5.0 });
        let (of_it, of_others) = (correction(&plain, 0, 7), correction(&plain, 3, 7));
        assert!(of_it < -0.8, "{of_it}");
        assert!((0.0..1.5).contains(&of_others), "{of_others}");
    }

    #[test]
    fn a_pair_says_nothing_against_itself_nor_do_those_held_for_right() {
        let one = |logit: f64| edges(move |a, b| if (a, b) == (0, 7) { logit } else { -5.0 });
        assert!(correction(&one(4.0), 0, 7) >= 0.0);
        assert!(correction(&one(4.0), 0, 3) < correction(&one(9.0), 0, 3));
        assert!(correction(&one(9.0), 0, 3).abs() < 0.1);
    }

    #[test]
    fn where_all_is_alike_or_nothing_is_known_nothing_is_corrected() {
        assert!(correction(&edges(|_, _| -2.0), 4, 5).abs() < 1e-9);
        assert!(correction(&edges(|_, _| 9.0), 4, 5).abs() < 1e-9);
        for unknown in [f64::NEG_INFINITY, f64::NAN] {
            assert_eq!(correction(&edges(|_, _| unknown), 4, 5), 0.0);
        }
        assert!(correction(&edges(|a, _| if a == 1 { f64::INFINITY } else { -3.0 }), 4, 5).is_finite());
    }
}
