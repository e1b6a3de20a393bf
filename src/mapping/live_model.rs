//! The model of a project, alive: scans come and go, and it is never recomputed unless asked.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::component::Component;
use super::decision::{Decision, Decisions};
use super::mapper::Mapper;
use super::options::MappingOptions;
use super::policy::grow;
use super::refine::{Reach, dense, global_bundle_adjustment, held_out};
use super::snapshot::{ComponentSnapshot, ModelSnapshot, RegisteredScan, ScanOutcome};
use super::track_refinement::refine_tracks;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Stage};
use crate::features::{PreparedScan, Scan};
use crate::graph::{Retrieval, ScanGraph, retrieve};
use crate::optimize::Report;
use crate::pairwise::{PairKey, PairResult};

/// What an operation on the whole model did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefinementReport {
    /// Whether the model is better by the measure of data that was not fitted, and the result was kept.
    pub improved: bool,
    /// That measure before: root mean square distance of held-out points from overlapping surfaces, metres.
    pub held_out_before: f64,
    /// That measure after, metres.
    pub held_out_after: f64,
    /// Iterations of the optimiser.
    pub iterations: usize,
    /// Why the optimiser stopped, with the measured value and the threshold.
    pub termination: String,
}

/// Why a stored model cannot be brought back to life.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RestoreError {
    /// The snapshot names a scan that was not given.
    #[error("the model holds scan {0}, whose prepared form is missing")]
    MissingScan(ScanKey),
}

/// A model in memory with everything needed to extend it.
#[derive(Debug, Clone)]
pub struct LiveModel {
    options: MappingOptions,
    graph: ScanGraph,
    mapper: Mapper,
    new_pairs: Vec<PairResult>,
}

impl LiveModel {
    /// An empty model.
    #[must_use]
    pub fn new(options: MappingOptions) -> Self {
        Self { options, graph: ScanGraph::new(), mapper: Mapper::default(), new_pairs: Vec::new() }
    }

    /// Brings a stored model back: its snapshot, all its prepared scans, and the results of all pairs tried so far.
    pub fn restore(
        options: MappingOptions,
        snapshot: &ModelSnapshot,
        scans: Vec<Arc<PreparedScan>>,
        pairs: Vec<PairResult>,
    ) -> Result<Self, RestoreError> {
        let mut model = Self::new(options);
        for scan in scans {
            model.graph.add_scan(Arc::new(Scan::new(PreparedScan::clone(&scan))));
        }
        for key in snapshot.scans.keys() {
            if model.graph.scan(*key).is_none() {
                return Err(RestoreError::MissingScan(*key));
            }
        }
        model.graph.add_results(pairs, &model.options.support);
        model.mapper.components = snapshot.components.iter().map(|c| c.component.clone()).collect();
        for (key, outcome) in &snapshot.scans {
            if matches!(outcome, ScanOutcome::Waiting(_)) {
                model.mapper.waiting.insert(*key, snapshot.refusals.get(key).copied());
            }
        }
        model.mapper.joins_since_refinement = snapshot.joins_since_refinement;
        model.mapper.open_joins.clone_from(&snapshot.open_joins);
        model.mapper.undone.clone_from(&snapshot.undone);
        model.options.decisions.clone_from(&snapshot.decisions);
        Ok(model)
    }

    /// Adds scans: matches them against retrieved candidates only, then joins what can be joined. One scan or a
    /// hundred, the same call. On `Err` the model is unchanged. A scan that is already there is ignored.
    pub fn register(&mut self, scans: Vec<Arc<PreparedScan>>, control: Control<'_>) -> Result<(), Cancelled> {
        let mut next = self.clone();
        let mut fresh = BTreeSet::new();
        for scan in scans {
            if next.graph.scan(scan.key).is_none() && fresh.insert(scan.key) {
                next.graph.add_scan(Arc::new(Scan::new(PreparedScan::clone(&scan))));
                next.mapper.add_waiting(scan.key);
            }
        }
        if fresh.is_empty() {
            return Ok(());
        }
        let pairs = retrieve(&Retrieval::new(&next.graph), fresh, next.options.retrieved, control)?;
        next.try_pairs(&pairs, control)?;
        next.loosen(control)?;
        next.grow(control)?;
        *self = next;
        Ok(())
    }

