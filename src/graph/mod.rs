//! The scan graph: which pairs were tried (retrieval), what they found (edges with several hypotheses each), and how third
//! scans and the frequency of right poses support or contradict each hypothesis. Uses `pairwise`; used by `mapping`.

mod base_rate;
mod centrality;
mod cohort;
mod memo;
mod retrieval;
mod scan_graph;
mod support;

pub use centrality::harmonic_centrality;
pub use retrieval::{Retrieval, retrieve};
pub use scan_graph::{Edge, ScanGraph, Supported, evidence, softplus};
pub use support::{SupportOptions, triplet_features};
