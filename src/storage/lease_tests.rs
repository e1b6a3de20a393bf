//! Leases, fences and the order of the queue, on a real database.

use std::time::Duration;

use serde_json::json;

use super::testing::{Fixture, new_scan, project};
use super::{
    Admission, BlobId, Claim, JobFilter, Measures, Page, Publication, Retry, Seal, StorageError, Store,
    StoredBlob,
};
use crate::project::{Fault, JobKind, JobState, Lane, Name, ProjectSettings, ScanState, VersionNumber};

const LONG: Duration = Duration::from_mins(10);

impl Fixture {
    async fn scan(&self, content: u8) -> Admission {
        let blob = StoredBlob { id: BlobId(blake3::hash(&[content])), bytes: 1 };
        let new = new_scan(self.project, content.into(), blob);
        self.store.admit_scan(&new).await.unwrap()
    }

    /// Makes the wait between attempts pass: it is not what is tested here.
    async fn waited(&self) {
        let mut tx = self.store.begin().await.unwrap();
        sqlx::query("UPDATE jobs SET not_before_ms = 0").execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
    }

    async fn claim(&self, lane: Lane) -> Option<Claim> {
        self.store.claim(lane, "worker", LONG, 10, false).await.unwrap()
    }

    /// A scan whose registration waits for the mapper.
    async fn ingested(&self, content: u8) -> Admission {
        let admission = self.scan(content).await;
        let claim = self.claim(Lane::Ingest).await.unwrap();
        assert_eq!(claim.job.id, admission.job.id);
        let measures = Measures { points: 1, colored: false, extent: 1.0, scale: 0.1 };
        self.store.record_measures(&claim.lease, measures).await.unwrap();
        self.store.finish_ingest(&claim.lease).await.unwrap();
        admission
    }

    /// A publication that changes nothing but the jobs.
    fn ending(&self, claim: &Claim) -> Publication {
        Publication {
            project: self.project,
            kind: claim.job.kind,
            from: VersionNumber::EMPTY,
            version: None,
            pairs: Vec::new(),
            engine: "test".to_owned(),
            scans: Vec::new(),
            forgotten: Vec::new(),
            outcomes: claim.lease.all().map(|job| (job, Ok(json!({})))).collect(),
        }
    }
}

#[tokio::test]
async fn a_job_is_held_once_and_after_its_lease_by_another_who_fences_the_first() {
    let f = Fixture::new().await;
    f.scan(1).await;
    let first = f.store.claim(Lane::Ingest, "a", Duration::ZERO, 1, false).await.unwrap().unwrap();
    assert!(f.claim(Lane::Ingest).await.is_none(), "it is held");
    tokio::time::sleep(Duration::from_millis(5)).await;
    let overdue = f.store.overdue().await.unwrap();
    assert_eq!(f.store.reclaim_silent(&overdue, false).await.unwrap(), 1);
    let second = f.claim(Lane::Ingest).await.unwrap();
    assert_eq!(second.lease.attempt, first.lease.attempt + 1);
    for result in
        [f.store.renew(&first.lease, LONG, None, 0).await, f.store.finish_ingest(&first.lease).await]
    {
        assert!(matches!(result, Err(StorageError::Fenced { .. })), "{result:?}");
    }
    f.store.renew(&second.lease, LONG, Some("decode"), 5).await.unwrap();
    f.store.finish_ingest(&second.lease).await.unwrap();
}

#[tokio::test]
async fn mapping_is_serial_in_a_project_and_takes_what_waits_in_one_batch() {
    let f = Fixture::new().await;
    let first = f.ingested(1).await;
    let leader = f.claim(Lane::Map).await.unwrap();
    assert_eq!((leader.job.id, leader.members.len()), (first.job.id, 0));
    let later = [f.ingested(2).await, f.ingested(3).await];
    assert!(f.claim(Lane::Map).await.is_none(), "the project is being mapped");
    f.store.publish(&leader.lease, &f.ending(&leader)).await.unwrap();
    let batch = f.claim(Lane::Map).await.unwrap();
    let ids: Vec<_> = batch.lease.all().collect();
    assert_eq!(ids, later.map(|a| a.job.id));
    f.store.publish(&batch.lease, &f.ending(&batch)).await.unwrap();
    for id in ids {
        assert_eq!(f.store.job(id).await.unwrap().state, JobState::Succeeded);
    }
}

