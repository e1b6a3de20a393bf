//! What others do with a scan graph, to be measured against: a maximum spanning tree, and global averaging over all edges. Both take each
//! edge's best hypothesis at its word where its score says that it is likelier right than wrong; neither looks at the scans again, and
//! neither refines. Uses `graph` and `optimize`; used by the benchmark of the command line.

mod global;
mod spanning_tree;

pub use global::{GlobalOptions, global};
pub use spanning_tree::spanning_tree;

use std::collections::BTreeMap;

use crate::cloud::ScanKey;
use crate::geometry::Pose;

/// Scans that hang together: `model_from_scan` of each, points of the scan's own frame, metres. Frames of different pieces are
/// unrelated.
pub type Piece = BTreeMap<ScanKey, Pose>;

/// Largest pieces first, ties by their first scan.
fn sort(pieces: &mut [Piece]) {
    pieces.sort_by(|x, y| y.len().cmp(&x.len()).then_with(|| x.keys().next().cmp(&y.keys().next())));
}

#[cfg(test)]
mod test_graph;
