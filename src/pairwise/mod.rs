//! Two scans: matching, consensus, hypotheses, dense and free-space verification, refinement of the pair. Uses `features`;
//! used by `graph` and `mapping`.

mod appearance;
mod consensus;
mod contacts;
mod dense;
mod detail;
mod distinct;
mod gravity;
mod icp;
mod matching;
mod pair;
mod planar;
mod probe;
mod products;
mod second_look;
mod shortlist;
#[cfg(test)]
pub(crate) mod test_survey;
mod verifier;

pub use appearance::{Appearance, appearance};
pub use consensus::{Consensus, ConsensusOptions, INLIER_VOXELS, agreement, centred_difference, consensus};
pub(crate) use contacts::{Motion, meet};
pub use dense::{Counts, look, quick_overlap};
pub use detail::{DETAIL_FEATURES, Detail, detail};
pub use distinct::{Coinciding, coinciding};
pub use gravity::{is_level, is_upright};
pub use icp::{icp, perturbed_about};
pub use matching::{Match, mutual_matches};
pub use pair::{Hypothesis, PairKey, PairResult, inlier_matches, match_pair, match_pair_in_full};
pub use planar::planar_poses;
pub use probe::{Probe, probe};
pub use second_look::{is_clearly_worse, look_finely, look_leniently, preference};
pub use shortlist::shortlist;
pub use verifier::{
    Evidence, FEATURES, FittedScene, Logistic, Provenance, TRIPLET_FEATURES, Verifier, VerifierError,
    by_shape, is_looked_at_closely, shipped_verifier,
};
