//! What matching one pair of scans found.

use serde::{Deserialize, Serialize};

use crate::cloud::ScanKey;

/// An unordered pair of scans: `a < b`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct PairKey {
    /// The smaller key.
    pub a: ScanKey,
    /// The larger key.
    pub b: ScanKey,
}

/// Matches and verified hypotheses of one pair: a pure function of two prepared scans.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PairResult {
    /// Which pair.
    pub pair: PairKey,
}
