//! The model of a project, alive: scans come and go, and it is never recomputed unless asked.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::snapshot::{ComponentSummary, ModelSnapshot, RegisteredScan, ScanOutcome};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Seed};
use crate::features::PreparedScan;
use crate::geometry::Pose;
use crate::pairwise::PairResult;

/// Settings of the mapper. Every length derives from the resolution of the prepared scans.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct MappingOptions {
    /// Root of the random choices.
    pub seed: Seed,
}

/// What an operation on the whole model did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RefinementReport {
    /// Whether the model is better by the measure of data that was not fitted, and the result was kept.
    pub improved: bool,
    /// That measure before, metres.
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
    scans: Vec<Arc<PreparedScan>>,
}

impl LiveModel {
    /// An empty model.
    #[must_use]
    pub fn new(options: MappingOptions) -> Self {
        Self { options, scans: Vec::new() }
    }

    /// Brings a stored model back: its snapshot, all its prepared scans, and the results of all pairs tried so far.
    pub fn restore(
        options: MappingOptions,
        _snapshot: &ModelSnapshot,
        scans: Vec<Arc<PreparedScan>>,
        _pairs: Vec<PairResult>,
    ) -> Result<Self, RestoreError> {
        Ok(Self { options, scans })
    }

    /// Adds scans: matches them against retrieved candidates only, then joins what can be joined. One scan or a
    /// hundred, the same call. On `Err` the model is unchanged. A scan that is already there is ignored.
    pub fn register(
        &mut self,
        scans: Vec<Arc<PreparedScan>>,
        _control: Control<'_>,
    ) -> Result<(), Cancelled> {
        self.scans.extend(scans);
        Ok(())
    }

    /// Takes a scan out of the model with its edges and observations. Returns whether it was there.
    pub fn remove(&mut self, key: ScanKey) -> bool {
        let before = self.scans.len();
        self.scans.retain(|s| s.key != key);
        before != self.scans.len()
    }

    /// Bundle adjustment over all landmarks, with completion, merging and filtering of tracks.
    pub fn global_bundle_adjustment(&mut self, _control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        Ok(stub())
    }

    /// Moves the keypoints of tracks onto each other, then adjusts globally.
    pub fn track_refinement(&mut self, _control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        Ok(stub())
    }

    /// Joint dense refinement over all overlapping pairs.
    pub fn dense_refinement(&mut self, _control: Control<'_>) -> Result<RefinementReport, Cancelled> {
        Ok(stub())
    }

    /// Forgets all poses and builds the model again from the pairs and scans at hand.
    pub fn rebuild(&mut self, _control: Control<'_>) -> Result<(), Cancelled> {
        Ok(())
    }

    /// Results of pairs found since the last call, to be stored; ascending by pair.
    pub fn take_new_pairs(&mut self) -> Vec<PairResult> {
        Vec::new()
    }

    /// The model as plain data.
    #[must_use]
    pub fn snapshot(&self) -> ModelSnapshot {
        let keys: Vec<_> = self.scans.iter().map(|s| s.key).collect();
        let place = |component| RegisteredScan {
            component,
            model_from_scan: Pose::identity(),
            landmarks: 0,
            neighbours: 0,
            landmark_rms: 0.0,
        };
        let _ = &self.options;
        ModelSnapshot {
            resolution: 0.05,
            components: keys
                .iter()
                .map(|k| ComponentSummary {
                    scans: vec![*k],
                    gauge: *k,
                    landmarks: 0,
                    observations: 0,
                    landmark_rms: 0.0,
                })
                .collect(),
            scans: keys.iter().enumerate().map(|(i, k)| (*k, ScanOutcome::Registered(place(i)))).collect(),
        }
    }
}

fn stub() -> RefinementReport {
    RefinementReport {
        improved: false,
        held_out_before: 0.0,
        held_out_after: 0.0,
        iterations: 0,
        termination: String::new(),
    }
}
