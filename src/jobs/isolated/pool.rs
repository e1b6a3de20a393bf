//! The processes that wait for a job: started when they are needed, kept as long as they take little and are of use.
//!
//! At most as many are at work as there are workers. Those that read uploads keep nothing; those that map keep the models of the projects
//! that they worked on last, so a project's next scan goes to the process that has its model. All together, at work and waiting, they take
//! no more than the workers may, and a quarter of one's share (`config` sees to it that this is within the machine's).

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::process::Process;
use crate::jobs::model_cache::CAPACITY;
use crate::jobs::workers::WorkerOptions;
use crate::project::{Lane, ProjectId};

/// How long a process waits for a job. A model that is not asked for in this time is read back in seconds when it is.
const WAITS_FOR: Duration = Duration::from_mins(10);

/// What the pool asks of a process.
pub(in crate::jobs) trait Resident {
    /// Whether it has not ended.
    fn lives(&mut self) -> bool;
    /// Memory that it takes at this moment, bytes; 0 where the system does not tell.
    fn memory(&self) -> u64;
    /// The lane whose jobs it does.
    fn lane(&self) -> Lane;
    /// The projects that it worked on, the last one last: it may hold their models.
    fn worked_on(&mut self) -> &mut Vec<ProjectId>;
}

/// Processes between jobs.
#[derive(Debug)]
pub(in crate::jobs) struct Processes<P = Process> {
    state: Mutex<State<P>>,
}

#[derive(Debug)]
struct State<P> {
    /// The one that waits longest first.
    waiting: Vec<Waiting<P>>,
    at_work: usize,
}

#[derive(Debug)]
struct Waiting<P> {
    process: P,
    since: Instant,
}

/// The right to have a process at work, until it is dropped.
#[derive(Debug)]
pub(super) struct AtWork<'a, P = Process>(&'a Processes<P>);

impl<P> Default for Processes<P> {
    fn default() -> Self {
        Self { state: Mutex::new(State { waiting: Vec::new(), at_work: 0 }) }
    }
}

impl<P> Processes<P> {
    fn state(&self) -> MutexGuard<'_, State<P>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<P: Resident> Processes<P> {
    /// Tells that a process begins to work on a job of this lane and project. Returns one that waits, unless a new one had better be
    /// started or is wanted (`fresh`); of the others those end that there is no memory for.
    pub(super) fn begin(
        &self,
        lane: Lane,
        project: ProjectId,
        fresh: bool,
        options: &WorkerOptions,
    ) -> (AtWork<'_, P>, Option<P>) {
        let mut state = self.state();
        state.at_work += 1;
        state.waiting.retain_mut(|waiting| waiting.process.lives());
        let found = if fresh { None } else { state.best(lane, project, options.workers) };
        let found = found.map(|at| state.waiting.remove(at).process);
        state.make_room(options);
        (AtWork(self), found)
    }

    /// Keeps a process for further jobs when it has done one of this project, if what it still takes is worth it; and ends the right to
    /// be at work.
    pub(super) fn keep(
        &self,
        at_work: AtWork<'_, P>,
        mut process: P,
        project: ProjectId,
        options: &WorkerOptions,
        now: Instant,
    ) {
        drop(at_work);
        let most = match process.lane() {
            Lane::Ingest => options.memory_bytes / 8,
            Lane::Map => options.memory_bytes / 4 * 3,
        };
        if process.memory() > most {
            return;
        }
        let known = process.worked_on();
        known.retain(|known| *known != project);
        known.push(project);
        known.drain(..known.len().saturating_sub(CAPACITY));
        let mut state = self.state();
        state.waiting.push(Waiting { process, since: now });
        state.make_room(options);
    }

    /// Ends the processes that have waited long enough.
    pub(in crate::jobs) fn retire(&self, now: Instant) {
        self.state().waiting.retain(|waiting| now.saturating_duration_since(waiting.since) < WAITS_FOR);
    }
}

