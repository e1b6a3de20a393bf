//! The figures of one strategy in one run.

use std::collections::BTreeSet;

use nalgebra::Vector3;

use super::report::{ListRecall, RunReport, Stages, Strategy};
use super::scene::Scene;
use super::trial::Trial;
use crate::cloud::ScanKey;
use crate::evaluate::{ClaimedEdge, Estimate, Tolerance, against_truth, edge_figures, recall};
use crate::geometry::Pose;
use crate::graph::Supported;
use crate::pairwise::centred_difference;

/// Name of the list that a scene without lists is scored on.
const OVERLAPPING: &str = "overlapping";
/// The largest root mean square distance of a registered pair of that list, voxels, where that is less than tau.
const TAU_VOXELS: f64 = 4.0;

/// What counts.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rules {
    /// Largest root mean square distance of a registered pair, metres.
    pub tau_m: f64,
    /// Beyond it a scan or an edge is wrong.
    pub tolerance: Tolerance,
}

/// Measures one strategy.
pub(super) fn measured(
    scene: &Scene,
    trial: &Trial,
    (strategy, estimate, seconds): &(Strategy, Estimate, Stages),
    seed: u64,
    rules: Rules,
) -> anyhow::Result<RunReport> {
    let truth = against_truth(estimate, &scene.truth, rules.tolerance);
    let graph = trial.model.graph();
    let true_pairs: BTreeSet<(String, String)> = scene.overlapping.keys().cloned().collect();
    let figures = |edges: &[ClaimedEdge]| edge_figures(edges, &scene.truth, &true_pairs, rules.tolerance);
    let scans = graph.scans().len();
    Ok(RunReport {
        strategy: *strategy,
        seed,
        recall: recalls(scene, estimate, rules.tau_m)?,
        ecdf: truth.pairs,
        graph_edges: figures(&claimed(scene, trial, |_, _, best| Some(*best.first()?))),
        kept_edges: figures(&claimed(scene, trial, |a, b, hypotheses| {
            kept(scene, trial, estimate, a, b, hypotheses)
        })),
        scans: truth.scans,
        right: truth.right,
        false_merges: truth.components.iter().flat_map(|c| c.wrong.iter().cloned()).collect(),
        waiting: truth.scans - truth.registered,
        components: truth.components.len(),
        pairs_tried: graph.edges().len(),
        pairs_all: scans * scans.saturating_sub(1) / 2,
        seconds: *seconds,
        longest_step_s: trial.longest_step_s,
        peak_memory_bytes: trial.peak_memory_bytes,
    })
}

/// Recall on the scene's lists, or on all pairs that overlap.
fn recalls(scene: &Scene, estimate: &Estimate, tau_m: f64) -> anyhow::Result<Vec<ListRecall>> {
    if scene.lists.is_empty() {
        return Ok(vec![recall_of_overlaps(scene, estimate, tau_m.min(TAU_VOXELS * scene.resolution))]);
    }
    let mut recalls = Vec::with_capacity(scene.lists.len());
    for list in &scene.lists {
        let found = recall(estimate, &list.pairs, &list.weights, tau_m)?;
        recalls.push(ListRecall {
            list: list.name.clone(),
            pairs: found.pairs,
            registered: found.registered,
            recall: found.recall,
            recall_published: found.recall_published,
        });
    }
    Ok(recalls)
}

/// The measure of the benchmarks, on every pair that overlaps.
fn recall_of_overlaps(scene: &Scene, estimate: &Estimate, tau_m: f64) -> ListRecall {
    let is_registered = |(i, j): &(String, String), overlap: &crate::evaluate::Overlap| -> Option<bool> {
        let (at_i, at_j) = (estimate.find(i)?, estimate.find(j)?);
        let true_i_from_j =
            scene.truth.find(i)?.model_from_scan.inverse() * scene.truth.find(j)?.model_from_scan;
        let i_from_j = at_i.model_from_scan.inverse() * at_j.model_from_scan;
        let error = true_i_from_j.inverse() * i_from_j;
        Some(at_i.component == at_j.component && overlap.rms(&error) <= tau_m)
    };
    let registered =
        scene.overlapping.iter().filter(|(pair, overlap)| is_registered(pair, overlap) == Some(true)).count();
    let pairs = scene.overlapping.len();
    let recall = (pairs > 0).then(|| registered as f64 / pairs as f64);
    ListRecall { list: OVERLAPPING.to_owned(), pairs, registered, recall, recall_published: None }
}

/// Edges of the scan graph as relative poses of files: of each edge with hypotheses of a score above zero the one that `choose` takes.
fn claimed(
    scene: &Scene,
    trial: &Trial,
    choose: impl Fn(ScanKey, ScanKey, &[Supported]) -> Option<Supported>,
) -> Vec<ClaimedEdge> {
    let graph = trial.model.graph();
    let name = |key: &ScanKey| scene.scans.get(key)?.names.first().cloned();
    graph
        .edges()
        .filter_map(|edge| {
            let likely: Vec<Supported> = edge.hypotheses.iter().filter(|h| h.score > 0.0).copied().collect();
            let chosen = choose(edge.pair.a, edge.pair.b, &likely)?;
            let (a, b) = (graph.scan(edge.pair.a)?, graph.scan(edge.pair.b)?);
            let b_from_local = b.prepared.local_from_scan().inverse();
            let own_a_from_local = a.prepared.local_from_scan().inverse();
            Some(ClaimedEdge {
                i: name(&edge.pair.a)?,
                j: name(&edge.pair.b)?,
                i_from_j: own_a_from_local * chosen.hypothesis.a_from_b * b.prepared.local_from_scan(),
                centre_in_j: b_from_local.transform(&b.centroid),
            })
        })
        .collect()
}

/// The hypothesis that the result agrees with, by the engine's own idea of when two poses are different.
fn kept(
    scene: &Scene,
    trial: &Trial,
    estimate: &Estimate,
    a: ScanKey,
    b: ScanKey,
    hypotheses: &[Supported],
) -> Option<Supported> {
    let graph = trial.model.graph();
    let placed = |key: &ScanKey| estimate.placed.get(scene.scans.get(key)?.names.first()?);
    let (at_a, at_b) = (placed(&a)?, placed(&b)?);
    if at_a.component != at_b.component {
        return None;
    }
    let (scan_a, scan_b) = (graph.scan(a)?, graph.scan(b)?);
    let local = |pose: Pose, origin: [f64; 3]| pose * Pose::from_translation(Vector3::from(origin));
    let a_from_b = local(at_a.model_from_scan, scan_a.prepared.origin).inverse()
        * local(at_b.model_from_scan, scan_b.prepared.origin);
    let options = &trial.options;
    hypotheses.iter().copied().find(|h| {
        let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &a_from_b, &scan_b.centroid);
        angle < options.rival_angle && distance < options.rival_voxels * scan_b.prepared.resolution
    })
}