#[tokio::test]
async fn a_batch_that_fails_is_tried_again_one_by_one() {
    let f = Fixture::new().await;
    let (a, b) = (f.ingested(1).await, f.ingested(2).await);
    let fault = Fault { code: "internal-error".to_owned(), detail: "for the test".to_owned() };
    let both = f.claim(Lane::Map).await.unwrap();
    assert_eq!(both.members.len(), 1);
    f.store.fail(&both.lease, &fault, Retry::AFewTimes).await.unwrap();
    let alone = f.claim(Lane::Map).await.unwrap();
    assert_eq!((alone.job.id, alone.members.len()), (a.job.id, 0));
    f.store.fail(&alone.lease, &fault, Retry::Never).await.unwrap();
    assert_eq!(f.store.job(a.job.id).await.unwrap().fault, Some(fault));
    assert_eq!(f.store.scan(f.project, a.scan.id).await.unwrap().state, ScanState::Failed);
    let other = f.claim(Lane::Map).await.unwrap();
    assert_eq!((other.job.id, other.members.len()), (b.job.id, 0));
}

#[tokio::test]
async fn a_failure_that_may_pass_is_retried_twice_and_then_final() {
    let f = Fixture::new().await;
    let job = f.scan(1).await.job.id;
    let fault = Fault { code: "storage".to_owned(), detail: "for the test".to_owned() };
    for _ in 0..3 {
        let claim = loop {
            match f.claim(Lane::Ingest).await {
                Some(claim) => break claim,
                None => tokio::time::sleep(Duration::from_millis(20)).await,
            }
        };
        f.store.fail(&claim.lease, &fault, Retry::AFewTimes).await.unwrap();
    }
    let job = f.store.job(job).await.unwrap();
    assert_eq!((job.state, job.attempt), (JobState::Failed, 3));
}

#[tokio::test]
async fn dismissing_a_member_frees_the_rest_of_its_batch() {
    let f = Fixture::new().await;
    let (a, b) = (f.ingested(1).await, f.ingested(2).await);
    let both = f.claim(Lane::Map).await.unwrap();
    f.store.dismiss_job(b.job.id).await.unwrap();
    let published = f.store.publish(&both.lease, &f.ending(&both)).await;
    assert!(
        matches!(published, Err(StorageError::Fenced { .. })),
        "a dismissed scan may not enter the model"
    );
    f.store.release(&both.lease).await.unwrap();
    let again = f.claim(Lane::Map).await.unwrap();
    assert_eq!((again.job.id, again.members.len()), (a.job.id, 0));
    assert_eq!(f.store.scan(f.project, b.scan.id).await.unwrap().state, ScanState::Dismissed);
}

#[tokio::test]
async fn dismissing_the_leader_frees_its_members() {
    let f = Fixture::new().await;
    let (a, b) = (f.ingested(1).await, f.ingested(2).await);
    f.claim(Lane::Map).await.unwrap();
    f.store.dismiss_job(a.job.id).await.unwrap();
    assert_eq!(f.claim(Lane::Map).await.unwrap().job.id, b.job.id);
}

#[tokio::test]
async fn deleting_the_scan_of_the_leader_frees_its_members() {
    let f = Fixture::new().await;
    let (a, b) = (f.ingested(1).await, f.ingested(2).await);
    let both = f.claim(Lane::Map).await.unwrap();
    let removal = f.store.delete_scan(f.project, a.scan.id).await.unwrap();
    f.store.release(&both.lease).await.unwrap();
    for expected in [b.job.id, removal.id] {
        let claim = f.claim(Lane::Map).await.unwrap();
        assert_eq!(claim.job.id, expected);
        f.store.publish(&claim.lease, &f.ending(&claim)).await.unwrap();
    }
}

#[tokio::test]
async fn a_removal_comes_before_the_same_content_again_and_a_rebuild_after_all() {
    let f = Fixture::new().await;
    let scan = f.ingested(1).await;
    let claim = f.claim(Lane::Map).await.unwrap();
    f.store.publish(&claim.lease, &f.ending(&claim)).await.unwrap();
    let removal = f.store.delete_scan(f.project, scan.scan.id).await.unwrap();
    let again = f.ingested(1).await;
    assert!(!again.duplicate, "the deleted scan does not count");
    let rebuild = f.store.create_job(f.project, JobKind::Rebuild, None, Seal::none()).await.unwrap();
    let mut order = Vec::new();
    while let Some(claim) = f.claim(Lane::Map).await {
        order.push(claim.job.id);
        f.store.publish(&claim.lease, &f.ending(&claim)).await.unwrap();
    }
    assert_eq!(order, [removal.id, again.job.id, rebuild.id]);
}

