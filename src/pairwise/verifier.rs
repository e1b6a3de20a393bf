//! How likely a pose of two scans is right: a logistic regression with quadratic terms on dense, free-space and match evidence.
//!
//! Weights are fitted by `cairn calibrate` on scenes with known truth; some are shipped in `verifier.json`; every feature is
//! free of units (counts, shares, or lengths in voxels).

use std::fmt;
use std::sync::{Arc, LazyLock};

use serde::{Deserialize, Serialize};

use super::appearance::Appearance;
use super::dense::{Counts, share};
use super::detail::{DETAIL_FEATURES, Detail};

/// Numbers that describe the evidence for a pose.
pub const FEATURES: usize = 15;
/// Numbers that the regression with triplets takes: what the pair says, and what third scans do (`graph::triplet_features`).
pub const TRIPLET_FEATURES: usize = 5;

/// Numbers that the regression on colours takes.
pub const APPEARANCE_FEATURES: usize = 2;
/// Poses with more log-odds than this, by what shows at the voxel, are looked at closely, at half of it: what is less likely is taken for wrong anyhow.
const CLOSELY: f64 = -3.0;
/// Colours lower the log-odds by this at most: light, and what sensors make of it, vary more than any calibration shows. They never
/// raise them: places that are painted alike are many.
const MOST_AGAINST: f64 = 3.0;

/// Everything known about one hypothesis of a pair, as counted.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    /// Points of b against a.
    pub b_on_a: Counts,
    /// Points of a against b.
    pub a_on_b: Counts,
    /// Soft count of agreeing matches: when the hypothesis was found or after it was refined, whichever is more.
    pub consensus: f32,
    /// Matches that agree with the refined pose.
    pub match_inliers: u32,
    /// Matches of the pair.
    pub matches: u32,
    /// Of the two scans, how many say what their sensor saw: without that, no violation means nothing.
    pub range_images: u32,
    /// How alike the colours are that meet, if both scans have enough of them.
    pub appearance: Option<Appearance>,
    /// What shows at half the voxel, if both scans have such surfaces and it was looked at.
    pub detail: Option<Detail>,
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

impl Appearance {
    /// The features of the regression on colours.
    #[must_use]
    pub fn features(&self) -> [f64; APPEARANCE_FEATURES] {
        [self.correlation, self.by_chance].map(f64::from)
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

    /// Whether there is a weight for each term of `features` numbers, and all can be computed with.
    fn fits(&self, features: usize) -> bool {
        let terms = 1 + features * (features + 3) / 2;
        (self.mean.len(), self.deviation.len(), self.weights.len()) == (features, features, terms)
            && self.mean.iter().chain(&self.weights).all(|x| x.is_finite())
            && self.deviation.iter().all(|d| d.is_finite() && *d > 0.0)
    }

    /// The log-odds that the described pose is right.
    #[must_use]
    pub fn logit(&self, features: &[f64]) -> f64 {
        self.terms(features).iter().zip(&self.weights).map(|(x, w)| x * w).sum()
    }
}

/// How weights were made: enough to make them again.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Name and version of the program.
    pub program: String,
    /// Its command line, with the names of folders for their paths; for weights that no command made, what they were fitted on.
    pub command: String,
    /// What the weights were fitted on.
    pub scenes: Vec<FittedScene>,
}

impl fmt::Display for Provenance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.scenes.is_empty() {
            return f.write_str(&self.command);
        }
        let simulated = self.scenes.iter().filter(|scene| !scene.seeds.is_empty()).count();
        let real = self.scenes.len() - simulated;
        write!(f, "{}, on {real} real and {simulated} simulated scenes: `{}`", self.program, self.command)
    }
}

/// A scene that weights were fitted on.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FittedScene {
    /// The folder of a real scene, or the kind of a simulated one.
    pub name: String,
    /// Seeds of the surveys that were simulated; none for real scans.
    pub seeds: Vec<u64>,
    /// Scans in it.
    pub scans: usize,
    /// Pairs of them that were matched.
    pub pairs: usize,
    /// Hypotheses that are right.
    pub right: usize,
    /// Hypotheses that are wrong.
    pub wrong: usize,
    /// Hypotheses that nothing was learned from.
    pub left_out: usize,
}

