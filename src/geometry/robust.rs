//! Robust kernels: how much a residual may cost, and so how much a wrong correspondence may pull.
//!
//! Used by every adjustment in `optimize`, by pairwise refinement and by pooled fits. Each kernel is a function
//! `rho(s)` of the *squared* residual s (metres squared) with `rho(0) = 0` and `rho'(0) = 1`, so that small residuals
//! cost the same under all of them and a weighted least-squares step with weights `rho'(s)` descends on `sum rho`.

use serde::{Deserialize, Serialize};

/// A robust kernel; its scale c is in the unit of the residual (metres).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kernel {
    /// `s`: plain least squares.
    Squared,
    /// `2 c sqrt(s) - c^2` beyond c: convex, an outlier pulls with constant force.
    Huber(f64),
    /// `c^2 ln(1 + s / c^2)`: an outlier's force falls as 1 / r.
    Cauchy(f64),
    /// `c^2 s / (c^2 + s)`: bounded by c^2, an outlier's force falls as 1 / r^3.
    GemanMcClure(f64),
    /// `c^2 / 3 (1 - (1 - s / c^2)^3)` up to c, constant beyond: an outlier pulls not at all.
    Tukey(f64),
}

impl Kernel {
    /// The cost of a squared residual `s >= 0`: grows with s, never above it.
    #[must_use]
    pub fn rho(self, s: f64) -> f64 {
        match self {
            Self::Squared => s,
            Self::Huber(c) if s <= c * c => s,
            Self::Huber(c) => c * (2.0 * s.sqrt() - c),
            Self::Cauchy(c) => c * c * (s / (c * c)).ln_1p(),
            Self::GemanMcClure(c) => c * c * s / (c * c + s),
            Self::Tukey(c) => {
                let outside = (1.0 - s / (c * c)).max(0.0);
                c * c / 3.0 * (1.0 - outside.powi(3))
            }
        }
    }

    /// `rho'(s)`, the weight of a squared residual in iteratively reweighted least squares, in [0, 1].
    #[must_use]
    pub fn weight(self, s: f64) -> f64 {
        match self {
            Self::Squared => 1.0,
            Self::Huber(c) if s <= c * c => 1.0,
            Self::Huber(c) => c / s.sqrt(),
            Self::Cauchy(c) => 1.0 / (1.0 + s / (c * c)),
            Self::GemanMcClure(c) => (c * c / (c * c + s)).powi(2),
            Self::Tukey(c) => (1.0 - s / (c * c)).max(0.0).powi(2),
        }
    }

    /// [`Kernel::rho`] and [`Kernel::weight`] of several squared residuals.
    #[must_use]
    #[inline]
    pub fn of_each<const N: usize>(self, squares: &[f64; N]) -> ([f64; N], [f64; N]) {
        if let Self::GemanMcClure(c) = self {
            // Both are made of the same division.
            let shares = squares.map(|s| c * c / (c * c + s));
            let mut costs = *squares;
            costs.iter_mut().zip(&shares).for_each(|(cost, share)| *cost *= share);
            return (costs, shares.map(|share| share * share));
        }
        (squares.map(|s| self.rho(s)), squares.map(|s| self.weight(s)))
    }

    /// The scale c in metres, or `None` for [`Kernel::Squared`], which has none.
    #[must_use]
    pub fn scale(self) -> Option<f64> {
        match self {
            Self::Squared => None,
            Self::Huber(c) | Self::Cauchy(c) | Self::GemanMcClure(c) | Self::Tukey(c) => Some(c),
        }
    }

    /// The same kind of kernel with another scale in metres.
    #[must_use]
    pub fn with_scale(self, c: f64) -> Self {
        match self {
            Self::Squared => Self::Squared,
            Self::Huber(_) => Self::Huber(c),
            Self::Cauchy(_) => Self::Cauchy(c),
            Self::GemanMcClure(_) => Self::GemanMcClure(c),
            Self::Tukey(_) => Self::Tukey(c),
        }
    }

    /// Whether the scale, if there is one, is a positive finite number.
    #[must_use]
    pub fn is_valid(self) -> bool {
        self.scale().is_none_or(|c| c > 0.0 && c.is_finite())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn kernels() -> impl Strategy<Value = Kernel> {
        (0..5, 0.01..10.0f64).prop_map(|(kind, c)| match kind {
            0 => Kernel::Squared,
            1 => Kernel::Huber(c),
            2 => Kernel::Cauchy(c),
            3 => Kernel::GemanMcClure(c),
            _ => Kernel::Tukey(c),
        })
    }

    proptest! {
        #[test]
        fn the_weight_is_the_derivative_of_the_cost(kernel in kernels(), u in 0.0..20.0f64) {
            let c = kernel.scale().unwrap_or(1.0);
            let (s, h) = (u * c * c + 1e-3 * c * c, 1e-6 * c * c);
            let numeric = (kernel.rho(s + h) - kernel.rho(s - h)) / (2.0 * h);
            prop_assert!((numeric - kernel.weight(s)).abs() < 1e-6, "{numeric} is not {}", kernel.weight(s));
        }

        #[test]
        fn the_cost_starts_at_zero_with_slope_one_and_stays_below_the_square(kernel in kernels(), s in 0.0..100.0f64) {
            prop_assert_eq!(kernel.rho(0.0), 0.0);
            prop_assert_eq!(kernel.weight(0.0), 1.0);
            prop_assert!(kernel.rho(s) <= s * (1.0 + 1e-12));
        }

        #[test]
        fn the_cost_grows_and_the_weight_falls_with_the_residual(kernel in kernels(), s in 0.0..50.0f64, more in 0.0..50.0f64) {
            prop_assert!(kernel.rho(s + more) >= kernel.rho(s) * (1.0 - 1e-12));
            prop_assert!(kernel.weight(s + more) <= kernel.weight(s));
            prop_assert!((0.0..=1.0).contains(&kernel.weight(s)));
        }

        /// Why reweighted least squares descends: the cost lies below its tangent in s.
        #[test]
        fn the_cost_is_concave_in_the_squared_residual(kernel in kernels(), s in 0.0..50.0f64, other in 0.0..50.0f64) {
            let tangent = kernel.rho(s) + kernel.weight(s) * (other - s);
            prop_assert!(kernel.rho(other) <= tangent + 1e-9);
        }
    }

    #[test]
    fn only_positive_finite_scales_are_valid() {
        assert!(Kernel::Squared.is_valid() && Kernel::Tukey(0.1).is_valid());
        for c in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            assert!(!Kernel::Cauchy(1.0).with_scale(c).is_valid());
        }
    }
}