#[tokio::test]
async fn from_the_ninth_scan_on_the_first_eight_are_waited_for() {
    let f = Fixture::new().await;
    f.scan(0).await;
    let slow = f.claim(Lane::Ingest).await.unwrap();
    for content in 1..=9 {
        f.ingested(content).await;
    }
    let batch = f.claim(Lane::Map).await.unwrap();
    assert_eq!(batch.lease.all().count(), 7, "the second to the eighth");
    f.store.publish(&batch.lease, &f.ending(&batch)).await.unwrap();
    assert!(f.claim(Lane::Map).await.is_none());
    f.store.finish_ingest(&slow.lease).await.unwrap();
    assert_eq!(f.claim(Lane::Map).await.unwrap().lease.all().count(), 3);
}

#[tokio::test]
async fn a_job_whose_workers_die_again_and_again_fails_and_says_so() {
    let f = Fixture::new().await;
    let job = f.scan(1).await.job.id;
    for _ in 0..8 {
        assert!(!f.store.job(job).await.unwrap().state.is_final());
        f.waited().await;
        f.claim(Lane::Ingest).await.unwrap();
        f.store.reclaim(false).await.unwrap();
    }
    assert_eq!(f.store.job(job).await.unwrap().state, JobState::Failed);
    assert_eq!(f.store.job(job).await.unwrap().fault.unwrap().code, "worker-lost");
}

#[tokio::test]
async fn a_data_directory_serves_one_process_and_keeps_what_was_committed() {
    let dir = tempfile::tempdir().unwrap();
    let store = Store::open(dir.path()).await.unwrap();
    assert!(matches!(Store::open(dir.path()).await, Err(StorageError::InUse)));
    let name = Name::parse("kept").unwrap();
    let project = store.create_project(&name, &ProjectSettings::default(), Seal::none()).await.unwrap();
    store.close().await;
    drop(store);
    let store = Store::open(dir.path()).await.unwrap();
    assert_eq!(store.project(project.id).await.unwrap(), project);
    let page = Page { after: None, limit: 10 };
    assert!(store.jobs(project.id, JobFilter::default(), page).await.unwrap().is_empty());
}

#[tokio::test]
async fn a_dismissed_scan_that_comes_again_gets_a_job_and_its_old_worker_changes_nothing() {
    let f = Fixture::new().await;
    let first = f.scan(1).await;
    let old = f.claim(Lane::Ingest).await.unwrap();
    f.store.dismiss_job(first.job.id).await.unwrap();
    let again = f.scan(1).await;
    assert_eq!(
        (again.scan.id, again.scan.state, again.duplicate),
        (first.scan.id, ScanState::Received, false)
    );
    assert!(matches!(f.store.finish_ingest(&old.lease).await, Err(StorageError::Fenced { .. })));
    assert!(f.scan(1).await.duplicate, "it is on its way now");
    let claim = f.claim(Lane::Ingest).await.unwrap();
    assert_eq!((claim.job.id, claim.job.scan), (again.job.id, Some(first.scan.id)));
}

#[tokio::test]
async fn a_project_of_many_scans_does_not_keep_another_waiting() {
    let f = Fixture::new().await;
    for content in 0..50 {
        f.scan(content).await;
    }
    let small = project(&f.store).await;
    let other = Fixture { store: f.store.clone(), project: small, dir: tempfile::tempdir().unwrap() };
    let single = other.scan(100).await;
    let first = f.claim(Lane::Ingest).await.unwrap();
    assert_eq!(first.job.project, f.project);
    let second = f.claim(Lane::Ingest).await.unwrap();
    assert_eq!(
        second.job.id, single.job.id,
        "while one worker is at the large project, the other is at the small one"
    );
    for claim in [&second, &first] {
        f.store.finish_ingest(&claim.lease).await.unwrap();
    }
    // With nobody at either, whose turn was longer ago comes first.
    other.scan(101).await;
    assert_eq!(f.claim(Lane::Ingest).await.unwrap().job.project, f.project);
    assert_eq!(f.claim(Lane::Ingest).await.unwrap().job.project, small);
    let mapped = [f.claim(Lane::Map).await.unwrap(), f.claim(Lane::Map).await.unwrap()];
    assert_ne!(mapped[0].job.project, mapped[1].job.project);
}

