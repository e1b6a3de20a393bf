//! From the stages of the core to the percents that a client sees.

use tokio::sync::watch;

use crate::control::{Observer, Progress, Stage};
use crate::project::{JobKind, Lane};

/// What a client sees of a running job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Shown {
    /// The stage's word.
    pub stage: Option<&'static str>,
    /// Percent, 0 to 99: a job is at 100 only when it is published.
    pub percent: u8,
}

/// An observer that keeps the last progress for whoever looks.
#[derive(Debug)]
pub(super) struct ProgressSink {
    kind: JobKind,
    last: watch::Sender<Shown>,
}

impl ProgressSink {
    /// For a job of this kind; its ingest lane is the first third of a registration.
    pub fn new(kind: JobKind, lane: Lane) -> Self {
        let percent = if kind == JobKind::Registration && lane == Lane::Map { 33 } else { 0 };
        Self { kind, last: watch::Sender::new(Shown { stage: None, percent }) }
    }

    /// The last progress.
    pub fn shown(&self) -> Shown {
        *self.last.borrow()
    }
}

impl Observer for ProgressSink {
    fn progress(&self, progress: Progress) {
        let (stage, from, to) = band(self.kind, progress.stage);
        let done = progress.done.min(progress.total);
        let part = ((to - from) * done).checked_div(progress.total).unwrap_or(0);
        let percent = u8::try_from(from + part).unwrap_or(99).min(99);
        self.last.send_if_modified(|shown| {
            let next = Shown { stage: Some(stage), percent: shown.percent.max(percent) };
            let changed = *shown != next;
            *shown = next;
            changed
        });
    }
}

/// The word of a stage and the percents between which it lies.
fn band(kind: JobKind, stage: Stage) -> (&'static str, usize, usize) {
    let (word, from, to) = match stage {
        Stage::Decode => ("decode", 0, 10),
        Stage::Prepare => ("prepare", 10, 33),
        Stage::Match => ("match", 33, 70),
        Stage::Support => ("support", 70, 75),
        Stage::Map => ("map", 75, 90),
        Stage::BundleAdjustment => ("bundle-adjustment", 90, 97),
        Stage::TrackRefinement => ("track-refinement", 90, 97),
        Stage::DenseRefinement => ("dense-refinement", 90, 97),
        Stage::Export => ("export", 97, 99),
    };
    match (kind, stage) {
        (JobKind::GlobalBundleAdjustment, Stage::BundleAdjustment)
        | (JobKind::DenseRefinement, Stage::DenseRefinement) => (word, 5, 97),
        (JobKind::TrackRefinement, Stage::TrackRefinement) => (word, 5, 60),
        (JobKind::TrackRefinement, Stage::BundleAdjustment) => (word, 60, 97),
        _ => (word, from, to),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percents_never_fall_and_never_reach_a_hundred() {
        let sink = ProgressSink::new(JobKind::Registration, Lane::Ingest);
        let mut last = 0;
        for stage in [Stage::Decode, Stage::Prepare, Stage::Match, Stage::Map, Stage::Match, Stage::Export] {
            for done in [0, 1, 2, 9] {
                sink.progress(Progress { stage, done, total: 2 });
                let percent = sink.shown().percent;
                assert!(percent >= last && percent < 100, "{percent} after {last}");
                last = percent;
            }
        }
        assert_eq!(last, 99);
    }
}
