//! Random choices in the words a builder of scenes uses. Wraps the generator of [`crate::control::Seed`]; used by
//! everything here that is random.

use rand::RngExt;
use rand::seq::SliceRandom;

use crate::control::SeedRng;

/// A source of random choices.
pub(super) struct Draw(SeedRng);

impl Draw {
    pub(super) fn new(rng: SeedRng) -> Self {
        Self(rng)
    }

    /// Uniform in `[low, high)`; `low` when the interval is empty.
    pub(super) fn between(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low).max(0.0) * self.0.random::<f32>()
    }

    /// A whole number in `[low, high]`; `low` when the interval is empty.
    pub(super) fn count(&mut self, low: usize, high: usize) -> usize {
        self.0.random_range(low..=high.max(low))
    }

    /// True with probability `p`.
    pub(super) fn chance(&mut self, p: f32) -> bool {
        self.0.random::<f32>() < p
    }

    /// One of at least one item.
    pub(super) fn pick<T: Copy, const N: usize>(&mut self, items: [T; N]) -> T {
        const { assert!(N > 0) };
        items[self.0.random_range(0..N)]
    }

    /// An angle in `[0, 2 pi)`, radians.
    pub(super) fn angle(&mut self) -> f32 {
        self.between(0.0, std::f32::consts::TAU)
    }

    /// A standard normal number, by the Box-Muller transform.
    pub(super) fn normal(&mut self) -> f32 {
        // 1 - u lies in (0, 1], so the logarithm is finite.
        let radius = (-2.0 * (1.0 - self.0.random::<f32>()).ln()).sqrt();
        radius * (std::f32::consts::TAU * self.0.random::<f32>()).cos()
    }

    /// Puts the items into a random order.
    pub(super) fn shuffle<T>(&mut self, items: &mut [T]) {
        items.shuffle(&mut self.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;

    #[test]
    fn normal_numbers_have_mean_zero_and_variance_one() {
        let mut draw = Draw::new(Seed(3).derive("test", 0));
        let n = 40_000;
        let (sum, squares) = (0..n).fold((0.0f64, 0.0f64), |(sum, squares), _| {
            let x = f64::from(draw.normal());
            (sum + x, squares + x * x)
        });
        assert!((sum / f64::from(n)).abs() < 0.02);
        assert!((squares / f64::from(n) - 1.0).abs() < 0.03);
    }
}
