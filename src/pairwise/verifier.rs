//! How likely a pose of two scans is right: a logistic regression with quadratic terms on dense, free-space and match evidence.
//!
//! Its weights are fitted (`calibration`) on scenes with known truth and shipped in `verifier.json`; every feature is
//! free of units (counts, shares, or lengths in voxels).

use std::sync::LazyLock;

use serde::{Deserialize, Serialize};

use super::dense::{Counts, share};

/// Numbers that describe the evidence for a pose.
pub const FEATURES: usize = 15;

/// Everything known about one hypothesis of a pair, as counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Points of b against a.
    pub b_on_a: Counts,
    /// Points of a against b.
    pub a_on_b: Counts,
    /// Soft count of agreeing matches when the hypothesis was found.
    pub consensus: f32,
    /// Matches that agree with the refined pose.
    pub match_inliers: u32,
    /// Matches of the pair.
    pub matches: u32,
    /// Of the two scans, how many say what their sensor saw: without that, no violation means nothing.
    pub range_images: u32,
}

impl Evidence {
    /// Both directions together.
    #[must_use]
    pub fn both(&self) -> Counts {
        self.b_on_a.plus(&self.a_on_b)
    }

    /// The features of the regression; `voxel` is the resolution in metres.
    #[must_use]
    pub fn features(&self, voxel: f64) -> [f64; FEATURES] {
        let both = self.both();
        let seen = both.violations + both.inliers + both.on_seen_surface;
        let plane_rms = (f64::from(both.plane_square) / f64::from(both.inliers.max(1))).sqrt() / voxel;
        [
            f64::from(both.inliers).ln_1p(),
            f64::from(both.violations).ln_1p(),
            both.overlap(),
            both.violation_share(),
            self.b_on_a.violation_share().max(self.a_on_b.violation_share()),
            share(both.wrong_normal, both.wrong_normal + both.inliers),
            share(both.tight, both.inliers),
            plane_rms,
            f64::from(self.consensus).ln_1p(),
            f64::from(self.match_inliers).ln_1p(),
            share(self.match_inliers, self.matches),
            share(both.inliers + both.on_seen_surface, both.points),
            share(both.violations, seen),
            self.b_on_a.overlap().max(self.a_on_b.overlap()),
            f64::from(self.range_images),
        ]
    }
}

/// A logistic regression on standardised features and their products.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Logistic {
    /// Mean of each feature over the calibration set.
    pub mean: Vec<f64>,
    /// Standard deviation of each feature there.
    pub deviation: Vec<f64>,
    /// Constant, linear, then products `x_i x_j` for i <= j.
    pub weights: Vec<f64>,
}

impl Logistic {
    /// The terms that the weights multiply: 1, the standardised features, their products.
    #[must_use]
    pub fn terms(&self, features: &[f64]) -> Vec<f64> {
        let x: Vec<f64> = features
            .iter()
            .zip(self.mean.iter().zip(&self.deviation))
            // Clamped, so that evidence far outside the calibration set cannot run away with the products.
            .map(|(x, (mean, deviation))| ((x - mean) / deviation).clamp(-4.0, 4.0))
            .collect();
        let mut terms = Vec::with_capacity(1 + x.len() * (x.len() + 3) / 2);
        terms.push(1.0);
        terms.extend_from_slice(&x);
        for i in 0..x.len() {
            for j in i..x.len() {
                terms.push(x[i] * x[j]);
            }
        }
        terms
    }

    /// The log-odds that the described pose is right.
    #[must_use]
    pub fn logit(&self, features: &[f64]) -> f64 {
        self.terms(features).iter().zip(&self.weights).map(|(x, w)| x * w).sum()
    }
}

/// The shipped regressions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verifier {
    /// What the weights were fitted on.
    pub provenance: String,
    /// On a pair alone.
    pub pair: Logistic,
    /// On a pair and what third scans say.
    pub triplet: Logistic,
}

/// The verifier that ships with the product.
#[must_use]
#[expect(clippy::expect_used, reason = "the weights are part of the binary, and a test reads them")]
pub fn shipped_verifier() -> &'static Verifier {
    static SHIPPED: LazyLock<Verifier> = LazyLock::new(|| {
        serde_json::from_str(include_str!("verifier.json"))
            .expect("the shipped weights are checked by a test")
    });
    &SHIPPED
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_weights_fit_the_features() {
        let verifier = shipped_verifier();
        let terms = |n: usize| 1 + n + n * (n + 1) / 2;
        assert_eq!(verifier.pair.mean.len(), FEATURES);
        assert_eq!(verifier.pair.weights.len(), terms(FEATURES));
        let n = verifier.triplet.mean.len();
        assert_eq!(verifier.triplet.weights.len(), terms(n));
        assert!(verifier.pair.deviation.iter().chain(&verifier.triplet.deviation).all(|d| *d > 0.0));
    }

    #[test]
    fn surfaces_that_coincide_are_likelier_right_than_surfaces_in_free_space() {
        let good =
            Counts { points: 4000, inliers: 2400, tight: 2000, plane_square: 0.4, ..Counts::default() };
        let bad = Counts {
            points: 4000,
            inliers: 600,
            tight: 200,
            wrong_normal: 300,
            violations: 900,
            plane_square: 0.9,
            ..Counts::default()
        };
        let evidence = |counts, match_inliers| Evidence {
            b_on_a: counts,
            a_on_b: counts,
            consensus: match_inliers as f32 * 0.6,
            match_inliers,
            matches: 300,
            range_images: 2,
        };
        let logit = |e: Evidence| shipped_verifier().pair.logit(&e.features(0.05));
        assert!(logit(evidence(good, 120)) > 2.0);
        assert!(logit(evidence(bad, 9)) < -2.0);
    }
}
