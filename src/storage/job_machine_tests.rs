//! The table of jobs against a model of what it should do: random uploads, claims, renewals, failures of all kinds, crashes, silence,
//! dismissals, deletions, restarts and publications, by workers that hold their claims and by those that have lost them.

use std::time::Duration;

use proptest::prelude::*;
use serde_json::json;

use super::testing::{Fixture, new_scan, project};
use super::{BlobId, Claim, Lease, Publication, Retry, ScanChange, Seal, StorageError, StoredBlob};
use crate::project::{
    Fault, Job, JobId, JobKind, JobState, Lane, ProjectId, Reason, ScanId, Standing, VersionNumber,
};

const LONG: Duration = Duration::from_mins(10);

#[derive(Debug, Clone)]
enum Action {
    Upload { project: usize, content: u8 },
    Rebuild { project: usize },
    Claim { lane: Lane, batch: u32, lapses: bool },
    // Claims are counted from the last one, which is most likely still held.
    Renew { claim: usize },
    Finish { claim: usize },
    Fail { claim: usize, retry: Retry },
    Crash { claim: usize },
    Release { claim: usize },
    Dismiss { job: usize },
    Delete { scan: usize },
    Sweep,
    Restart,
}

fn action() -> impl Strategy<Value = Action> {
    let lane = prop_oneof![Just(Lane::Ingest), Just(Lane::Map)];
    let batch = prop_oneof![Just(1_u32), Just(3)];
    let retry = prop_oneof![
        1 => Just(Retry::Never),
        3 => Just(Retry::AFewTimes),
        2 => Just(Retry::UntilItPasses)
    ];
    let recent = || prop_oneof![4 => Just(0_usize), 2 => Just(1), 1 => 2..6_usize];
    prop_oneof![
        6 => (0..2_usize, 0..6_u8).prop_map(|(project, content)| Action::Upload { project, content }),
        1 => (0..2_usize).prop_map(|project| Action::Rebuild { project }),
        10 => (lane, batch, any::<bool>())
            .prop_map(|(lane, batch, lapses)| Action::Claim { lane, batch, lapses }),
        2 => recent().prop_map(|claim| Action::Renew { claim }),
        7 => recent().prop_map(|claim| Action::Finish { claim }),
        5 => (recent(), retry).prop_map(|(claim, retry)| Action::Fail { claim, retry }),
        3 => recent().prop_map(|claim| Action::Crash { claim }),
        1 => recent().prop_map(|claim| Action::Release { claim }),
        2 => (0..30_usize).prop_map(|job| Action::Dismiss { job }),
        2 => (0..6_usize).prop_map(|scan| Action::Delete { scan }),
        2 => Just(Action::Sweep),
        1 => Just(Action::Restart),
    ]
}

/// A job as it should be.
#[derive(Debug)]
struct Modelled {
    id: JobId,
    project: ProjectId,
    kind: JobKind,
    scan: Option<ScanId>,
    lane: Lane,
    ended: Option<JobState>,
    /// The attempt that holds it.
    held: Option<u32>,
    leader: Option<JobId>,
    lapses: bool,
    tries: u32,
    crashes: u32,
}

struct World {
    at: Fixture,
    projects: [ProjectId; 2],
    /// In the order of acceptance.
    jobs: Vec<Modelled>,
    /// Scans that were not deleted.
    scans: Vec<(ProjectId, ScanId)>,
    /// Every claim that there ever was.
    claims: Vec<(Lane, Claim)>,
}

fn fault() -> Fault {
    Fault { code: "internal-error".to_owned(), detail: "for the test".to_owned() }
}

impl World {
    async fn new() -> Self {
        let at = Fixture::new().await;
        let projects = [at.project, project(&at.store).await];
        Self { at, projects, jobs: Vec::new(), scans: Vec::new(), claims: Vec::new() }
    }

    fn job(&mut self, id: JobId) -> &mut Modelled {
        self.jobs.iter_mut().find(|job| job.id == id).unwrap()
    }