/// The regressions that judge poses. The engine takes them as an argument; by default the shipped ones.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Verifier {
    /// How the weights were made.
    pub provenance: Provenance,
    /// On a pair alone, at the voxel.
    pub pair: Logistic,
    /// On its log-odds and what shows at half the voxel. Without it that says nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detail: Option<Logistic>,
    /// On a pair and what third scans say.
    pub triplet: Logistic,
    /// On the colours that meet: what they take from the log-odds of a pair. Without it colours say nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub appearance: Option<Logistic>,
}

/// Why a text is no verifier.
#[derive(Debug, thiserror::Error)]
pub enum VerifierError {
    /// It is no JSON of the right form.
    #[error("no verifier: {0}")]
    Form(#[from] serde_json::Error),
    /// It was fitted on other features than this engine measures.
    #[error("the {regression} regression does not take {features} features with a weight for each term")]
    Features {
        /// `pair`, `triplet`, `detail` or `appearance`.
        regression: &'static str,
        /// What this engine measures.
        features: usize,
    },
}

impl Verifier {
    /// The share of the hypotheses that were right where the regressions were fitted, scenes weighted as for the fit: by the root of what they
    /// have. `None` if that is not known.
    #[must_use]
    pub fn share_of_right(&self) -> Option<f64> {
        let (mut right, mut all) = (0.0, 0.0);
        for scene in &self.provenance.scenes {
            let count = scene.right as f64 + scene.wrong as f64;
            if count > 0.0 {
                right += scene.right as f64 / count.sqrt();
                all += count.sqrt();
            }
        }
        (all > 0.0).then(|| right / all)
    }

    /// Reads a verifier from JSON, the form in which it is serialised.
    pub fn parse(json: &str) -> Result<Self, VerifierError> {
        let verifier: Self = serde_json::from_str(json)?;
        let always = [("pair", &verifier.pair, FEATURES), ("triplet", &verifier.triplet, TRIPLET_FEATURES)];
        let on_detail = verifier.detail.iter().map(|of| ("detail", of, DETAIL_FEATURES));
        let on_colors = verifier.appearance.iter().map(|of| ("appearance", of, APPEARANCE_FEATURES));
        for (regression, logistic, features) in always.into_iter().chain(on_detail).chain(on_colors) {
            if !logistic.fits(features) {
                return Err(VerifierError::Features { regression, features });
            }
        }
        Ok(verifier)
    }