    /// Obeys these decisions from now on, instead of any earlier ones: the components that they concern are decided anew. On `Err`
    /// the model is unchanged.
    pub fn decide(&mut self, decisions: &[Decision], control: Control<'_>) -> Result<(), Cancelled> {
        let decisions = Decisions::new(decisions);
        let (old, new) = (self.options.decisions.as_slice(), decisions.as_slice());
        let changed = old.iter().filter(|d| !new.contains(d)).chain(new.iter().filter(|d| !old.contains(d)));
        let concerned: BTreeSet<ScanKey> = changed.flat_map(|d| [d.pair.a, d.pair.b]).collect();
        if concerned.is_empty() {
            return Ok(());
        }
        let mut next = self.clone();
        next.options.decisions = decisions;
        next.mapper.reopen(&concerned);
        next.loosen(control)?;
        next.grow(control)?;
        *self = next;
        Ok(())
    }

    /// Takes a scan out of the model with its edges and observations. Returns whether it was there.
    pub fn remove(&mut self, key: ScanKey) -> bool {
        self.mapper.remove(key, &self.options);
        self.options.decisions.remove_scan(key);
        self.new_pairs.retain(|p| p.pair.a != key && p.pair.b != key);
        let there = self.graph.remove_scan(key, &self.options.support);
        self.mapper.sort_components();
        there
    }

    /// Bundle adjustment over all landmarks, with completion, merging and filtering of tracks.
    pub fn global_bundle_adjustment(&mut self, control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        self.improve(Stage::BundleAdjustment, control, |graph, component, voxel, options| {
            global_bundle_adjustment(graph, component, voxel, options, control)
        })
    }

    /// Moves the keypoints of tracks onto each other, then adjusts globally.
    pub fn track_refinement(&mut self, control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        self.improve(Stage::TrackRefinement, control, |graph, component, voxel, options| {
            refine_tracks(graph, component, voxel, options, control)
        })
    }

    /// Joint dense refinement over all overlapping pairs.
    pub fn dense_refinement(&mut self, control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        self.improve(Stage::DenseRefinement, control, |graph, component, voxel, _| {
            dense(graph, component, None, Reach::NEAR, voxel, control)
        })
    }

    /// Forgets all poses and builds the model again from the pairs and scans at hand.
    pub fn rebuild(&mut self, control: Control<'_>) -> Result<(), Cancelled> {
        let mut next = self.clone();
        next.mapper = Mapper::default();
        let keys: Vec<ScanKey> = next.graph.scans().map(|s| s.key()).collect();
        for key in &keys {
            next.mapper.add_waiting(*key);
        }
        let pairs = retrieve(&Retrieval::new(&next.graph), keys, next.options.retrieved, control)?;
        next.try_pairs(&pairs, control)?;
        next.grow(control)?;
        *self = next;
        Ok(())
    }

    /// Results of pairs found since the last call, to be stored; ascending by pair.
    pub fn take_new_pairs(&mut self) -> Vec<PairResult> {
        let mut pairs = std::mem::take(&mut self.new_pairs);
        pairs.sort_by_key(|p| p.pair);
        pairs
    }

    /// The scan graph, for reports.
    #[must_use]
    pub fn graph(&self) -> &ScanGraph {
        &self.graph
    }

    /// The model as plain data.
    #[must_use]
    pub fn snapshot(&self) -> ModelSnapshot {
        let refusals = self.mapper.waiting.iter().filter_map(|(key, refusal)| Some((*key, (*refusal)?)));
        let mut snapshot = ModelSnapshot {
            resolution: self.voxel(),
            refusals: refusals.collect(),
            joins_since_refinement: self.mapper.joins_since_refinement,
            open_joins: self.mapper.open_joins.clone(),
            undone: self.mapper.undone.clone(),
            decisions: self.options.decisions.clone(),
            ..ModelSnapshot::default()
        };
        for (index, component) in self.mapper.components.iter().enumerate() {
            snapshot.components.push(ComponentSnapshot::of(component));
            for place in places(&self.graph, component, index) {
                snapshot.scans.insert(place.0, ScanOutcome::Registered(place.1));
            }
        }
        for key in self.mapper.waiting.keys() {
            let reason = self.mapper.waiting_reason(*key, &self.graph, self.voxel(), &self.options);
            snapshot.scans.insert(*key, ScanOutcome::Waiting(reason));
        }
        snapshot
    }

