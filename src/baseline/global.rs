//! Global registration: robust rotation averaging over all edges, then robust translation averaging, per connected piece.
//!
//! Chatterjee and Govindu (2013) for the rotations, started at the maximum spanning tree; translations the same way, with the displacement
//! of each edge taken at the centroid of the moved scan, where small errors of rotation move it least.

use nalgebra::{Rotation3, Vector3};

use super::spanning_tree::local_trees;
use super::{Piece, sort};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::{ScanGraph, softplus};
use crate::optimize::{
    AveragingError, AveragingOptions, RotationEdge, TranslationEdge, average_rotations, average_translations,
};

/// How edges are believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GlobalOptions {
    /// Edges count whose best hypothesis has a score (log-odds) above this.
    pub least_score: f64,
    /// Scale of the Geman-McClure kernel on rotations, radians.
    pub rotation_scale: f64,
    /// Scale of the Geman-McClure kernel on displacements, voxels.
    pub translation_voxels: f64,
}

impl Default for GlobalOptions {
    fn default() -> Self {
        Self { least_score: 0.0, rotation_scale: 5.0_f64.to_radians(), translation_voxels: 4.0 }
    }
}

/// One edge of a piece: scans as indices into it.
struct PieceEdge {
    i: usize,
    j: usize,
    i_from_j: Pose,
    centroid_in_j: Vector3<f64>,
    weight: f64,
}

/// Poses from all likely edges at once. Scans without one are in no piece; the first scan of each piece is at identity up to its own
/// origin. On `Err` the caller has cancelled.
pub fn global(
    graph: &ScanGraph,
    options: &GlobalOptions,
    control: Control<'_>,
) -> Result<Vec<Piece>, Cancelled> {
    let mut pieces = Vec::new();
    for tree in local_trees(graph, options.least_score) {
        let averaged = match averaged(graph, &tree, options, control) {
            Ok(averaged) => averaged,
            Err(AveragingError::Cancelled(cancelled)) => return Err(cancelled),
            // Equations that cannot be solved in this arithmetic: the tree, from which it started, is what there is.
            Err(_) => tree,
        };
        let in_own_frames = averaged.into_iter().filter_map(|(key, model_from_local)| {
            Some((key, model_from_local * graph.scan(key)?.prepared.local_from_scan()))
        });
        pieces.push(in_own_frames.collect());
    }
    sort(&mut pieces);
    Ok(pieces)
}

fn averaged(
    graph: &ScanGraph,
    tree: &Piece,
    options: &GlobalOptions,
    control: Control<'_>,
) -> Result<Piece, AveragingError> {
    let keys: Vec<ScanKey> = tree.keys().copied().collect();
    let edges = edges_within(graph, &keys, options.least_score);
    let voxel = graph.scans().next().map_or(1.0, |scan| scan.prepared.resolution);

    let start: Vec<Rotation3<f64>> = tree.values().map(|pose| pose.rotation).collect();
    let turns: Vec<RotationEdge> = edges
        .iter()
        .map(|e| RotationEdge { i: e.i, j: e.j, i_from_j: e.i_from_j.rotation, weight: e.weight })
        .collect();
    let settings = AveragingOptions::with_scale(options.rotation_scale);
    let rotations = average_rotations(&start, &turns, &settings, control)?.nodes;

    let start: Vec<Vector3<f64>> = tree.values().map(|pose| pose.translation).collect();
    let shifts: Vec<TranslationEdge> = edges
        .iter()
        .map(|e| {
            let centroid_in_i = e.i_from_j.transform(&e.centroid_in_j);
            let j_less_i = rotations[e.i] * centroid_in_i - rotations[e.j] * e.centroid_in_j;
            TranslationEdge { i: e.i, j: e.j, j_less_i, weight: e.weight }
        })
        .collect();
    let settings = AveragingOptions::with_scale(options.translation_voxels * voxel);
    let translations = average_translations(&start, &shifts, &settings, control)?.nodes;

    Ok(keys.into_iter().zip(rotations.into_iter().zip(translations).map(|(r, t)| Pose::new(r, t))).collect())
}

/// Likely edges between scans of a piece. `keys` are ascending.
fn edges_within(graph: &ScanGraph, keys: &[ScanKey], least_score: f64) -> Vec<PieceEdge> {
    graph
        .edges()
        .filter(|edge| edge.best_score() > least_score)
        .filter_map(|edge| {
            let best = edge.hypotheses.first()?;
            Some(PieceEdge {
                i: keys.binary_search(&edge.pair.a).ok()?,
                j: keys.binary_search(&edge.pair.b).ok()?,
                i_from_j: best.hypothesis.a_from_b,
                centroid_in_j: graph.scan(edge.pair.b)?.centroid,
                weight: softplus(best.score),
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::super::test_graph::{TestGraph, worst};
    use super::*;
    use crate::control::{CancelToken, Silent};

    fn solve(scene: &TestGraph) -> Vec<Piece> {
        let cancel = CancelToken::new();
        let control = Control { cancel: &cancel, observer: &Silent };
        global(&scene.graph(), &GlobalOptions::default(), control).unwrap()
    }

    #[test]
    fn edges_that_agree_outvote_a_wrong_one_that_looks_likelier() {
        let mut scene = TestGraph::ring(8);
        scene.spoil(3, 6.0);
        assert!(worst(&super::super::spanning_tree(&scene.graph(), 0.0)[0], &scene) > 0.5);
        let pieces = solve(&scene);
        assert_eq!(pieces.len(), 1);
        assert!(worst(&pieces[0], &scene) < 0.05, "{}", worst(&pieces[0], &scene));
    }

    #[test]
    fn pieces_without_a_likely_edge_between_them_stay_apart() {
        let mut scene = TestGraph::ring(8);
        for edge in 0..scene.edges() {
            if scene.crosses(edge, 4) {
                scene.score(edge, -2.0);
            }
        }
        let pieces = solve(&scene);
        assert_eq!(pieces.iter().map(Piece::len).collect::<Vec<_>>(), [4, 4]);
    }

    #[test]
    fn a_cancelled_caller_gets_nothing() {
        let cancel = CancelToken::new();
        cancel.cancel();
        let control = Control { cancel: &cancel, observer: &Silent };
        assert!(global(&TestGraph::ring(4).graph(), &GlobalOptions::default(), control).is_err());
    }
}
