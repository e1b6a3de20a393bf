//! The same evidence as if sensor positions were not known. Every scene teaches all of these cases, since a scan may come
//! without one.

use crate::pairwise::{Counts, Evidence};

/// Whose range images are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum View {
    /// As they were.
    Full,
    /// Only that of the first scan of a pair.
    OneEyed,
    /// None.
    Blind,
}

impl View {
    /// All of them.
    pub const ALL: [Self; 3] = [Self::Full, Self::OneEyed, Self::Blind];

    /// How much of a scene's weight is on its examples seen like this.
    pub(super) fn weight(self) -> f64 {
        match self {
            Self::Full => 0.5,
            Self::OneEyed => 0.15,
            Self::Blind => 0.35,
        }
    }

    /// The evidence, less what cannot be known; `None` if that is a case of its own no more.
    pub(super) fn of(self, evidence: &Evidence) -> Option<Evidence> {
        let unseen = |counts: &Counts| Counts { violations: 0, on_seen_surface: 0, ..*counts };
        match self {
            Self::Full => Some(*evidence),
            Self::OneEyed => (evidence.range_images == 2).then(|| Evidence {
                a_on_b: unseen(&evidence.a_on_b),
                range_images: 1,
                // Finer surfaces come with a range image.
                detail: None,
                ..*evidence
            }),
            Self::Blind => (evidence.range_images > 0).then(|| Evidence {
                a_on_b: unseen(&evidence.a_on_b),
                b_on_a: unseen(&evidence.b_on_a),
                range_images: 0,
                detail: None,
                ..*evidence
            }),
        }
    }
}
