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

    /// A stage begins, possibly within another: until it has ended, what is computed is its work.
    fn began(&self, _stage: Stage) {}

    /// The stage that began last has ended.
    fn ended(&self, _stage: Stage) {}
}

/// A stage that goes on: dropping it ends the stage, on every way out.
#[must_use = "the stage ends when this is dropped"]
pub struct Ongoing<'a> {
    observer: &'a dyn Observer,
    stage: Stage,
}

impl<'a> Ongoing<'a> {
    pub(super) fn begin(observer: &'a dyn Observer, stage: Stage) -> Self {
        observer.began(stage);
        Self { observer, stage }
    }
}

impl Drop for Ongoing<'_> {
    fn drop(&mut self) {
        self.observer.ended(self.stage);
    }
}

/// An observer that ignores everything.
#[derive(Debug, Clone, Copy, Default)]
pub struct Silent;

impl Observer for Silent {
    fn progress(&self, _: Progress) {}
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::control::{CancelToken, Cancelled, Control};

    #[derive(Default)]
    struct Log(Mutex<Vec<(Stage, bool)>>);

    impl Observer for Log {
        fn progress(&self, _: Progress) {}

        fn began(&self, stage: Stage) {
            self.0.lock().unwrap().push((stage, true));
        }

        fn ended(&self, stage: Stage) {
            self.0.lock().unwrap().push((stage, false));
        }
    }

    #[test]
    fn a_stage_ends_on_every_way_out() {
        let log = Log::default();
        let cancel = CancelToken::new();
        cancel.cancel();
        let control = Control { cancel: &cancel, observer: &log };
        let run = || -> Result<(), Cancelled> {
            let _map = control.begin(Stage::Map);
            let _refine = control.begin(Stage::DenseRefinement);
            control.check()
        };
        assert_eq!(run(), Err(Cancelled));
        let log = log.0.into_inner().unwrap();
        let (map, dense) = (Stage::Map, Stage::DenseRefinement);
        assert_eq!(log, [(map, true), (dense, true), (dense, false), (map, false)]);
    }
}
