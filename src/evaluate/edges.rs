//! Precision and recall of relative poses of pairs: how many that were claimed are right, and how many true pairs were found.

use std::collections::BTreeSet;

use nalgebra::Vector3;
use serde::Serialize;

use super::{Estimate, Tolerance};
use crate::geometry::Pose;

/// A relative pose that somebody vouches for.
#[derive(Debug, Clone, PartialEq)]
pub struct ClaimedEdge {
    /// Name of a scan.
    pub i: String,
    /// Name of another scan.
    pub j: String,
    /// Maps points of scan j into scan i, each in its own frame; metres.
    pub i_from_j: Pose,
    /// Where the distance from the truth is measured: the middle of scan j, in its own frame, metres.
    pub centre_in_j: Vector3<f64>,
}

/// Precision and recall.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EdgeFigures {
    /// Edges claimed between scans that the truth knows.
    pub claimed: usize,
    /// Of those, the ones within the tolerance.
    pub right: usize,
    /// Pairs that truly overlap.
    pub true_pairs: usize,
    /// Of those, the ones that a right edge was claimed for.
    pub found: usize,
    /// `right / claimed`, or `None` without edges.
    pub precision: Option<f64>,
    /// `found / true_pairs`, or `None` without true pairs.
    pub recall: Option<f64>,
}

/// Compares edges with the true poses; a component of the truth is a place of its own, and an edge between two is wrong.
/// `true_pairs` holds names in either order.
#[must_use]
pub fn edge_figures(
    edges: &[ClaimedEdge],
    truth: &Estimate,
    true_pairs: &BTreeSet<(String, String)>,
    tolerance: Tolerance,
) -> EdgeFigures {
    let (mut claimed, mut right) = (0, 0);
    let mut found: BTreeSet<(&str, &str)> = BTreeSet::new();
    for edge in edges {
        let (Some(i), Some(j)) = (truth.find(&edge.i), truth.find(&edge.j)) else { continue };
        claimed += 1;
        let true_i_from_j = i.model_from_scan.inverse() * j.model_from_scan;
        let off = edge.i_from_j.transform(&edge.centre_in_j) - true_i_from_j.transform(&edge.centre_in_j);
        let angle = true_i_from_j.difference(&edge.i_from_j).0;
        if i.component == j.component && tolerance.holds((angle, off.norm())) {
            right += 1;
            found.insert((&edge.i, &edge.j));
        }
    }
    let is_found = |pair: &&(String, String)| {
        let (i, j) = (pair.0.as_str(), pair.1.as_str());
        found.contains(&(i, j)) || found.contains(&(j, i))
    };
    let found = true_pairs.iter().filter(is_found).count();
    let share = |part: usize, whole: usize| (whole > 0).then(|| part as f64 / whole as f64);
    EdgeFigures {
        claimed,
        right,
        true_pairs: true_pairs.len(),
        found,
        precision: share(right, claimed),
        recall: share(found, true_pairs.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::PlacedScan;

    #[test]
    fn right_edges_count_for_both_and_edges_between_places_for_neither() {
        let mut truth = Estimate::default();
        for (index, name) in ["a", "b", "c", "d"].into_iter().enumerate() {
            let at = Vector3::new(index as f64, 0.0, 0.0);
            let component = if name == "d" { "other" } else { "here" }.to_owned();
            let placed = PlacedScan { model_from_scan: Pose::from_translation(at), component };
            truth.placed.insert(name.to_owned(), placed);
        }
        let edge = |i: &str, j: &str, x: f64| ClaimedEdge {
            i: i.to_owned(),
            j: j.to_owned(),
            i_from_j: Pose::from_translation(Vector3::new(x, 0.0, 0.0)),
            centre_in_j: Vector3::zeros(),
        };
        let pair = |i: &str, j: &str| (i.to_owned(), j.to_owned());
        let true_pairs = BTreeSet::from([pair("b", "a"), pair("b", "c")]);
        let edges = [edge("a", "b", 1.1), edge("b", "c", 1.4), edge("c", "d", 1.0), edge("a", "x", 0.0)];
        let figures = edge_figures(&edges, &truth, &true_pairs, Tolerance::default());
        assert_eq!((figures.claimed, figures.right, figures.found), (3, 1, 1));
        assert_eq!((figures.precision, figures.recall), (Some(1.0 / 3.0), Some(0.5)));
        let none = edge_figures(&[], &truth, &BTreeSet::new(), Tolerance::default());
        assert_eq!((none.precision, none.recall), (None, None));
    }
}