    fn accepted(&mut self, job: &Job, lane: Lane) {
        self.jobs.push(Modelled {
            id: job.id,
            project: job.project,
            kind: job.kind,
            scan: job.scan,
            lane,
            ended: None,
            held: None,
            leader: None,
            lapses: false,
            tries: 0,
            crashes: 0,
        });
    }

    fn members(&self, leader: JobId) -> Vec<JobId> {
        self.jobs.iter().filter(|job| job.leader == Some(leader)).map(|job| job.id).collect()
    }

    fn holds(&self, lease: &Lease) -> bool {
        let held = |job: &Modelled| job.id == lease.job && job.held == Some(lease.attempt);
        self.jobs.iter().any(held) && self.members(lease.job).len() == lease.members.len()
    }

    /// Nobody holds a job and its batch any more.
    fn free(&mut self, id: JobId) {
        for job in &mut self.jobs {
            if job.id == id {
                (job.held, job.leader) = (None, None);
            } else if job.leader == Some(id) {
                job.leader = None;
            }
        }
    }

    fn end(&mut self, id: JobId, state: JobState) {
        self.free(id);
        self.job(id).ended = Some(state);
    }

    /// Counts a failure against a job that is not held any more, or against each of a batch.
    fn count(&mut self, lease: &Lease, counter: impl Fn(&mut Modelled) -> &mut u32, most: u32) {
        let alone = lease.members.is_empty();
        for id in lease.all() {
            let n = counter(self.job(id));
            *n += 1;
            if alone && *n >= most {
                self.end(id, JobState::Failed);
            }
        }
    }

    /// What a worker's write comes to: only the holder of the whole claim changes anything. Returns whether it did.
    fn fenced(&self, lease: &Lease, answer: &Result<(), StorageError>) -> bool {
        match (self.holds(lease), answer) {
            (true, Ok(())) => true,
            (false, Err(StorageError::Fenced { job, .. })) if *job == lease.job => false,
            (holds, answer) => panic!("held: {holds}, but {answer:?} came of {lease:?}"),
        }
    }

    async fn claim(&mut self, lane: Lane, batch: u32, lapses: bool) {
        let mut tx = self.at.store.begin().await.unwrap();
        sqlx::query("UPDATE jobs SET not_before_ms = 0").execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
        let lease = if lapses { Duration::ZERO } else { LONG };
        let Some(claim) = self.at.store.claim(lane, "worker", lease, batch, true).await.unwrap() else {
            for project in self.projects {
                let mut open = self.jobs.iter().filter(|job| job.project == project && job.ended.is_none());
                let mapped = open.clone().any(|job| job.lane == Lane::Map && job.held.is_some());
                let ready = |job: &Modelled| job.lane == lane && job.held.is_none() && job.leader.is_none();
                let passed_over = match lane {
                    Lane::Ingest => open.any(ready),
                    Lane::Map => !mapped && open.next().is_some_and(ready),
                };
                assert!(!passed_over, "there was a job to be had");
            }
            return;
        };
        let project = claim.job.project;
        if lane == Lane::Map {
            let mapped =
                |job: &Modelled| job.project == project && job.lane == Lane::Map && job.held.is_some();
            assert!(!self.jobs.iter().any(mapped), "two map one project");
        }
        let alone = claim.members.is_empty();
        for id in claim.lease.all() {
            let job = self.job(id);
            assert_eq!((job.project, job.lane, job.ended), (project, lane, None));
            assert_eq!((job.held, job.leader), (None, None), "it was held already");
            assert!(alone || job.tries + job.crashes == 0, "what failed before goes alone");
            job.leader = Some(claim.lease.job).filter(|leader| *leader != id);
        }
        let leader = self.job(claim.lease.job);
        (leader.held, leader.lapses) = (Some(claim.lease.attempt), lapses);
        self.claims.push((lane, claim));
    }

