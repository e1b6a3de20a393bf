//! All that a benchmark of recall says, as plain data: one entry a run, and means.

use serde::Serialize;

use super::super::progress::Seconds;
use super::clock::add;
use crate::evaluate::{Ecdf, EdgeFigures, WrongScan};

/// How scans get their poses.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// The engine.
    Incremental,
    /// A maximum spanning tree over the engine's scan graph.
    Mst,
    /// Robust rotation and translation averaging over the engine's scan graph.
    Global,
}

impl Strategy {
    /// As on the command line.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Incremental => "incremental",
            Self::Mst => "mst",
            Self::Global => "global",
        }
    }
}

/// The whole report.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub one_at_a_time: bool,
    pub threads: usize,
    pub tau_m: f64,
    pub wrong_angle_deg: f64,
    pub scenes: Vec<SceneReport>,
    /// Means over all runs, by strategy; scenes weigh alike, as each has as many runs.
    pub mean: Vec<Summary>,
}

/// One scene.
#[derive(Debug, Serialize)]
pub(super) struct SceneReport {
    pub name: String,
    /// What the verifier's weights were fitted on.
    pub verifier: String,
    pub scans: usize,
    /// Separate places among them.
    pub places: usize,
    /// Voxel size that suits the scans, metres.
    pub resolution_m: f64,
    /// Pairs that truly overlap.
    pub overlapping_pairs: usize,
    /// Scans further from their true place are wrong, metres.
    pub wrong_distance_m: f64,
    pub runs: Vec<RunReport>,
}

/// One strategy on one scene in one order.
#[derive(Debug, Clone, Serialize)]
pub(super) struct RunReport {
    pub strategy: Strategy,
    pub seed: u64,
    pub recall: Vec<ListRecall>,
    /// All pairs of scans of one place.
    pub ecdf: Ecdf,
    /// Best hypotheses with a score above zero.
    pub graph_edges: EdgeFigures,
    /// Of the hypotheses with a score above zero, those that the result agrees with.
    pub kept_edges: EdgeFigures,
    pub scans: usize,
    pub right: usize,
    pub false_merges: Vec<WrongScan>,
    pub waiting: usize,
    pub components: usize,
    pub pairs_tried: usize,
    pub pairs_all: usize,
    pub seconds: Stages,
    /// With scans one at a time: the longest that one took to be matched and joined, seconds on the wall.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longest_step_s: Option<f64>,
    /// Of the whole run, with all strategies.
    pub peak_memory_bytes: Option<u64>,
}

/// Recall on one list of pairs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ListRecall {
    /// `3DMatch`, `3DLoMatch`, or `overlapping`.
    pub list: String,
    pub pairs: usize,
    pub registered: usize,
    pub recall: Option<f64>,
    /// Without the first row of the file, as the harness behind the published tables has it.
    pub recall_published: Option<f64>,
}

/// Mean recall on lists of one name.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ListMean {
    pub list: String,
    pub recall: f64,
}

/// Time by stage.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub(super) struct Stages {
    /// Decoding, normals, descriptors.
    pub prepare: Seconds,
    /// Matching and verifying pairs.
    #[serde(rename = "match")]
    pub matching: Seconds,
    /// What third scans say.
    pub support: Seconds,
    /// Retrieval and joins; of a baseline, its solver.
    pub map: Seconds,
    /// Adjustments of landmarks, pose graph and surfaces.
    pub refine: Seconds,
}

impl Stages {
    /// All stages together.
    pub fn total(&self) -> Seconds {
        [self.prepare, self.matching, self.support, self.map, self.refine]
            .iter()
            .fold(Seconds::default(), add)
    }
}

/// Means over runs of one strategy.
#[derive(Debug, Clone, Serialize)]
pub(super) struct Summary {
    pub strategy: Strategy,
    pub runs: usize,
    /// By list, over the runs that have it.
    pub recall: Vec<ListMean>,
    /// Shares at the thresholds of [`crate::evaluate::ROTATION_STEPS_DEG`].
    pub rotation_shares: Vec<f64>,
    /// Shares at the thresholds of [`crate::evaluate::TRANSLATION_STEPS_M`].
    pub translation_shares: Vec<f64>,
    pub graph_precision: Option<f64>,
    pub graph_recall: Option<f64>,
    pub kept_precision: Option<f64>,
    pub kept_recall: Option<f64>,
    /// Share of scans placed right.
    pub right: f64,
    /// Over all runs together.
    pub false_merges: usize,
    pub waiting: f64,
    pub components: f64,
    /// Share of all pairs.
    pub pairs_tried: f64,
    pub wall_s: f64,
    pub cpu_s: f64,
    pub prepare_cpu_ms_a_scan: f64,
    pub match_cpu_ms_a_pair: f64,
    /// The highest peak.
    pub peak_memory_bytes: Option<u64>,
}

impl Summary {
    /// Means over runs; `None` without any.
    pub fn of(runs: &[&RunReport]) -> Option<Self> {
        let strategy = runs.first()?.strategy;
        let known = |of: &dyn Fn(&RunReport) -> Option<f64>| {
            let values: Vec<f64> = runs.iter().filter_map(|run| of(run)).collect();
            (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
        };
        let mean = |of: &dyn Fn(&RunReport) -> f64| known(&|run| Some(of(run))).unwrap_or_default();
        let share = |part: usize, whole: usize| part as f64 / whole.max(1) as f64;
        let mut lists: Vec<&str> = Vec::new();
        for list in runs.iter().flat_map(|run| &run.recall) {
            if !lists.contains(&list.list.as_str()) {
                lists.push(&list.list);
            }
        }
        let recall_of = |run: &RunReport, list: &str| run.recall.iter().find(|r| r.list == list)?.recall;
        let ecdf = runs.first().map(|run| &run.ecdf);
        Some(Self {
            strategy,
            runs: runs.len(),
            recall: lists
                .into_iter()
                .filter_map(|list| {
                    let recall = known(&|run| recall_of(run, list))?;
                    Some(ListMean { list: list.to_owned(), recall })
                })
                .collect(),
            rotation_shares: (0..ecdf.map_or(0, |e| e.rotation_deg.len()))
                .map(|k| mean(&|run| run.ecdf.rotation_deg[k].share))
                .collect(),
            translation_shares: (0..ecdf.map_or(0, |e| e.translation_m.len()))
                .map(|k| mean(&|run| run.ecdf.translation_m[k].share))
                .collect(),
            graph_precision: known(&|run| run.graph_edges.precision),
            graph_recall: known(&|run| run.graph_edges.recall),
            kept_precision: known(&|run| run.kept_edges.precision),
            kept_recall: known(&|run| run.kept_edges.recall),
            right: mean(&|run| share(run.right, run.scans)),
            false_merges: runs.iter().map(|run| run.false_merges.len()).sum(),
            waiting: mean(&|run| run.waiting as f64),
            components: mean(&|run| run.components as f64),
            pairs_tried: mean(&|run| share(run.pairs_tried, run.pairs_all)),
            wall_s: mean(&|run| run.seconds.total().wall),
            cpu_s: mean(&|run| run.seconds.total().cpu),
            prepare_cpu_ms_a_scan: mean(&|run| 1e3 * run.seconds.prepare.cpu / run.scans.max(1) as f64),
            match_cpu_ms_a_pair: mean(&|run| 1e3 * run.seconds.matching.cpu / run.pairs_tried.max(1) as f64),
            peak_memory_bytes: runs.iter().filter_map(|run| run.peak_memory_bytes).max(),
        })
    }
}
