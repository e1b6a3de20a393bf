//! Which cores a job's process may use: all that the service may, or all but one. A thread that wakes to answer then finds a core on which
//! nothing is computed; where all are busy it may have to wait for the end of a turn, whatever its precedence (see `jobs::precedence`).

/// The cores of one process.
#[derive(Debug, Default)]
pub(super) struct Cores {
    /// Whether one is left to others; `None`: not known, as of a process that did other jobs before.
    spares_one: Option<bool>,
}

impl Cores {
    /// Has the process leave a core to others from now on, or take it back. What the system refuses stays as it is: answers are slower then.
    #[cfg(target_os = "linux")]
    pub fn spare_one(&mut self, process: u32, spare: bool) {
        use rustix::thread::{sched_getaffinity, sched_setaffinity};

        // Threads that were made meanwhile may be without it; taking back needs no second look, as they take after those that made them.
        if !spare && self.spares_one == Some(false) {
            return;
        }
        self.spares_one = Some(spare);
        let Ok(mut cores) = sched_getaffinity(None) else { return };
        let highest = (0..rustix::thread::CpuSet::MAX_CPU).rev().find(|core| cores.is_set(*core));
        if let Some(highest) = highest.filter(|_| spare && cores.count() > 1) {
            cores.unset(highest);
        }
        let tasks = std::fs::read_dir(format!("/proc/{process}/task")).into_iter().flatten().flatten();
        for task in tasks {
            let id = task.file_name().to_str().and_then(|name| name.parse().ok());
            if let Some(thread) = id.and_then(rustix::process::Pid::from_raw) {
                let _ = sched_setaffinity(Some(thread), &cores);
            }
        }
    }

    /// Nothing: only Linux is known.
    #[cfg(not(target_os = "linux"))]
    pub fn spare_one(&mut self, _: u32, spare: bool) {
        self.spares_one = Some(spare);
    }
}