    fn voxel(&self) -> f64 {
        self.graph.scans().next().map_or(0.0, |s| s.prepared.resolution)
    }

    fn try_pairs(&mut self, pairs: &BTreeSet<PairKey>, control: Control<'_>) -> Result<(), Cancelled> {
        self.new_pairs.extend(self.graph.try_pairs(pairs, &self.options.support, control)?);
        Ok(())
    }

    fn loosen(&mut self, control: Control<'_>) -> Result<(), Cancelled> {
        let loosened = self.mapper.loosen(&self.graph, self.options.firm_support, &self.options, control);
        if loosened.is_err() {
            // The scans are shared with the model as it was, and what matching unpacked of them would stay.
            self.graph.forget_fine();
        }
        loosened
    }

    fn grow(&mut self, control: Control<'_>) -> Result<(), Cancelled> {
        let voxel = self.voxel();
        let grown =
            grow(&mut self.mapper, &mut self.graph, voxel, &self.options, &mut self.new_pairs, control);
        if grown.is_ok() {
            self.graph.forget_fine_of_many();
        } else {
            self.graph.forget_fine();
        }
        grown
    }

    /// Gives back the memory of finer surfaces, which those of few scans keep for what arrives next ([`Scan::fine`]).
    pub fn forget_fine(&self) {
        self.graph.forget_fine();
    }

    /// Runs an operation on every component and keeps, component by component, what improves the held-out measure.
    fn improve(
        &mut self,
        stage: Stage,
        control: Control<'_>,
        operation: impl Fn(&ScanGraph, &mut Component, f64, &MappingOptions) -> Result<Option<Report>, Cancelled>,
    ) -> Result<RefinementReport, Cancelled> {
        let voxel = self.voxel();
        let total = self.mapper.components.len();
        let mut report = RefinementReport {
            improved: false,
            held_out_before: 0.0,
            held_out_after: 0.0,
            iterations: 0,
            termination: "there is nothing to adjust".to_owned(),
        };
        let mut next = self.mapper.components.clone();
        let mut scans = 0;
        for (index, component) in next.iter_mut().enumerate() {
            let before = held_out(&self.graph, component, voxel);
            let mut changed = component.clone();
            let Some(done) = operation(&self.graph, &mut changed, voxel, &self.options)? else { continue };
            let after = held_out(&self.graph, &changed, voxel);
            report.iterations += done.iterations;
            report.termination = done.termination.to_string();
            let weight = component.len() as f64;
            report.held_out_before += before.powi(2) * weight;
            report.held_out_after += after.powi(2) * weight;
            scans += component.len();
            if after < before {
                report.improved = true;
                *component = changed;
            }
            control.report(stage, index + 1, total);
        }
        let mean = |sum: f64| (sum / scans.max(1) as f64).sqrt();
        report.held_out_before = mean(report.held_out_before);
        report.held_out_after = mean(report.held_out_after);
        self.mapper.components = next;
        Ok(report)
    }
}

/// How well each scan of a component is held.
fn places(graph: &ScanGraph, component: &Component, index: usize) -> Vec<(ScanKey, RegisteredScan)> {
    // Landmarks that each scan sees, and the sum of their squared distances.
    let mut seen: BTreeMap<ScanKey, (usize, f64)> = BTreeMap::new();
    for landmark in component.tracks.iter() {
        for o in &landmark.observations {
            let Some(model_from_local) = component.poses.get(&o.scan) else { continue };
            let (landmarks, square) = seen.entry(o.scan).or_default();
            *landmarks += 1;
            *square += (model_from_local.transform(&o.point_in_scan) - landmark.position).norm_squared();
        }
    }
    component
        .poses
        .iter()
        .filter_map(|(key, model_from_local)| {
            let scan = graph.scan(*key)?;
            let (landmarks, square) = seen.get(key).copied().unwrap_or_default();
            let neighbours = graph
                .neighbors(*key)
                .filter(|other| component.poses.contains_key(other))
                .filter(|other| graph.edge(*key, *other).is_some_and(|e| e.best_score() > 0.0))
                .count();
            Some((
                *key,
                RegisteredScan {
                    component: index,
                    model_from_scan: *model_from_local * scan.prepared.local_from_scan(),
                    landmarks,
                    neighbours,
                    landmark_rms: (square / landmarks.max(1) as f64).sqrt(),
                },
            ))
        })
        .collect()
}
