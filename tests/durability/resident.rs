//! The processes of jobs stay for the next job, and never outlive the service.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::process::{Process, room, until};

/// Processes that the service has started and that have not ended.
fn workers(service: &Process) -> BTreeSet<u32> {
    let tasks = fs::read_dir(format!("/proc/{}/task", service.id())).unwrap();
    let children = tasks.filter_map(|task| fs::read_to_string(task.ok()?.path().join("children")).ok());
    children
        .flat_map(|ids| ids.split_whitespace().map(|id| id.parse().unwrap()).collect::<Vec<_>>())
        .collect()
}

/// Whether a process computes or waits; one that has ended may still have an entry.
fn lives(process: u32) -> bool {
    let at = Path::new("/proc").join(process.to_string()).join("cmdline");
    fs::read(at).is_ok_and(|command| !command.is_empty())
}

#[tokio::test]
async fn processes_of_jobs_stay_for_the_next_and_end_with_the_service_however_that_ends() {
    let data = tempfile::tempdir().unwrap();
    let mut service = Process::start(data.path());
    let project = service.project().await;
    let mut seen = Vec::new();
    for shift in [0.0, 0.4, 0.8, 1.2] {
        let upload = service.accepted(&project, room(shift)).await;
        assert_eq!(service.ended(&upload["job"]).await["status"], "succeeded");
        seen.push(workers(&service));
    }
    assert_eq!(seen[0].len(), 2, "one reads, one maps: {seen:?}");
    assert!(seen.iter().all(|workers| *workers == seen[0]), "{seen:?}");
    service.kill();
    until("nobody works for a service that is gone", || !seen[0].iter().any(|worker| lives(*worker))).await;
}