impl<P: Resident> State<P> {
    /// Which of those that wait had best do a job of this lane and project; `None`: a new one.
    fn best(&mut self, lane: Lane, project: ProjectId, workers: usize) -> Option<usize> {
        let of_lane = |waiting: &Waiting<P>| waiting.process.lane() == lane;
        // What is at work may all be of this lane.
        let room = self.waiting.iter().filter(|waiting| of_lane(waiting)).count() + self.at_work <= workers;
        let any = self.waiting.iter().position(of_lane)?;
        let mut all = self.waiting.iter_mut();
        let known =
            all.position(|waiting| of_lane(waiting) && waiting.process.worked_on().contains(&project));
        // Another project's model stays where it is while there is room for one more process.
        known.or((lane == Lane::Ingest || !room).then_some(any))
    }

    /// Ends those that wait longest until the others take no more than what nobody at work may take, and a quarter of one's share.
    fn make_room(&mut self, options: &WorkerOptions) {
        let unused = options.workers.saturating_sub(self.at_work) as u64;
        let most = options.memory_bytes.saturating_mul(unused).saturating_add(options.memory_bytes / 4);
        let mut taken = 0_u64;
        let kept = self.waiting.iter().rev().take_while(|waiting| {
            taken = taken.saturating_add(waiting.process.memory());
            taken <= most
        });
        let ended = self.waiting.len() - kept.count();
        self.waiting.drain(..ended);
    }
}