    async fn finish(&mut self, lane: Lane, claim: &Claim) {
        let lease = &claim.lease;
        let answer = match lane {
            Lane::Ingest => self.at.store.finish_ingest(lease).await,
            Lane::Map => self.at.store.publish(lease, &publication(claim)).await,
        };
        if !self.fenced(lease, &answer) {
            return;
        }
        self.free(lease.job);
        for id in lease.all() {
            let job = self.job(id);
            match lane {
                Lane::Ingest => (job.lane, job.tries, job.crashes) = (Lane::Map, 0, 0),
                Lane::Map => job.ended = Some(JobState::Succeeded),
            }
        }
    }

    async fn fail(&mut self, lease: &Lease, retry: Retry) {
        let answer = self.at.store.fail(lease, &fault(), retry).await;
        if !self.fenced(lease, &answer) {
            return;
        }
        self.free(lease.job);
        match retry {
            Retry::Never => self.count(lease, |job| &mut job.tries, 0),
            Retry::AFewTimes => self.count(lease, |job| &mut job.tries, 3),
            Retry::UntilItPasses => {}
        }
    }

    async fn sweep(&mut self) {
        // A lease of no time runs out in the next millisecond.
        tokio::time::sleep(Duration::from_millis(3)).await;
        let overdue = self.at.store.overdue().await.unwrap();
        let silent = self.jobs.iter().filter(|job| job.lapses).filter_map(|job| Some((job.id, job.held?)));
        let silent: Vec<_> = silent.collect();
        assert_eq!(overdue.len(), silent.len());
        self.at.store.reclaim_silent(&overdue, true).await.unwrap();
        for (job, attempt) in silent {
            let lease = Lease { job, attempt, members: self.members(job) };
            self.free(job);
            self.count(&lease, |job| &mut job.crashes, 3);
        }
    }

    async fn act(&mut self, action: &Action) {
        let store = self.at.store.clone();
        let nth = |n: usize| self.claims.iter().rev().nth(n).cloned();
        match *action {
            Action::Upload { project, content } => {
                let project = self.projects[project];
                let blob = StoredBlob { id: BlobId(blake3::hash(&[content])), bytes: 1 };
                let admitted = store.admit_scan(&new_scan(project, content.into(), blob)).await.unwrap();
                if admitted.duplicate {
                    let ended = self.job(admitted.job.id).ended;
                    assert!(matches!(ended, None | Some(JobState::Succeeded)), "it should have another job");
                } else {
                    self.accepted(&admitted.job, Lane::Ingest);
                    self.scans.retain(|(_, scan)| *scan != admitted.scan.id);
                    self.scans.push((project, admitted.scan.id));
                }
            }
            Action::Rebuild { project } => {
                let job = store.create_job(self.projects[project], JobKind::Rebuild, None, Seal::none());
                self.accepted(&job.await.unwrap(), Lane::Map);
            }
            Action::Claim { lane, batch, lapses } => self.claim(lane, batch, lapses).await,
            Action::Renew { claim } => {
                let Some((_, claim)) = nth(claim) else { return };
                let answer = store.renew(&claim.lease, LONG, Some("match"), 50).await;
                if self.fenced(&claim.lease, &answer) {
                    self.job(claim.lease.job).lapses = false;
                }
            }
            Action::Finish { claim } => {
                let Some((lane, claim)) = nth(claim) else { return };
                self.finish(lane, &claim).await;
            }
            Action::Fail { claim, retry } => {
                let Some((_, claim)) = nth(claim) else { return };
                self.fail(&claim.lease, retry).await;
            }
            Action::Crash { claim } => {
                let Some((_, claim)) = nth(claim) else { return };
                let answer = store.crashed(&claim.lease, &fault()).await;
                if self.fenced(&claim.lease, &answer) {
                    self.free(claim.lease.job);
                    self.count(&claim.lease, |job| &mut job.crashes, 3);
                }
            }
            Action::Release { claim } => {
                let Some((_, claim)) = nth(claim) else { return };
                store.release(&claim.lease).await.unwrap();
                // Also if the batch is no longer whole.
                if self.job(claim.lease.job).held == Some(claim.lease.attempt) {
                    self.free(claim.lease.job);
                }
            }
            Action::Dismiss { job } => {
                let Some(job) = self.jobs.get(job) else { return };
                let (id, may) = (job.id, job.ended.is_none() && job.kind != JobKind::Removal);
                match store.dismiss_job(id).await {
                    Ok(_) if may => self.end(id, JobState::Dismissed),
                    Err(StorageError::JobEnded(_)) if !may => {}
                    other => panic!("may be dismissed: {may}, but {other:?} came of it"),
                }
            }
            Action::Delete { scan } => {
                if scan >= self.scans.len() {
                    return;
                }
                let (project, scan) = self.scans.remove(scan);
                let removal = store.delete_scan(project, scan).await.unwrap();
                let open = self.jobs.iter().find(|job| job.scan == Some(scan) && job.ended.is_none());
                if let Some(id) = open.map(|job| job.id) {
                    self.end(id, JobState::Dismissed);
                }
                self.accepted(&removal, Lane::Map);
            }
            Action::Sweep => self.sweep().await,
            Action::Restart => self.restart().await,
        }
    }

