//! What was computed about pairs of scans and is asked for again and again while a model grows. Only what follows from the scans may be kept: a
//! kept answer is the one that computing it anew would give.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::cloud::ScanKey;
use crate::pairwise::PairKey;

/// An answer about each pair. Clones share it.
#[derive(Debug)]
pub(super) struct Memo<V> {
    known: Arc<Mutex<BTreeMap<PairKey, V>>>,
}

impl<V> Default for Memo<V> {
    fn default() -> Self {
        Self { known: Arc::default() }
    }
}

impl<V> Clone for Memo<V> {
    fn clone(&self) -> Self {
        Self { known: Arc::clone(&self.known) }
    }
}

impl<V: Copy> Memo<V> {
    fn known(&self) -> MutexGuard<'_, BTreeMap<PairKey, V>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The answer about a pair: the one that is known, or one that is computed now. Several threads may compute at once.
    pub fn answer(&self, pair: PairKey, compute: impl FnOnce() -> V) -> V {
        let known = self.known().get(&pair).copied();
        known.unwrap_or_else(|| {
            let computed = compute();
            self.known().insert(pair, computed);
            computed
        })
    }

    /// Forgets all pairs of a scan.
    pub fn forget(&self, scan: ScanKey) {
        self.known().retain(|pair, _| pair.a != scan && pair.b != scan);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_answer_is_computed_once_until_its_scan_is_gone() {
        let memo: Memo<u32> = Memo::default();
        let pair = PairKey::of(ScanKey(1), ScanKey(2));
        let shared = memo.clone();
        assert_eq!(memo.answer(pair, || 5), 5);
        assert_eq!(shared.answer(pair, || 6), 5);
        memo.forget(ScanKey(3));
        assert_eq!(memo.answer(pair, || 7), 5);
        memo.forget(ScanKey(2));
        assert_eq!(shared.answer(pair, || 7), 7);
    }
}
