//! The first pair of a component: one that a client joined, or the best edge of the most central scan that has a good one.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Vector3};

use super::options::{JoinLevel, MappingOptions};
use crate::cloud::ScanKey;
use crate::graph::{Edge, ScanGraph, harmonic_centrality, softplus};

/// An edge is well conditioned when its agreeing normals span all directions: the least eigenvalue of their second moment, of at
/// most 1/3.
const LEAST_NORMAL_SPREAD: f64 = 0.01;

/// Pairs of free scans that could start a component at this level, the best first: what a client joined, with or without an edge, then
/// central scans, then matches.
#[must_use]
pub fn initial_pairs(
    graph: &ScanGraph,
    free: &BTreeSet<ScanKey>,
    level: &JoinLevel,
    options: &MappingOptions,
) -> Vec<(ScanKey, ScanKey)> {
    let good: Vec<&Edge> = graph
        .edges()
        .filter(|e| free.contains(&e.pair.a) && free.contains(&e.pair.b))
        .filter(|e| edge_margin(e, options) >= level.support)
        .collect();
    let lengths: Vec<(ScanKey, ScanKey, f64)> =
        good.iter().map(|e| (e.pair.a, e.pair.b, 1.0 / f64::from(inliers(e).max(1)).ln_1p())).collect();
    let centrality = harmonic_centrality(&lengths);
    let of = |key: &ScanKey| centrality.get(key).copied().unwrap_or(0.0);
    let mut ranked: Vec<(f64, f64, &Edge)> = good
        .into_iter()
        .filter(|e| inliers(e) as usize >= level.initial_matches && well_conditioned(graph, e))
        .map(|e| (of(&e.pair.a).max(of(&e.pair.b)), f64::from(inliers(e)), e))
        .collect();
    ranked.sort_by(|x, y| y.0.total_cmp(&x.0).then(y.1.total_cmp(&x.1)).then(x.2.pair.cmp(&y.2.pair)));
    let found = ranked.into_iter().map(|(_, _, e)| {
        // The more central scan comes first: it becomes the gauge.
        if of(&e.pair.b) > of(&e.pair.a) { (e.pair.b, e.pair.a) } else { (e.pair.a, e.pair.b) }
    });
    let decided = options.decisions.joined_pairs().filter(|p| free.contains(&p.a) && free.contains(&p.b));
    decided.map(|p| (p.a, p.b)).chain(found).collect()
}

/// Evidence of the best hypothesis with the rival's share taken off.
fn edge_margin(edge: &Edge, options: &MappingOptions) -> f64 {
    let Some(best) = edge.hypotheses.first() else { return f64::NEG_INFINITY };
    let rival = edge.hypotheses.get(1).map_or(0.0, |h| softplus(h.score));
    softplus(best.score) - options.rival_share * rival
}

fn inliers(edge: &Edge) -> u32 {
    edge.hypotheses.first().map_or(0, |h| h.hypothesis.evidence.match_inliers)
}

/// Whether the normals of scan a that face the overlap hold all three directions.
fn well_conditioned(graph: &ScanGraph, edge: &Edge) -> bool {
    let (Some(a), Some(b), Some(best)) =
        (graph.scan(edge.pair.a), graph.scan(edge.pair.b), edge.hypotheses.first())
    else {
        return false;
    };
    let mut moment = Matrix3::zeros();
    let mut count = 0.0;
    for (in_a, _) in crate::pairwise::inlier_matches(a, b, &edge.matches, &best.hypothesis.a_from_b) {
        let normal = a.prepared.normals[a.prepared.keypoints[in_a as usize] as usize];
        let n: Vector3<f64> = Vector3::from(normal).cast();
        moment += n * n.transpose();
        count += 1.0;
    }
    count > 0.0 && (moment / count).symmetric_eigenvalues().min() > LEAST_NORMAL_SPREAD
}
