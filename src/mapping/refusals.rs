//! Joins that were weighed and refused, so that none is weighed again before what speaks for it has changed.

use std::collections::BTreeMap;

use super::join::Refusal;
use super::options::JoinLevel;
use crate::cloud::ScanKey;

/// Support that changes by a smaller share is what it was.
const SAME_SUPPORT: f64 = 0.05;

/// Two pieces, each known by its gauge or by the scan that it is, in either order; a piece that has grown keeps its gauge.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Link(ScanKey, ScanKey);

impl Link {
    /// Of two different pieces.
    #[must_use]
    pub fn between(x: ScanKey, y: ScanKey) -> Self {
        Self(x.min(y), x.max(y))
    }
}

/// A join that was weighed and not made.
#[derive(Debug, Clone, Copy)]
pub struct Refused {
    /// The support it had.
    pub support: f64,
    /// What the level asked for.
    pub needed: f64,
    /// Why.
    pub refusal: Refusal,
}

/// What was refused on sight of the surfaces: not worth another look until the support or the surfaces change.
#[derive(Debug, Clone, Default)]
pub struct Refusals(BTreeMap<Link, Refused>);

impl Refusals {
    /// Remembers the last refusal of a join.
    pub fn insert(&mut self, link: Link, refused: Refused) {
        self.0.insert(link, refused);
    }

    /// Why a join was not made when it was weighed last, if it was.
    #[must_use]
    pub fn get(&self, link: Link) -> Option<Refusal> {
        self.0.get(&link).map(|refused| refused.refusal)
    }

    /// Whether a join was refused on about this support by a level that asks for no more.
    #[must_use]
    pub fn still_holds(&self, link: Link, support: f64, level: &JoinLevel) -> bool {
        self.0.get(&link).is_some_and(|refused| {
            (support - refused.support).abs() < SAME_SUPPORT * refused.support.abs()
                && level.support >= refused.needed
        })
    }

    /// Forgets what was refused to a scan.
    pub fn forget(&mut self, scan: ScanKey) {
        self.0.retain(|Link(x, y), _| *x != scan && *y != scan);
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.0.clear();
    }
}

/// The refusal that says more: a violation or a rival over mere lack of support, and more support over less.
#[must_use]
pub fn more_telling(known: Option<Refusal>, new: Refusal) -> Option<Refusal> {
    match (known, new) {
        (Some(Refusal::Support { found, .. }), Refusal::Support { found: now, .. }) if now < found => known,
        (Some(Refusal::Contradicted { .. }), _)
        | (
            Some(
                Refusal::Violation { .. }
                | Refusal::Rival { .. }
                | Refusal::Indistinct { .. }
                | Refusal::Forbidden
                | Refusal::SinglePair { .. },
            ),
            Refusal::Support { .. },
        ) => known,
        _ => Some(new),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_refusal_holds_until_support_changes_or_less_is_asked() {
        let level = |support| JoinLevel { support, violation: 0.1, initial_matches: 0 };
        let link = Link::between(ScanKey(2), ScanKey(1));
        let refusal = Refusal::Rival { support: 6.0, rival: 5.0 };
        let mut refusals = Refusals::default();
        refusals.insert(link, Refused { support: 6.0, needed: 4.0, refusal });
        let same = Link::between(ScanKey(1), ScanKey(2));
        assert_eq!(refusals.get(same), Some(refusal));
        assert!(refusals.still_holds(same, 6.1, &level(4.0)));
        assert!(!refusals.still_holds(same, 7.0, &level(4.0)));
        assert!(!refusals.still_holds(same, 6.1, &level(2.0)));
        refusals.forget(ScanKey(2));
        assert_eq!(refusals.get(link), None);
    }

    #[test]
    fn mere_lack_of_support_does_not_hide_what_says_more() {
        let lack = |found| Refusal::Support { found, needed: 4.0 };
        let violation = Refusal::Violation { found: 0.2, allowed: 0.1 };
        assert_eq!(more_telling(Some(violation), lack(1.0)), Some(violation));
        assert_eq!(more_telling(Some(lack(1.0)), violation), Some(violation));
        assert_eq!(more_telling(Some(lack(2.0)), lack(1.0)), Some(lack(2.0)));
        assert_eq!(more_telling(None, lack(1.0)), Some(lack(1.0)));
    }
}
