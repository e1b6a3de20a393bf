//! The maximum spanning tree: of every loop the least likely edge is left out, and poses are chained along the rest. The baseline of
//! nearly every paper.

use std::collections::{BTreeMap, BTreeSet};

use super::{Piece, sort};
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// Chains the best hypotheses of the edges that a maximum spanning tree by score takes, among edges with a score above `least_score`
/// (log-odds; 0 where right and wrong are equally likely). Scans without such an edge are in no piece.
#[must_use]
pub fn spanning_tree(graph: &ScanGraph, least_score: f64) -> Vec<Piece> {
    let mut pieces = local_trees(graph, least_score);
    for piece in &mut pieces {
        for (key, model_from_local) in piece.iter_mut() {
            if let Some(scan) = graph.scan(*key) {
                *model_from_local = *model_from_local * scan.prepared.local_from_scan();
            }
        }
    }
    pieces
}

/// The same with poses of the scans' local frames; the first scan of each piece is at identity.
pub(super) fn local_trees(graph: &ScanGraph, least_score: f64) -> Vec<Piece> {
    let mut ranked: Vec<_> = graph.edges().filter(|edge| edge.best_score() > least_score).collect();
    ranked.sort_by(|x, y| y.best_score().total_cmp(&x.best_score()).then(x.pair.cmp(&y.pair)));
    let mut piece_of: BTreeMap<ScanKey, ScanKey> = graph.scans().map(|s| (s.key(), s.key())).collect();
    let mut tree: BTreeMap<ScanKey, Vec<(ScanKey, Pose)>> = BTreeMap::new();
    for edge in ranked {
        let (a, b) = (edge.pair.a, edge.pair.b);
        let (Some(best), Some(&of_a), Some(&of_b)) =
            (edge.hypotheses.first(), piece_of.get(&a), piece_of.get(&b))
        else {
            continue;
        };
        if of_a == of_b {
            continue;
        }
        for piece in piece_of.values_mut().filter(|piece| **piece == of_b) {
            *piece = of_a;
        }
        let a_from_b = best.hypothesis.a_from_b;
        tree.entry(a).or_default().push((b, a_from_b));
        tree.entry(b).or_default().push((a, a_from_b.inverse()));
    }
    let mut done: BTreeSet<ScanKey> = BTreeSet::new();
    let mut pieces = Vec::new();
    for &root in tree.keys() {
        if !done.insert(root) {
            continue;
        }
        let mut piece = Piece::from([(root, Pose::identity())]);
        let mut open = vec![(root, Pose::identity())];
        while let Some((at, model_from_at)) = open.pop() {
            for &(next, at_from_next) in tree.get(&at).into_iter().flatten() {
                if done.insert(next) {
                    let model_from_next = (model_from_at * at_from_next).renormalised();
                    piece.insert(next, model_from_next);
                    open.push((next, model_from_next));
                }
            }
        }
        pieces.push(piece);
    }
    sort(&mut pieces);
    pieces
}

#[cfg(test)]
mod tests {
    use super::super::test_graph::{TestGraph, worst};
    use super::*;

    #[test]
    fn the_likeliest_edges_are_chained_and_a_wrong_one_in_a_loop_is_left_out() {
        let mut scene = TestGraph::ring(6);
        scene.spoil(2, 1.0);
        let pieces = spanning_tree(&scene.graph(), 0.0);
        assert_eq!(pieces.len(), 1);
        assert_eq!(pieces[0].len(), 6);
        assert!(worst(&pieces[0], &scene) < 1e-9, "{}", worst(&pieces[0], &scene));
    }

    #[test]
    fn the_wrong_edge_is_taken_when_it_looks_likeliest() {
        let mut scene = TestGraph::ring(6);
        scene.spoil(2, 9.0);
        assert!(worst(&spanning_tree(&scene.graph(), 0.0)[0], &scene) > 0.5);
    }

    #[test]
    fn unlikely_edges_hold_nothing_together() {
        let mut scene = TestGraph::ring(6);
        for edge in (0..scene.edges()).filter(|edge| scene.crosses(*edge, 3)).collect::<Vec<_>>() {
            scene.score(edge, -0.1);
        }
        let pieces = spanning_tree(&scene.graph(), 0.0);
        assert_eq!(pieces.iter().map(Piece::len).collect::<Vec<_>>(), [3, 3]);
        assert_eq!(spanning_tree(&scene.graph(), -0.5).len(), 1);
    }
}