    async fn restart(&mut self) {
        let held: Vec<_> = self.jobs.iter().filter(|job| job.held.is_some()).map(|job| job.id).collect();
        assert_eq!(self.at.store.reclaim(true).await.unwrap(), held.len());
        for id in held {
            self.free(id);
        }
    }

    /// Every job is as the model says, and the rows make sense together.
    async fn check(&self) {
        for job in &self.jobs {
            let found = self.at.store.job(job.id).await.unwrap();
            assert_eq!(Some(found.state).filter(|state| state.is_final()), job.ended, "{job:?}");
            assert_eq!(found.fault.is_some(), job.ended == Some(JobState::Failed), "{job:?}");
        }
        assert_eq!(self.at.store.integrity().await.unwrap(), [""; 0]);
    }
}

/// A version of nothing new, in which the scans of a claim wait, or from which its scan is gone.
fn publication(claim: &Claim) -> Publication {
    let jobs = || std::iter::once(&claim.job).chain(&claim.members);
    let scans = |kind| jobs().filter(move |job| job.kind == kind).filter_map(|job| job.scan);
    let waiting =
        || Standing::Waiting(Reason { reason: "only-scan".to_owned(), numbers: serde_json::Map::new() });
    Publication {
        project: claim.job.project,
        kind: claim.job.kind,
        from: VersionNumber::EMPTY,
        version: None,
        pairs: Vec::new(),
        engine: "test".to_owned(),
        scans: scans(JobKind::Registration).map(|scan| ScanChange { scan, standing: waiting() }).collect(),
        forgotten: scans(JobKind::Removal).collect(),
        outcomes: jobs().map(|job| (job.id, Ok(json!({})))).collect(),
    }
}

async fn play(actions: Vec<Action>) {
    let mut world = World::new().await;
    for action in &actions {
        world.act(action).await;
        world.check().await;
    }
    // Whatever happened, good workers bring everything to an end.
    world.restart().await;
    for _ in 0..2 * world.jobs.len() {
        for lane in [Lane::Ingest, Lane::Map] {
            let before = world.claims.len();
            world.claim(lane, 3, false).await;
            if let Some((lane, claim)) = world.claims.get(before).cloned() {
                world.finish(lane, &claim).await;
            }
        }
    }
    assert!(world.jobs.iter().all(|job| job.ended.is_some()), "jobs are stuck");
    world.check().await;
    world.at.store.close().await;
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]

    #[test]
    fn whatever_workers_and_clients_do_jobs_are_where_the_model_says_and_all_end(
        actions in prop::collection::vec(action(), 1..60)
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(play(actions));
    }
}