    /// The log-odds that a pose is right, from the pair alone; `voxel` is the resolution in metres.
    #[must_use]
    pub fn pair_logit(&self, evidence: &Evidence, voxel: f64) -> f64 {
        let by_colors = self
            .appearance
            .as_ref()
            .zip(evidence.appearance)
            .map_or(0.0, |(of, seen)| of.logit(&seen.features()).clamp(-MOST_AGAINST, 0.0));
        by_shape(&self.pair, self.detail.as_ref(), evidence, voxel) + by_colors
    }
}

/// Whether poses of these log-odds, by what shows at the voxel, are looked at closely.
#[must_use]
pub fn is_looked_at_closely(coarsely: f64) -> bool {
    coarsely > CLOSELY
}

/// The log-odds of a pose from the shapes of a pair alone: of the regression at the voxel (metres), or, where it is looked at closely, of that
/// on top.
#[must_use]
pub fn by_shape(pair: &Logistic, detail: Option<&Logistic>, evidence: &Evidence, voxel: f64) -> f64 {
    let coarsely = pair.logit(&evidence.features(voxel));
    let seen = evidence.detail.as_ref().filter(|_| is_looked_at_closely(coarsely));
    detail.zip(seen).map_or(coarsely, |(of, seen)| of.logit(&seen.features(coarsely, voxel)))
}

/// The verifier that ships with the product.
#[must_use]
#[expect(clippy::expect_used, reason = "the weights are part of the binary, and a test reads them")]
pub fn shipped_verifier() -> Arc<Verifier> {
    static SHIPPED: LazyLock<Arc<Verifier>> = LazyLock::new(|| {
        Arc::new(
            Verifier::parse(include_str!("verifier.json"))
                .expect("the shipped weights are checked by a test"),
        )
    });
    Arc::clone(&SHIPPED)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_shipped_weights_fit_the_features() {
        let verifier = shipped_verifier();
        assert!(verifier.pair.fits(FEATURES) && verifier.triplet.fits(TRIPLET_FEATURES));
    }

    #[test]
    fn what_shows_at_half_the_voxel_counts_where_a_pose_is_likely_enough() {
        let shipped = shipped_verifier();
        assert!(shipped.detail.as_ref().is_some_and(|of| of.fits(DETAIL_FEATURES)));
        let counts = |inliers, violations| Counts {
            points: 4000,
            inliers,
            tight: inliers / 2,
            violations,
            plane_square: 0.4,
            ..Counts::default()
        };
        let likely = Evidence {
            b_on_a: counts(2400, 0),
            a_on_b: counts(2400, 0),
            consensus: 72.0,
            match_inliers: 120,
            matches: 300,
            range_images: 2,
            ..Evidence::default()
        };
        let both = counts(300, 2000);
        let bad = Detail { b_on_a: both, a_on_b: both, stands_for: [1; 2], ..Detail::default() };
        let gain = |of: &Verifier, evidence: &Evidence| {
            let closely = Evidence { detail: Some(bad), ..*evidence };
            of.pair_logit(&closely, 0.05) - of.pair_logit(evidence, 0.05)
        };
        assert!(gain(&shipped, &likely) < -2.0, "{}", gain(&shipped, &likely));
        let unlikely = Evidence { b_on_a: both, a_on_b: both, match_inliers: 3, consensus: 2.0, ..likely };
        assert!(shipped.pair_logit(&unlikely, 0.05) < CLOSELY);
        assert_eq!(gain(&shipped, &unlikely), 0.0);
        let without = Verifier { detail: None, ..Verifier::clone(&shipped) };
        assert_eq!(gain(&without, &likely), 0.0);
        let mut other = Verifier::clone(&shipped);
        other.detail.as_mut().unwrap().weights.pop();
        let error = Verifier::parse(&serde_json::to_string(&other).unwrap()).unwrap_err();
        assert!(error.to_string().starts_with("the detail regression does not take 15"), "{error}");
    }

    #[test]
    fn weights_for_other_features_are_refused() {
        let mut other = Verifier::clone(&shipped_verifier());
        let written = serde_json::to_string(&other).unwrap();
        assert_eq!(Verifier::parse(&written).unwrap(), other);
        other.triplet.weights.pop();
        let error = Verifier::parse(&serde_json::to_string(&other).unwrap()).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the triplet regression does not take 5 features with a weight for each term"
        );
        assert!(matches!(Verifier::parse("{}"), Err(VerifierError::Form(_))));
    }

    #[test]
    fn colours_lower_the_odds_of_a_pose_that_they_contradict_and_never_raise_them() {
        let logit =
            |appearance| shipped_verifier().pair_logit(&Evidence { appearance, ..Evidence::default() }, 0.05);
        let seen = |correlation| Some(Appearance { correlation, by_chance: 0.05 });
        assert!((logit(seen(0.9)) - logit(None)).abs() < 1e-12);
        assert!(logit(seen(0.3)) < logit(None) - 1.0);
        assert!((logit(seen(-1.0)) - logit(None) + MOST_AGAINST).abs() < 1e-12);
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
            appearance: None,
            detail: None,
        };
        let logit = |e: Evidence| shipped_verifier().pair.logit(&e.features(0.05));
        assert!(logit(evidence(good, 120)) > 2.0);
        assert!(logit(evidence(bad, 9)) < -2.0);
    }
}
