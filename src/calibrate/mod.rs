//! How the verifier's weights are made: scenes with known truth are matched pair by pair, every hypothesis is labelled by the
//! truth, and logistic regressions are fitted on the evidence. What they say of scenes that they were not fitted on is
//! measured beside.
//!
//! 1. [`TrueScene`]: scans with known poses, simulated ([`simulated`]) or read by the caller.
//! 2. [`match_scene`]: all pairs are matched as the engine does, and each hypothesis gets a [`Label`].
//! 3. [`Fit`]: the regression on pairs; out of fold, its log-odds go into that on what shows at half the voxel, that one's into the scan graph, and
//!    the regression with triplets is fitted on what comes out. [`judge`] applies a verifier to a scene.
//! 4. [`Quality`], [`Reliability`]: how good and how honest predictions are.
//!
//! Uses [`crate::graph`], [`crate::pairwise`] and [`crate::simulate`]; used by `cairn calibrate`. The same inputs give the same
//! weights, bit for bit, at any number of threads.

mod fit;
mod label;
mod quality;
mod regression;
mod scene;
pub mod simulated;
mod view;

pub use fit::{Fit, FitError, Prediction, judge};
pub use label::{Label, LeftOut};
pub use quality::{Bin, Quality, Reliability};
pub use scene::{MatchedPair, MatchedScene, Placed, ScanOutline, SceneCounts, TrueScene, match_scene};
pub use view::View;
