//! The processes that wait for a job: started when they are needed, kept as long as they take little.
//!
//! At most as many are at work as there are workers. Those that read uploads keep nothing; those that map keep the models of the projects
//! that they worked on last, so a project's next scan goes to the process that has its model.

use std::sync::{Mutex, MutexGuard, PoisonError};

use super::process::Process;
use crate::jobs::model_cache::CAPACITY;
use crate::jobs::workers::WorkerOptions;
use crate::project::{Lane, ProjectId};

/// Processes between jobs.
#[derive(Debug, Default)]
pub(in crate::jobs) struct Processes {
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// The one that waits longest first.
    idle: Vec<Process>,
    at_work: usize,
}

/// The right to have a process at work, until it is dropped.
#[derive(Debug)]
pub(super) struct AtWork<'a>(&'a Processes);

impl Processes {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Tells that a process begins to work on a job of this lane and project. When as many work as may, those that wait give their memory
    /// to them, except what may serve this very job.
    pub(super) fn begin(&self, lane: Lane, project: ProjectId, options: &WorkerOptions) -> AtWork<'_> {
        let mut state = self.state();
        state.at_work += 1;
        if state.at_work >= options.workers {
            state.idle.retain(|process| {
                let serves = process.lane == lane && process.worked_on.contains(&project);
                serves || process.memory() <= options.memory_bytes / 4
            });
        }
        AtWork(self)
    }

    /// A process for a job of this lane and project, unless a new one had better be started.
    pub(super) fn take(&self, lane: Lane, project: ProjectId, workers: usize) -> Option<Process> {
        let mut state = self.state();
        state.idle.retain_mut(Process::lives);
        let of_lane = |process: &Process| process.lane == lane;
        let known = |process: &Process| of_lane(process) && process.worked_on.contains(&project);
        // What is at work may all be of this lane.
        let room = state.idle.iter().filter(|process| of_lane(process)).count() + state.at_work <= workers;
        let best = state.idle.iter().position(known).or_else(|| {
            let any = state.idle.iter().position(of_lane)?;
            // Another project's model stays where it is while there is room for one more process.
            (lane == Lane::Ingest || !room).then_some(any)
        })?;
        Some(state.idle.remove(best))
    }

    /// Keeps a process for further jobs, if what it still takes is worth it.
    pub(super) fn keep(&self, mut process: Process, project: ProjectId, options: &WorkerOptions) {
        let most = match process.lane {
            Lane::Ingest => options.memory_bytes / 8,
            Lane::Map => options.memory_bytes / 4 * 3,
        };
        if process.memory() > most {
            return;
        }
        process.worked_on.retain(|known| *known != project);
        process.worked_on.push(project);
        let forgotten = process.worked_on.len().saturating_sub(CAPACITY);
        process.worked_on.drain(..forgotten);
        self.state().idle.push(process);
    }
}

impl Drop for AtWork<'_> {
    fn drop(&mut self) {
        self.0.state().at_work -= 1;
    }
}
