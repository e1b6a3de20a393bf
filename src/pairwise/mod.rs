//! Two scans: matching, consensus, hypotheses, dense and free-space verification, refinement of the pair.

mod pair;

pub use pair::{PairKey, PairResult};
