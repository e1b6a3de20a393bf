//! How rare right poses are among those of a project, and what that takes from each: the verifier's log-odds hold for projects in which as many
//! hypotheses are right as in the scenes it was fitted on. Where most pairs that were tried see different places, as in a building of many
//! rooms seen by a depth camera, far more of its hypotheses are wrong, and as many more look right by chance.
//!
//! The share is estimated from the log-odds themselves by expectation maximisation: Saerens, Latinne and Decaestecker, "Adjusting the outputs of
//! a classifier to new a priori probabilities", Neural Computation 14 (2002).

use std::collections::BTreeMap;

use super::scan_graph::Edge;
use crate::pairwise::PairKey;

/// Hypotheses of the fitted share that a project is taken to have beside its own: few pairs tell little.
const IMAGINED: f64 = 100.0;
/// Rounds of expectation maximisation. It gains a factor in each and has long settled by then.
const ROUNDS: usize = 50;

/// What the log-odds of all hypotheses of these edges are to be raised by, after those of each pair were by what `of_pair` says. It is never above
/// zero: that right poses are frequent among pairs that retrieval chose is no reason to believe in any. `fitted` is the share that was right where
/// the verifier was fitted.
#[must_use]
pub(super) fn correction<'e>(
    edges: impl Iterator<Item = &'e Edge>,
    of_pair: &BTreeMap<PairKey, f64>,
    fitted: f64,
) -> f64 {
    if !(fitted > 0.0 && fitted < 1.0) {
        return 0.0;
    }
    let of_pair = |edge: &Edge| of_pair.get(&edge.pair).copied().unwrap_or_default();
    let log_odds: Vec<f64> = edges
        .flat_map(|edge| edge.hypotheses.iter().map(move |h| h.hypothesis.logit + of_pair(edge)))
        .filter(|l| l.is_finite())
        .collect();
    let logit = |share: f64| (share / (1.0 - share)).ln();
    let all = log_odds.len() as f64 + IMAGINED;
    let mut shift = 0.0;
    for _ in 0..ROUNDS {
        let right: f64 = log_odds.iter().map(|l| 1.0 / (1.0 + (-l - shift).exp())).sum();
        shift = logit((right + IMAGINED * fitted) / all).min(logit(fitted)) - logit(fitted);
    }
    shift
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::ScanKey;
    use crate::geometry::Pose;
    use crate::graph::Supported;
    use crate::pairwise::{Evidence, Hypothesis};

    /// Edges of one hypothesis each.
    fn edges(log_odds: impl Iterator<Item = f64>) -> Vec<Edge> {
        let edge = |(k, logit): (usize, f64)| {
            let hypothesis = Hypothesis { a_from_b: Pose::identity(), evidence: Evidence::default(), logit };
            Edge {
                pair: PairKey::of(ScanKey(0), ScanKey(1 + k as u128)),
                matches: Vec::new(),
                hypotheses: vec![Supported { hypothesis, support: 0.0, score: logit }],
                plain_score: logit,
                correction: 0.0,
            }
        };
        log_odds.enumerate().map(edge).collect()
    }

    fn alone(edges: &[Edge], fitted: f64) -> f64 {
        correction(edges.iter(), &BTreeMap::new(), fitted)
    }

    #[test]
    fn where_fewer_are_right_than_in_the_fit_all_are_worth_less() {
        // Of 20,000, two in a hundred are sure, and the rest as often right as their log-odds say at a share of a tenth.
        let rare = edges((0..20_000).map(|k| if k % 50 == 0 { 9.0 } else { -7.0 }));
        let shift = alone(&rare, 0.1);
        let expected = (0.02_f64 / 0.98).ln() - (0.1_f64 / 0.9).ln();
        assert!((shift - expected).abs() < 0.3, "{shift} of {expected}");
        let frequent = edges((0..20_000).map(|k| if k % 3 == 0 { 9.0 } else { -7.0 }));
        assert_eq!(alone(&frequent, 0.1), 0.0);
    }

    #[test]
    fn what_pairs_are_corrected_by_themselves_counts() {
        let rare = edges((0..20_000).map(|k| if k % 50 == 0 { 9.0 } else { -3.0 }));
        let lower = rare.iter().map(|edge| (edge.pair, -4.0)).collect();
        let (before, after) = (alone(&rare, 0.1), correction(rare.iter(), &lower, 0.1));
        assert!(after < before - 0.1, "{after} after {before}");
    }

    #[test]
    fn few_pairs_or_shares_that_are_none_correct_nothing() {
        let few = edges((0..5).map(|_| -7.0));
        assert!(alone(&few, 0.1) > -0.1);
        let many = edges((0..9_000).map(|_| -7.0));
        assert!(alone(&many, 0.1) < -1.0);
        for share in [0.0, 1.0, f64::NAN] {
            assert_eq!(alone(&many, share), 0.0);
        }
        assert_eq!(alone(&edges([f64::NAN, f64::INFINITY].into_iter()), 0.1), 0.0);
    }
}
