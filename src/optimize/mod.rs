//! Adjusts the poses of many scans at once. Uses `geometry` and `control`; used by `mapping` and `baseline`.
//!
//! Every adjustment is one energy over poses on a sparse system of 6x6 blocks ([`BlockSystem`]), a row of blocks a scan. All but the
//! averaging minimise it by the same Levenberg-Marquardt ([`minimise`]):
//!
//! - [`adjust_bundle`]: landmarks seen by several scans; the landmarks are eliminated exactly;
//! - [`adjust_pose_graph`]: relative poses of pairs, of which some are wrong (graduated non-convexity);
//! - [`average_rotations`], then [`average_translations`]: poses from relative poses in two steps, the rotations alone first, as the
//!   global strategies of the literature do;
//! - [`adjust_dense`]: point-to-plane distances of all overlapping pairs, with landmarks to hold what planes leave free.
//!
//! Conventions: energies are `sum w rho(|r|^2)` with residuals r in metres and dimensionless weights w outside the
//! kernel, so that a kernel's scale always is a length; perturbations act on the left of `model_from_scan`; held scans
//! come back bit for bit. Sums over parallel parts run in a fixed order and the factorisation is sequential, so results
//! do not depend on the number of threads.

mod averaging;
mod block_solver;
mod block_system;
mod bundle_adjustment;
mod chunks;
mod dense_pair;
mod dense_sums;
mod gauge;
mod joint_dense;
mod landmark_terms;
mod levenberg_marquardt;
mod option_error;
mod pose_graph;
mod rotation_averaging;
#[cfg(test)]
mod test_scene;
mod translation_averaging;
mod twist;
mod uncertainty;

pub use averaging::{Averaged, AveragingError, AveragingOptions};
pub use block_solver::{BlockSolver, BlockSolverError};
pub use block_system::BlockSystem;
pub use bundle_adjustment::{BundleAdjustment, BundleError, BundleOptions, adjust_bundle};
pub use dense_sums::Correspondence;
pub use joint_dense::{
    Correspondences, DenseAdjustment, DenseError, DenseOptions, DenseProblem, DenseRound, adjust_dense,
};
pub use landmark_terms::{Observation, Track, TrackError};
pub use levenberg_marquardt::{
    MinimiseError, MinimiseOptions, Minimum, Problem, Report, Termination, minimise,
};
pub use option_error::OptionError;
pub use pose_graph::{
    EdgeMetric, PoseEdge, PoseGraphAdjustment, PoseGraphError, PoseGraphOptions, adjust_pose_graph,
};
pub use rotation_averaging::{RotationEdge, average_rotations};
pub use translation_averaging::{TranslationEdge, average_translations};
pub use uncertainty::{PrincipalMotion, principal_motions};