#[tokio::test]
async fn only_the_death_of_its_own_process_counts_against_a_job_that_has_one() {
    let f = Fixture::new().await;
    let (bad, good) = (f.ingested(1).await.job.id, f.ingested(2).await.job.id);
    for _ in 0..20 {
        let claim = f.store.claim(Lane::Map, "worker", LONG, 10, true).await.unwrap().unwrap();
        assert_eq!(claim.members.len(), 1, "suspects go together where they can do no harm");
        f.store.reclaim(true).await.unwrap();
    }
    let fault = Fault { code: "worker-lost".to_owned(), detail: "for the test".to_owned() };
    let both = f.store.claim(Lane::Map, "worker", LONG, 10, true).await.unwrap().unwrap();
    assert!(both.suspect);
    assert_eq!(f.store.held(bad, both.lease.attempt).await.unwrap(), (Lane::Map, both.clone()));
    f.store.crashed(&both.lease, &fault).await.unwrap();
    for _ in 0..2 {
        f.waited().await;
        let alone = f.store.claim(Lane::Map, "worker", LONG, 10, true).await.unwrap().unwrap();
        assert_eq!((alone.job.id, alone.members.len()), (bad, 0), "a batch that crashed is tried one by one");
        f.store.crashed(&alone.lease, &fault).await.unwrap();
    }
    assert_eq!(f.store.job(bad).await.unwrap().fault, Some(fault));
    let next = f.store.claim(Lane::Map, "worker", LONG, 10, true).await.unwrap().unwrap();
    assert_eq!(next.job.id, good);
}

#[tokio::test]
async fn what_is_not_the_jobs_doing_uses_up_no_attempt() {
    let f = Fixture::new().await;
    let job = f.scan(1).await.job.id;
    let fault = Fault { code: "storage".to_owned(), detail: "for the test".to_owned() };
    let mut attempts = 0;
    for round in 0..12 {
        f.waited().await;
        let claim = f.claim(Lane::Ingest).await.unwrap();
        let retry = if round % 5 == 4 { Retry::AFewTimes } else { Retry::UntilItPasses };
        attempts += u32::from(retry == Retry::AFewTimes);
        f.store.fail(&claim.lease, &fault, retry).await.unwrap();
    }
    assert_eq!((attempts, f.store.job(job).await.unwrap().state), (2, JobState::Running));
    f.waited().await;
    let claim = f.claim(Lane::Ingest).await.unwrap();
    f.store.fail(&claim.lease, &fault, Retry::AFewTimes).await.unwrap();
    assert_eq!(f.store.job(job).await.unwrap().state, JobState::Failed);
}

#[tokio::test]
async fn a_batch_that_meets_a_full_disk_waits_and_stays_together() {
    let f = Fixture::new().await;
    f.ingested(1).await;
    f.ingested(2).await;
    let fault = Fault { code: "storage".to_owned(), detail: "for the test".to_owned() };
    let both = f.claim(Lane::Map).await.unwrap();
    f.store.fail(&both.lease, &fault, Retry::UntilItPasses).await.unwrap();
    assert!(f.claim(Lane::Map).await.is_none(), "both wait");
    f.waited().await;
    assert_eq!(f.claim(Lane::Map).await.unwrap().lease.members, both.lease.members);
}

#[tokio::test]
async fn a_job_whose_process_falls_silent_again_and_again_is_set_aside() {
    let f = Fixture::new().await;
    let (bad, good) = (f.ingested(1).await.job.id, f.ingested(2).await.job.id);
    let mut together = Vec::new();
    while !f.store.job(bad).await.unwrap().state.is_final() {
        f.waited().await;
        let claim = f.store.claim(Lane::Map, "worker", Duration::ZERO, 10, true).await.unwrap().unwrap();
        assert_eq!(claim.job.id, bad);
        assert_eq!(claim.suspect, !together.is_empty());
        together.push(1 + claim.members.len());
        tokio::time::sleep(Duration::from_millis(5)).await;
        let overdue = f.store.overdue().await.unwrap();
        assert_eq!(f.store.reclaim_silent(&overdue, true).await.unwrap(), together[together.len() - 1]);
    }
    assert_eq!(together, [2, 1, 1], "first its batch, then it alone");
    assert_eq!(f.store.job(bad).await.unwrap().fault.unwrap().code, "worker-lost");
    f.waited().await;
    assert_eq!(f.claim(Lane::Map).await.unwrap().job.id, good);
}

#[tokio::test]
async fn a_claim_that_is_renewed_between_two_looks_is_left_alone() {
    let f = Fixture::new().await;
    f.scan(1).await;
    let late = f.store.claim(Lane::Ingest, "worker", Duration::ZERO, 1, true).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_millis(5)).await;
    let overdue = f.store.overdue().await.unwrap();
    assert_eq!(overdue.len(), 1);
    f.store.renew(&late.lease, LONG, None, 0).await.unwrap();
    assert_eq!(f.store.reclaim_silent(&overdue, true).await.unwrap(), 0);
    f.store.finish_ingest(&late.lease).await.unwrap();
}
