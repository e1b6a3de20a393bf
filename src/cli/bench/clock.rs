//! What each stage of the engine takes, by the events of its observer: the engine itself holds no clock.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::super::progress::{Moment, Seconds};
use crate::control::{Observer, Progress, Stage};

/// Adds up the time of stages. What a stage does within another counts for the inner one alone.
pub(super) struct StageClock(Mutex<State>);

struct State {
    /// What was spent since it was asked last.
    lap: Box<dyn FnMut() -> Seconds + Send>,
    open: Vec<Stage>,
    outside: Seconds,
    stages: BTreeMap<Stage, Seconds>,
}

impl StageClock {
    /// A clock that starts now.
    pub fn start() -> Self {
        let mut last = Moment::now();
        Self::with_lap(move || {
            let now = Moment::now();
            let spent = last.until(&now);
            last = now;
            spent
        })
    }

    fn with_lap(lap: impl FnMut() -> Seconds + Send + 'static) -> Self {
        Self(Mutex::new(State {
            lap: Box::new(lap),
            open: Vec::new(),
            outside: Seconds::default(),
            stages: BTreeMap::new(),
        }))
    }

    /// What these stages took together.
    pub fn of(&self, stages: &[Stage]) -> Seconds {
        let state = self.state();
        stages.iter().filter_map(|stage| state.stages.get(stage)).fold(Seconds::default(), add)
    }

    /// What was spent outside all stages until now.
    pub fn outside(&self) -> Seconds {
        let mut state = self.state();
        state.settle();
        state.outside
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The sum of two times.
pub(super) fn add(sum: Seconds, more: &Seconds) -> Seconds {
    Seconds { wall: sum.wall + more.wall, cpu: sum.cpu + more.cpu }
}

impl State {
    /// Gives the time since the last event to the innermost open stage.
    fn settle(&mut self) {
        let spent = (self.lap)();
        let sum = match self.open.last() {
            Some(stage) => self.stages.entry(*stage).or_default(),
            None => &mut self.outside,
        };
        *sum = add(*sum, &spent);
    }
}

impl Observer for StageClock {
    fn progress(&self, _: Progress) {}

    fn began(&self, stage: Stage) {
        let mut state = self.state();
        state.settle();
        state.open.push(stage);
    }

    fn ended(&self, stage: Stage) {
        let mut state = self.state();
        state.settle();
        if let Some(at) = state.open.iter().rposition(|open| *open == stage) {
            state.open.remove(at);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Control};

    #[test]
    fn time_counts_for_the_innermost_stage() {
        // One second passes between any two events.
        let clock = StageClock::with_lap(|| Seconds { wall: 1.0, cpu: 0.5 });
        let cancel = CancelToken::new();
        let control = Control { cancel: &cancel, observer: &clock };
        {
            let _map = control.begin(Stage::Map);
            let _refine = control.begin(Stage::DenseRefinement);
            drop(control.begin(Stage::DenseRefinement));
        }
        let of = |stages: &[Stage]| clock.of(stages).wall;
        assert_eq!((of(&[Stage::Map]), of(&[Stage::DenseRefinement])), (2.0, 3.0));
        assert_eq!(of(&[Stage::Map, Stage::DenseRefinement]), 5.0);
        assert_eq!(clock.of(&[Stage::Map]).cpu, 1.0);
        assert_eq!(clock.of(&[Stage::Match]), Seconds::default());
        assert_eq!(clock.outside().wall, 2.0);
    }
}
