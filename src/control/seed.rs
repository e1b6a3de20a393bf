//! Random numbers that depend on what they are for, never on when or where they are drawn.

use rand::SeedableRng;
use serde::{Deserialize, Serialize};

/// The generator of every random choice in the core.
pub type SeedRng = rand_pcg::Pcg64Mcg;

/// The root of all random choices of a project or a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, Serialize, Deserialize)]
pub struct Seed(pub u64);

impl Seed {
    /// A generator for one purpose and one subject: the same for the same (seed, purpose, subject) on every
    /// thread and platform, and unrelated for different ones.
    #[must_use]
    pub fn derive(self, purpose: &str, subject: u128) -> SeedRng {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&self.0.to_le_bytes());
        hasher.update(&subject.to_le_bytes());
        hasher.update(purpose.as_bytes());
        let mut seed = [0; 16];
        seed.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
        SeedRng::from_seed(seed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    #[test]
    fn the_same_purpose_and_subject_draw_the_same_numbers_and_others_do_not() {
        let draw = |seed: u64, purpose: &str, subject| Seed(seed).derive(purpose, subject).next_u64();
        assert_eq!(draw(1, "keypoints", 7), draw(1, "keypoints", 7));
        assert_ne!(draw(1, "keypoints", 7), draw(2, "keypoints", 7));
        assert_ne!(draw(1, "keypoints", 7), draw(1, "keypoints", 8));
        assert_ne!(draw(1, "keypoints", 7), draw(1, "consensus", 7));
    }
}
