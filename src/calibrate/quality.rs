//! How good predictions are, and how honest: what was predicted with 80 % should be right in 80 of 100 cases.

use serde::{Deserialize, Serialize};

use super::regression::log_loss;

/// Precision at which recall is told.
const PRECISION: f64 = 0.99;
/// Edges of the bins of predicted probability: finer where decisions are made, near 0 and 1.
const EDGES: [f64; 15] =
    [0.0, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97, 0.99, 1.0 + f64::EPSILON];

/// How well right and wrong are told apart.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// Right hypotheses.
    pub right: usize,
    /// Wrong hypotheses.
    pub wrong: usize,
    /// Area under the curve of precision over recall.
    pub average_precision: f64,
    /// Largest share of the right hypotheses above a threshold above which 99 % are right.
    pub recall_at_99: f64,
    /// Mean of `-ln p` of what was true.
    pub log_loss: f64,
}

impl Quality {
    /// Of (log-odds, right); `None` without any right one.
    #[must_use]
    pub fn of(predictions: &[(f64, bool)]) -> Option<Self> {
        let right = predictions.iter().filter(|(_, right)| *right).count();
        if right == 0 {
            return None;
        }
        let mut sorted = predictions.to_vec();
        sorted.sort_by(|x, y| y.0.total_cmp(&x.0));
        let (mut hits, mut area, mut recall_at_99, mut loss) = (0usize, 0.0, 0.0, 0.0);
        for (i, (logit, is_right)) in sorted.iter().enumerate() {
            loss += log_loss(*logit, *is_right);
            hits += usize::from(*is_right);
            let precision = hits as f64 / (i + 1) as f64;
            if *is_right {
                area += precision;
            }
            // Equal log-odds are above a threshold together.
            let last = sorted.get(i + 1).is_none_or(|next| next.0 < *logit);
            if last && precision >= PRECISION {
                recall_at_99 = hits as f64 / right as f64;
            }
        }
        Some(Self {
            right,
            wrong: sorted.len() - right,
            average_precision: area / right as f64,
            recall_at_99,
            log_loss: loss / sorted.len() as f64,
        })
    }
}

/// One bin of a reliability diagram.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Bin {
    /// Probabilities from here …
    pub low: f64,
    /// … up to here.
    pub high: f64,
    /// Predictions in it.
    pub count: usize,
    /// Of those, right ones.
    pub right: usize,
    /// Weighted share of all predictions.
    pub share: f64,
    /// Weighted mean of the predicted probability.
    pub predicted: f64,
    /// Weighted share of right ones.
    pub observed: f64,
}

/// Predicted probability against observed share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Bins that hold anything, ascending.
    pub bins: Vec<Bin>,
    /// Expected calibration error: mean of |predicted - observed| of the bins, by their share.
    pub error: f64,
}

impl Reliability {
    /// Of (log-odds, right, weight).
    #[must_use]
    pub fn of(predictions: &[(f64, bool, f64)]) -> Self {
        let total: f64 = predictions.iter().map(|p| p.2).sum();
        let mut bins: Vec<Bin> = EDGES
            .windows(2)
            .map(|edge| Bin { low: edge[0], high: edge[1].min(1.0), ..Bin::default() })
            .collect();
        for &(logit, right, weight) in predictions {
            let p = 1.0 / (1.0 + (-logit).exp());
            let bin = EDGES.partition_point(|edge| *edge <= p).saturating_sub(1);
            let Some(bin) = bins.get_mut(bin) else { continue };
            bin.count += 1;
            bin.right += usize::from(right);
            bin.share += weight / total;
            bin.predicted += weight / total * p;
            bin.observed += weight / total * f64::from(u8::from(right));
        }
        bins.retain(|bin| bin.count > 0);
        for bin in &mut bins {
            bin.predicted /= bin.share;
            bin.observed /= bin.share;
        }
        let error = bins.iter().map(|bin| bin.share * (bin.predicted - bin.observed).abs()).sum();
        Self { bins, error }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perfect_order_scores_one_and_one_wrong_on_top_costs_recall() {
        let right = (0..200).map(|i| (f64::from(i) * 0.01 + 1.0, true));
        let wrong = (0..200).map(|i| (f64::from(i) * -0.01, false));
        let mut all: Vec<(f64, bool)> = right.chain(wrong).collect();
        let quality = Quality::of(&all).unwrap();
        assert_eq!((quality.average_precision, quality.recall_at_99), (1.0, 1.0));
        // Three wrong ones in the middle of 200: 99 % hold only for the hundred above them, then never again.
        all.extend([(2.0, false); 3]);
        let quality = Quality::of(&all).unwrap();
        assert!((0.45..0.55).contains(&quality.recall_at_99), "{quality:?}");
        assert_eq!(Quality::of(&[(0.0, false)]), None);
    }

    #[test]
    fn honest_probabilities_have_no_error_and_boasting_ones_have() {
        let honest: Vec<_> = (0..100).map(|i| (0.75f64.ln() - 0.25f64.ln(), i % 4 != 0, 1.0)).collect();
        let reliability = Reliability::of(&honest);
        assert!(reliability.error < 1e-12, "{reliability:?}");
        assert_eq!(reliability.bins.len(), 1);
        assert_eq!((reliability.bins[0].count, reliability.bins[0].right), (100, 75));
        let boasting: Vec<_> = honest.iter().map(|(logit, right, w)| (logit + 9.0, *right, *w)).collect();
        assert!((Reliability::of(&boasting).error - 0.25).abs() < 1e-3);
    }
}
