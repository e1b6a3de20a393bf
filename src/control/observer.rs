//! Progress of a computation, told to whoever watches.

use serde::{Deserialize, Serialize};

/// The named stages of the pipeline, in the order in which a scan passes them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stage {
    /// Decoding an uploaded file.
    Decode,
    /// Normals, keypoints, descriptors and signature of scans.
    Prepare,
    /// Matching and verifying pairs of scans.
    Match,
    /// Supporting and contradicting hypotheses through third scans.
    Support,
    /// Joining scans and components.
    Map,
    /// Bundle adjustment over landmarks.
    BundleAdjustment,
    /// Moving the keypoints of tracks onto each other.
    TrackRefinement,
    /// Joint dense refinement of all overlapping pairs.
    DenseRefinement,
    /// Writing results.
    Export,
}

/// `done` of `total` units of `stage` are finished.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Progress {
    /// What is being done.
    pub stage: Stage,
    /// Units finished, at most `total`.
    pub done: usize,
    /// Units in this stage, as far as known now.
    pub total: usize,
}

/// Watches a computation. Called from any thread, so it must be quick and must not panic.
pub trait Observer: Sync {
    /// Some units of a stage are finished.
    fn progress(&self, progress: Progress);
}

/// An observer that ignores everything.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Observer for Silent {
    fn progress(&self, _: Progress) {}
}
