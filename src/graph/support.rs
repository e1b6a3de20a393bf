//! What third scans say: a hypothesis i <- j is supported by every k for which some i <- k <- j leads to the same place.

use std::sync::Arc;

use super::scan_graph::{Edge, ScanGraph, Supported};
use crate::geometry::Pose;
use crate::pairwise::{TRIPLET_FEATURES, Verifier, centred_difference, shipped_verifier};

/// What stands for the log-odds of a rival when there is none.
const NO_RIVAL: f64 = -12.0;

/// Paths take account of how rare right poses are this many times over: third scans that see the same surfaces repeat each other's mistakes, and the
/// rarer right poses are, the more of what they repeat is wrong.
const PATHS: f64 = 2.0;

/// Who judges pairs, when two motions agree, and when they are rivals. Angles in radians, distances in voxels at the moved scan's centroid.
#[derive(Debug, Clone, PartialEq)]
pub struct SupportOptions {
    /// A path agrees with a hypothesis within this angle …
    pub agree_angle: f64,
    /// … and this distance.
    pub agree_voxels: f64,
    /// A different pose of the same pair is a rival beyond this angle …
    pub rival_angle: f64,
    /// … or this distance.
    pub rival_voxels: f64,
    /// Hypotheses less likely than this are no part of a path.
    pub least_likelihood: f64,
    /// The regressions on pairs and on the result, by default the shipped ones.
    pub verifier: Arc<Verifier>,
}

impl Default for SupportOptions {
    fn default() -> Self {
        Self {
            agree_angle: 8.0_f64.to_radians(),
            agree_voxels: 4.0,
            rival_angle: 14.0_f64.to_radians(),
            rival_voxels: 7.0,
            least_likelihood: 0.02,
            verifier: shipped_verifier(),
        }
    }
}

/// What third scans say of one hypothesis.
#[derive(Debug, Clone, Copy, Default)]
struct Paths {
    /// Sum over third scans of the likelihood of the best path that agrees.
    agreeing: f64,
    /// Sum over third scans of the likelihood of the best path, if it is better than the best that agrees: without it a pair that no
    /// third scan can judge would look like one that all contradict.
    opposing: f64,
}

/// What log-odds are raised by for what is known of the whole project.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Corrections {
    /// Nothing.
    Ignored,
    /// The correction of each edge.
    Counted,
}

impl Corrections {
    fn of_pair(self, edge: &Edge) -> f64 {
        match self {
            Self::Ignored => 0.0,
            Self::Counted => edge.correction,
        }
    }

    fn of_path(self, edge: &Edge, graph: &ScanGraph) -> f64 {
        match self {
            Self::Ignored => 0.0,
            Self::Counted => edge.correction + (PATHS - 1.0) * graph.correction(),
        }
    }
}

/// (support, score with triplets) of each hypothesis of an edge, in the edge's order.
pub(super) fn support(
    graph: &ScanGraph,
    edge: &Edge,
    corrections: Corrections,
    options: &SupportOptions,
) -> Vec<(f64, f64)> {
    let supports = path_support(graph, edge, corrections, options);
    (0..edge.hypotheses.len())
        .map(|h| {
            let features = features_of(graph, edge, &supports, h, options);
            (supports[h].agreeing, options.verifier.triplet.logit(&features) + corrections.of_pair(edge))
        })
        .collect()
}

/// The features of the regression with triplets for each hypothesis of an edge: the pair's log-odds, log support, the same of the best
/// different pose of the pair, and log opposition. Nothing is corrected: how rare right poses are is part of what is fitted.
#[must_use]
pub fn triplet_features(
    graph: &ScanGraph,
    edge: &Edge,
    options: &SupportOptions,
) -> Vec<[f64; TRIPLET_FEATURES]> {
    let supports = path_support(graph, edge, Corrections::Ignored, options);
    (0..edge.hypotheses.len()).map(|h| features_of(graph, edge, &supports, h, options)).collect()
}

fn features_of(
    graph: &ScanGraph,
    edge: &Edge,
    supports: &[Paths],
    h: usize,
    options: &SupportOptions,
) -> [f64; TRIPLET_FEATURES] {
    let log = |support: f64| (0.01 + support).ln();
    let me = &edge.hypotheses[h].hypothesis;
    let mut rival = (NO_RIVAL, log(0.0));
    if let Some(b) = graph.scan(edge.pair.b) {
        for (other, support) in edge.hypotheses.iter().zip(supports) {
            let (angle, distance) = centred_difference(&me.a_from_b, &other.hypothesis.a_from_b, &b.centroid);
            let differs =
                angle > options.rival_angle || distance > options.rival_voxels * b.prepared.resolution;
            if differs {
                rival = (rival.0.max(other.hypothesis.logit), rival.1.max(log(support.agreeing)));
            }
        }
    }
    [me.logit, log(supports[h].agreeing), rival.0, rival.1, log(supports[h].opposing)]
}

fn likelihood(h: &Supported, correction: f64) -> f64 {
    1.0 / (1.0 + (-h.hypothesis.logit - correction).exp())
}

fn path_support(
    graph: &ScanGraph,
    edge: &Edge,
    corrections: Corrections,
    options: &SupportOptions,
) -> Vec<Paths> {
    let (a, b) = (edge.pair.a, edge.pair.b);
    let mut supports = vec![Paths::default(); edge.hypotheses.len()];
    let Some(scan_b) = graph.scan(b) else { return supports };
    let reach = options.agree_voxels * scan_b.prepared.resolution;
    for k in graph.neighbors(a).filter(|k| *k != b) {
        let (Some(first), Some(second)) = (graph.edge(a, k), graph.edge(k, b)) else { continue };
        let legs = |edge: &Edge, from| -> Vec<(Pose, f64)> {
            edge.motions_from(from)
                .map(|(motion, h)| (motion, likelihood(h, corrections.of_path(edge, graph))))
                .filter(|(_, p)| *p > options.least_likelihood)
                .collect()
        };
        let (a_from_k, k_from_b) = (legs(first, k), legs(second, b));
        let mut best = vec![0.0_f64; supports.len()];
        let mut most = 0.0_f64;
        for (a_from_k, p) in &a_from_k {
            for (k_from_b, q) in &k_from_b {
                most = most.max(p * q);
                let path = *a_from_k * *k_from_b;
                let end = path.transform(&scan_b.centroid);
                for (best, h) in best.iter_mut().zip(&edge.hypotheses) {
                    let direct = &h.hypothesis.a_from_b;
                    if p * q > *best
                        && (direct.transform(&scan_b.centroid) - end).norm() < reach
                        && (direct.inverse() * path).angle() < options.agree_angle
                    {
                        *best = p * q;
                    }
                }
            }
        }
        for (total, best) in supports.iter_mut().zip(best) {
            total.agreeing += best;
            if best < most {
                total.opposing += most;
            }
        }
    }
    supports
}
