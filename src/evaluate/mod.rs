//! How good an estimate is: registration recall of the 3DMatch benchmarks, cumulative error curves, and placement
//! against known poses. Pure functions of texts and poses; uses [`crate::geometry`] only. Used by the command line and
//! by tests.

mod against_truth;
mod ecdf;
mod edges;
mod estimate;
mod overlap;
mod recall;

pub use against_truth::{ComponentReport, Tolerance, TruthReport, WrongScan, against_truth};
pub use ecdf::{Ecdf, EcdfStep, ROTATION_STEPS_DEG, TRANSLATION_STEPS_M, ecdf};
pub use edges::{ClaimedEdge, EdgeFigures, edge_figures};
pub use estimate::{Estimate, EstimateError, PlacedScan};
pub use overlap::{Overlap, SurfaceAtTruth, overlaps};
pub use recall::{Recall, RecallError, benchmark_index, recall};
