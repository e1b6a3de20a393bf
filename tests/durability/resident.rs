//! The processes of jobs stay for the next job, and never outlive the service.

use std::collections::BTreeSet;
use std::fs;
use std::net::TcpStream;
use std::path::Path;

use crate::process::{Faults, Process, room, until};

/// Processes that the service has started and that have not ended.
pub fn workers(service: &Process) -> BTreeSet<u32> {
    let tasks = fs::read_dir(format!("/proc/{}/task", service.id())).unwrap();
    let children = tasks.filter_map(|task| fs::read_to_string(task.ok()?.path().join("children")).ok());
    children
        .flat_map(|ids| ids.split_whitespace().map(|id| id.parse().unwrap()).collect::<Vec<_>>())
        .collect()
}

/// Whether a process computes or waits; one that has ended may still have an entry.
pub fn lives(process: u32) -> bool {
    let at = Path::new("/proc").join(process.to_string()).join("cmdline");
    fs::read(at).is_ok_and(|command| !command.is_empty())
}

/// Whether a process has become one of jobs: until then it is the service's own, which waits for it.
pub fn works(process: u32) -> bool {
    let at = Path::new("/proc").join(process.to_string()).join("cmdline");
    fs::read(at).is_ok_and(|command| command.split(|byte| *byte == 0).nth(1) == Some(b"work"))
}

#[tokio::test]
async fn processes_of_jobs_stay_for_the_next_and_end_with_the_service_however_that_ends() {
    let data = tempfile::tempdir().unwrap();
    // Enough to keep both processes, whatever memory the machine has; none of it is taken before it is needed.
    let share = (2_u64 << 30).to_string();
    let mut service = Process::with(data.path(), &["--worker-memory-bytes", &share], None);
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

#[tokio::test]
async fn a_process_at_work_leaves_a_core_to_answers_while_many_are_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let (data, faults) = (dir.path().join("data"), Faults::new(dir.path()));
    let service = Process::with(&data, &["--spare-core-at", "1"], Some(&faults));
    let project = service.project().await;
    let file = room(0.0);
    faults.set(&format!("open loop 0 {}", blake3::hash(&file).to_hex()));
    service.accepted(&project, file).await;
    until("a process is at work", || faults.struck() > 0).await;
    let at_work = workers(&service);
    let all = cores(service.id());
    let few = at_work.iter().map(|worker| (*worker, (all - 1).max(1))).collect::<Vec<_>>();
    let now = || at_work.iter().map(|worker| (*worker, cores(*worker))).collect::<Vec<_>>();
    let address = service.url.trim_start_matches("http://").to_owned();
    let crowd = (0..16).map(|_| TcpStream::connect(&address).unwrap()).collect::<Vec<_>>();
    let mut asked = 0;
    while now() != few {
        service.json(&project).await;
        asked += 1;
        assert!(asked < 20_000, "{:?} of {all}", now());
    }
    drop(crowd);
    until("it has all of them again when nobody asks", || now().iter().all(|(_, cores)| *cores == all)).await;
}

/// How many cores the least of a process's threads may use.
fn cores(process: u32) -> usize {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).unwrap();
    let allowed = tasks.map(|task| {
        let status = fs::read_to_string(task.unwrap().path().join("status")).unwrap_or_default();
        let mask =
            status.lines().find_map(|line| line.strip_prefix("Cpus_allowed:\t")).unwrap_or("").to_owned();
        mask.chars().filter_map(|digit| digit.to_digit(16)).map(u32::count_ones).sum::<u32>() as usize
    });
    allowed.filter(|cores| *cores > 0).min().unwrap_or(0)
}
