//! What a person sees of a long computation, and how long its stages took: a bar in a terminal, plain lines elsewhere.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;

use crate::control::{Observer, Progress, Stage};

/// A plain line at the latest after so long …
const LINE_EVERY: Duration = Duration::from_secs(5);
/// … and for a new stage not before so long.
const STAGE_EVERY: Duration = Duration::from_secs(1);

/// Time that something took.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub(super) struct Seconds {
    /// By the clock on the wall.
    pub wall: f64,
    /// Summed over all threads of the process.
    pub cpu: f64,
}

/// The process's time so far, on both clocks.
#[derive(Debug, Clone, Copy)]
pub(super) struct Moment {
    wall: Instant,
    cpu: f64,
}

impl Moment {
    /// Now.
    pub fn now() -> Self {
        let cpu = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
        Self { wall: Instant::now(), cpu: cpu.tv_sec as f64 + 1e-9 * cpu.tv_nsec as f64 }
    }

    /// From then until `later`.
    pub fn until(&self, later: &Self) -> Seconds {
        let wall = later.wall.saturating_duration_since(self.wall).as_secs_f64();
        Seconds { wall, cpu: later.cpu - self.cpu }
    }
}

/// Shows progress and keeps the time of each stage.
pub(super) struct Watch {
    display: Display,
    state: Mutex<State>,
}

enum Display {
    Nothing,
    Lines,
    Bar(ProgressBar),
}

struct State {
    last: Moment,
    stages: BTreeMap<Stage, Seconds>,
    line: Option<(Stage, Instant)>,
}

impl Watch {
    /// Shows a bar on a terminal, lines elsewhere, and nothing if `quiet`; all on standard error.
    pub fn new(quiet: bool) -> Self {
        let display = if quiet {
            Display::Nothing
        } else if std::io::stderr().is_terminal() {
            Display::Bar(bar("{msg:<22} [{bar:40}] {pos}/{len}  {elapsed}"))
        } else {
            Display::Lines
        };
        let state = State { last: Moment::now(), stages: BTreeMap::new(), line: None };
        Self { display, state: Mutex::new(state) }
    }

    /// Takes the bar off the screen.
    pub fn finish(&self) {
        if let Display::Bar(bar) = &self.display {
            bar.finish_and_clear();
        }
    }

    /// What each stage took, as far as it reported.
    pub fn stages(&self) -> BTreeMap<Stage, Seconds> {
        self.state().stages.clone()
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Observer for Watch {
    fn progress(&self, progress: Progress) {
        let Progress { stage, done, total } = progress;
        let mut state = self.state();
        // Units are reported when they are finished, so the time since the last report was spent on this stage.
        let now = Moment::now();
        let spent = state.last.until(&now);
        state.last = now;
        let sum = state.stages.entry(stage).or_default();
        sum.wall += spent.wall;
        sum.cpu += spent.cpu;
        match &self.display {
            Display::Nothing => {}
            Display::Lines => {
                let due = state.line.is_none_or(|(shown, at)| {
                    at.elapsed() >= if shown == stage { LINE_EVERY } else { STAGE_EVERY }
                });
                if due {
                    state.line = Some((stage, now.wall));
                    eprintln!("{} {done}/{total}", word(stage));
                }
            }
            Display::Bar(bar) => {
                bar.set_message(word(stage));
                bar.set_length(total as u64);
                bar.set_position(done as u64);
            }
        }
    }
}

/// A bar of this template, which must be a valid one.
pub(super) fn bar(template: &str) -> ProgressBar {
    let style = ProgressStyle::with_template(template).unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = ProgressBar::new(0).with_style(style.progress_chars("=> "));
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}

fn word(stage: Stage) -> &'static str {
    match stage {
        Stage::Decode => "reading scans",
        Stage::Prepare => "preparing scans",
        Stage::Match => "matching pairs",
        Stage::Support => "comparing triplets",
        Stage::Map => "joining scans",
        Stage::BundleAdjustment => "adjusting landmarks",
        Stage::TrackRefinement => "refining tracks",
        Stage::DenseRefinement => "refining surfaces",
        Stage::Export => "writing results",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_is_kept_by_stage() {
        let watch = Watch::new(true);
        std::thread::sleep(Duration::from_millis(20));
        watch.progress(Progress { stage: Stage::Prepare, done: 1, total: 1 });
        watch.progress(Progress { stage: Stage::Match, done: 1, total: 2 });
        let stages = watch.stages();
        assert!(stages[&Stage::Prepare].wall >= 0.02, "{stages:?}");
        assert!(stages[&Stage::Match].wall < 0.02, "{stages:?}");
    }
}