impl<P> Drop for AtWork<'_, P> {
    fn drop(&mut self) {
        self.0.state().at_work -= 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHARE: u64 = 1 << 30;

    #[derive(Debug, PartialEq)]
    struct Fake {
        name: u32,
        lane: Lane,
        memory: u64,
        ended: bool,
        worked_on: Vec<ProjectId>,
    }

    impl Resident for Fake {
        fn lives(&mut self) -> bool {
            !self.ended
        }
        fn memory(&self) -> u64 {
            self.memory
        }
        fn lane(&self) -> Lane {
            self.lane
        }
        fn worked_on(&mut self) -> &mut Vec<ProjectId> {
            &mut self.worked_on
        }
    }

    fn options(workers: usize) -> WorkerOptions {
        let whatever = Duration::from_mins(1);
        WorkerOptions {
            workers,
            lease: whatever,
            poll: whatever,
            progress_every: whatever,
            batch: 1,
            max_points: 1,
            memory_bytes: SHARE,
            job_limit: whatever,
            isolated: None,
            collect_every: whatever,
            grace: whatever,
        }
    }

    fn mapper(name: u32, memory: u64) -> Fake {
        Fake { name, lane: Lane::Map, memory, ended: false, worked_on: Vec::new() }
    }

    impl Processes<Fake> {
        /// A process that has done a job of a project and is given back.
        fn done(&self, process: Fake, project: ProjectId, options: &WorkerOptions) {
            let (at_work, _) = self.begin(process.lane, project, true, options);
            self.keep(at_work, process, project, options, Instant::now());
        }

        fn names(&self) -> Vec<u32> {
            self.state().waiting.iter().map(|waiting| waiting.process.name).collect()
        }
    }

    #[test]
    fn a_job_goes_to_the_process_that_knows_its_project_and_otherwise_to_a_new_one_while_there_is_room() {
        let (pool, options) = (Processes::default(), options(2));
        let [a, b, c] = [(); 3].map(|()| ProjectId::generate());
        pool.done(mapper(1, 1), a, &options);
        let (at_work, found) = pool.begin(Lane::Map, b, false, &options);
        assert_eq!(found, None, "the model of the first project stays where it is");
        pool.keep(at_work, mapper(2, 1), b, &options, Instant::now());
        let (_one, found) = pool.begin(Lane::Map, a, false, &options);
        assert_eq!(found.unwrap().name, 1);
        let (_two, found) = pool.begin(Lane::Map, c, false, &options);
        assert_eq!(found.unwrap().name, 2, "no more than two have room");
        assert_eq!(pool.names(), [0; 0]);
    }

    #[test]
    fn readers_serve_any_project_but_no_other_lane_and_suspects_get_none() {
        let (pool, options) = (Processes::default(), options(2));
        let [a, b] = [(); 2].map(|()| ProjectId::generate());
        pool.done(Fake { lane: Lane::Ingest, ..mapper(1, 1) }, a, &options);
        assert_eq!(pool.begin(Lane::Map, a, false, &options).1, None);
        assert_eq!(pool.begin(Lane::Ingest, b, true, &options).1, None);
        assert_eq!(pool.begin(Lane::Ingest, b, false, &options).1.unwrap().name, 1);
    }

    #[test]
    fn one_that_has_ended_is_not_given_out() {
        let (pool, options) = (Processes::default(), options(2));
        let project = ProjectId::generate();
        pool.done(Fake { ended: true, ..mapper(1, 1) }, project, &options);
        assert_eq!(pool.begin(Lane::Map, project, false, &options).1, None);
        assert_eq!(pool.names(), [0; 0]);
    }

    #[test]
    fn those_that_wait_and_those_at_work_take_no_more_than_all_workers_and_a_quarter() {
        let (pool, options) = (Processes::default(), options(2));
        let projects = [(); 4].map(|()| ProjectId::generate());
        for (name, project) in (1..).zip(projects) {
            pool.done(mapper(name, SHARE / 4 * 3), project, &options);
        }
        assert_eq!(pool.names(), [3, 4], "one was at work before each was kept");
        let (_one, _) = pool.begin(Lane::Ingest, projects[3], false, &options);
        assert_eq!(pool.names(), [4], "one at work, 3 of 5 quarters");
        let (_two, found) = pool.begin(Lane::Map, projects[3], false, &options);
        assert_eq!(
            found.unwrap().name,
            4,
            "what it may take as one that works is no longer counted as waiting"
        );
        pool.state().waiting.push(Waiting { process: mapper(5, SHARE / 4 + 1), since: Instant::now() });
        drop(pool.begin(Lane::Ingest, projects[0], false, &options));
        assert_eq!(pool.names(), [0; 0], "all at work, and more than a quarter");
    }

    #[test]
    fn one_that_still_takes_much_is_not_kept() {
        let (pool, options) = (Processes::default(), options(4));
        let project = ProjectId::generate();
        pool.done(mapper(1, SHARE / 4 * 3 + 1), project, &options);
        pool.done(Fake { lane: Lane::Ingest, ..mapper(2, SHARE / 8 + 1) }, project, &options);
        assert_eq!(pool.names(), [0; 0]);
    }

    #[test]
    fn who_waits_long_enough_ends() {
        let (pool, options) = (Processes::default(), options(2));
        let begun = Instant::now();
        for (name, after) in [(1, Duration::ZERO), (2, WAITS_FOR / 2)] {
            let project = ProjectId::generate();
            let (at_work, _) = pool.begin(Lane::Map, project, true, &options);
            pool.keep(at_work, mapper(name, 1), project, &options, begun + after);
        }
        pool.retire(begun + WAITS_FOR / 2);
        assert_eq!(pool.names(), [1, 2]);
        pool.retire(begun + WAITS_FOR);
        assert_eq!(pool.names(), [2]);
        pool.retire(begun + 2 * WAITS_FOR);
        assert_eq!(pool.names(), [0; 0]);
    }

    #[test]
    fn only_the_projects_whose_models_it_may_still_hold_are_remembered() {
        let (pool, options) = (Processes::default(), options(1));
        let projects: Vec<ProjectId> = (0..=CAPACITY).map(|_| ProjectId::generate()).collect();
        pool.done(mapper(1, 1), projects[0], &options);
        for project in &projects[1..] {
            let (at_work, found) = pool.begin(Lane::Map, *project, false, &options);
            pool.keep(at_work, found.unwrap(), *project, &options, Instant::now());
        }
        let mut known = pool.begin(Lane::Map, projects[0], false, &options).1.unwrap();
        assert_eq!(*known.worked_on(), projects[1..]);
    }
}
