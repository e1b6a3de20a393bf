//! How firmly the scans of a component hold together: the support that edges give to the poses as they are, and which scans an
//! adjustment threw off their edges.

use std::collections::BTreeMap;

use super::candidates::DECIDED;
use super::component::Component;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph, Supported, evidence};
use crate::pairwise::centred_difference;

/// An adjustment threw a scan when it keeps less than this share of its support …
const KEPT_SHARE: f64 = 0.5;
/// … and lost at least this much, or what the most lenient join asks for.
const LEAST_LOSS: f64 = 2.0;

/// The best hypothesis of an edge that agrees with a pose of its scans.
#[must_use]
pub fn agreeing<'g>(
    graph: &ScanGraph,
    edge: &'g Edge,
    a_from_b: &Pose,
    options: &MappingOptions,
) -> Option<&'g Supported> {
    let b = graph.scan(edge.pair.b)?;
    let reach = options.cluster_voxels * b.prepared.resolution;
    let agrees = |h: &&Supported| {
        let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, a_from_b, &b.centroid);
        angle < options.cluster_angle && distance < reach
    };
    edge.hypotheses.iter().filter(agrees).max_by(|x, y| x.score.total_cmp(&y.score))
}

/// The evidence of the best hypothesis of an edge that agrees with a pose of its scans.
#[must_use]
pub fn edge_support(graph: &ScanGraph, edge: &Edge, a_from_b: &Pose, options: &MappingOptions) -> f64 {
    agreeing(graph, edge, a_from_b, options).map_or(0.0, |h| evidence(h.score))
}

/// Support between all pairs of a component's scans at its poses; pairs without any are left out. What a client joined is firm.
#[must_use]
pub fn supports(
    graph: &ScanGraph,
    component: &Component,
    options: &MappingOptions,
) -> BTreeMap<(ScanKey, ScanKey), f64> {
    let mut found = BTreeMap::new();
    for (a, model_from_a) in &component.poses {
        for b in graph.neighbors(*a).filter(|b| b > a) {
            let (Some(model_from_b), Some(edge)) = (component.poses.get(&b), graph.edge(*a, b)) else {
                continue;
            };
            let support = edge_support(graph, edge, &(model_from_a.inverse() * *model_from_b), options);
            if support > 0.0 {
                found.insert((*a, b), support);
            }
        }
    }
    for pair in options.decisions.joined_pairs() {
        if component.poses.contains_key(&pair.a) && component.poses.contains_key(&pair.b) {
            found.insert((pair.a, pair.b), DECIDED);
        }
    }
    found
}

/// Support of each scan: the sum over its pairs.
#[must_use]
pub fn support_by_scan(
    graph: &ScanGraph,
    component: &Component,
    options: &MappingOptions,
) -> BTreeMap<ScanKey, f64> {
    let mut sums: BTreeMap<ScanKey, f64> = component.poses.keys().map(|key| (*key, 0.0)).collect();
    for ((a, b), support) in supports(graph, component, options) {
        *sums.entry(a).or_default() += support;
        *sums.entry(b).or_default() += support;
    }
    sums
}

/// The scans that `after` holds much less firmly than `before`.
#[must_use]
pub fn thrown(
    graph: &ScanGraph,
    before: &Component,
    after: &Component,
    options: &MappingOptions,
) -> Vec<ScanKey> {
    let needed = options.levels.last().map_or(0.0, |level| level.support);
    let had = support_by_scan(graph, before, options);
    let has = support_by_scan(graph, after, options);
    had.into_iter()
        .filter(|(key, had)| {
            let has = has.get(key).copied().unwrap_or(0.0);
            has < KEPT_SHARE * had && (had - has > LEAST_LOSS || (*had >= needed && has < needed))
        })
        .map(|(key, _)| key)
        .collect()
}
