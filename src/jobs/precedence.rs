//! Who goes first where both compute and answer: threads that answer clients ask the system for short turns that begin at once, threads that
//! compute for what these leave.
//!
//! Linux shares a processor out in turns. Niceness says how large a thread's part is, not how soon its next turn begins: a thread that wakes
//! does not interrupt one whose turn (1.4 ms with two cores) is not over, and where it was not let in at once it is thought of again only
//! at the next tick of the clock (4 ms at 250 Hz). A thread with shorter turns than the running one is let in at once, if it has not had
//! more than its part. Since Linux 6.12 any thread may choose the length of its own turns; older kernels take the wish and forget it, other
//! systems know none. Threads and processes inherit it from who starts them.
//!
//! Used by the commands that serve, by the processes of jobs, and by the threads of [`super::Compute`].

/// How long the turns of a thread that answers are; the least that Linux grants.
#[cfg(target_os = "linux")]
const SHORT_NS: u64 = 100_000;
/// The turns that the system has for everybody.
#[cfg(target_os = "linux")]
const USUAL_NS: u64 = 0;

/// How much nicer those are that compute.
const NICENESS: i32 = 10;

/// Lets this thread, and those that it starts from now on, answer as soon as something comes.
pub fn answer_promptly() {
    #[cfg(target_os = "linux")]
    turns::set(SHORT_NS);
}

/// Lets those who answer clients go first: this thread, and those that it starts, get what they leave. On Linux, where niceness is a
/// thread's; elsewhere it does as much as the system allows.
pub fn yield_to_clients() {
    // Being refused only means that answers are slower while much is computed.
    let _ = rustix::process::nice(NICENESS);
    #[cfg(target_os = "linux")]
    turns::set(USUAL_NS);
}

#[cfg(target_os = "linux")]
mod turns {
    use std::mem::size_of;

    /// The `struct sched_attr` of `sched_setattr(2)` in its first form, which all kernels take.
    #[repr(C)]
    #[derive(Debug, Default)]
    struct Attributes {
        size: u32,
        policy: u32,
        flags: u64,
        nice: i32,
        priority: u32,
        runtime: u64,
        deadline: u64,
        period: u64,
    }

    /// Asks for turns of so many nanoseconds for this thread and keeps its niceness; 0 is the system's own length.
    pub(super) fn set(nanoseconds: u64) {
        let Ok(nice) = rustix::process::getpriority_process(None) else { return };
        let attributes = Attributes {
            size: size_of::<Attributes>() as u32,
            policy: libc::SCHED_OTHER as u32,
            nice,
            runtime: nanoseconds,
            ..Attributes::default()
        };
        ask(&attributes);
    }

    #[expect(
        unsafe_code,
        reason = "no crate wraps this call; the kernel reads `size` bytes of a structure that outlives the call"
    )]
    fn ask(attributes: &Attributes) {
        let (this_thread, no_flags): (libc::pid_t, libc::c_uint) = (0, 0);
        // Being refused only means that answers are slower while much is computed.
        let _ = unsafe {
            libc::syscall(libc::SYS_sched_setattr, this_thread, std::ptr::from_ref(attributes), no_flags)
        };
    }

    #[cfg(test)]
    mod tests {
        use crate::jobs::precedence::{NICENESS, answer_promptly, yield_to_clients};

        /// What the kernel says of this thread.
        fn told() -> (i32, u64) {
            let text = std::fs::read_to_string("/proc/thread-self/sched").unwrap_or_default();
            let slice = text.lines().find(|line| line.starts_with("se.slice"));
            let slice = slice.and_then(|line| line.rsplit(' ').next()?.parse().ok()).unwrap_or(0);
            (rustix::process::getpriority_process(None).unwrap(), slice)
        }

        #[test]
        fn turns_are_short_for_who_answers_and_threads_that_compute_get_usual_ones_again() {
            // In a thread of its own: niceness cannot be taken back.
            let threads = std::thread::spawn(|| {
                let before = told();
                answer_promptly();
                let answers = told();
                yield_to_clients();
                (before, answers, told())
            });
            let (before, answers, computes) = threads.join().unwrap();
            assert_eq!(answers.0, before.0, "how nice it is does not change");
            assert_eq!(computes.0, (before.0 + NICENESS).min(19));
            assert_eq!(computes.1, before.1);
            // Kernels that know no such wish, or do not tell, say the same as before.
            assert!(answers.1 == 100_000 || answers.1 == before.1, "{answers:?}");
        }
    }
}
