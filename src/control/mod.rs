//! How a caller steers a long computation of the core: cancellation, progress, and derived random seeds.
//!
//! Every long function of the core takes a [`Control`]; the thread pool is the rayon pool it is called in
//! (`pool.install(|| …)`), and results do not depend on its size.

mod cancel;
mod observer;
mod seed;

pub use cancel::{CancelToken, Cancelled};
pub use observer::{Observer, Ongoing, Progress, Silent, Stage};
pub use seed::{Seed, SeedRng};

/// What a long computation is given besides its inputs.
#[derive(Clone, Copy)]
pub struct Control<'a> {
    /// Checked between units of work of at most a few tens of milliseconds.
    pub cancel: &'a CancelToken,
    /// Told of progress, from any thread.
    pub observer: &'a dyn Observer,
}

impl<'a> Control<'a> {
    /// Returns `Err(Cancelled)` once the caller has cancelled.
    pub fn check(&self) -> Result<(), Cancelled> {
        self.cancel.check()
    }

    /// Tells the observer that a stage begins, and, when the returned value is dropped, that it has ended. For work of the
    /// calling thread, whatever pool it is spread over.
    pub fn begin(&self, stage: Stage) -> Ongoing<'a> {
        Ongoing::begin(self.observer, stage)
    }

    /// Reports that `done` of `total` units of `stage` are finished.
    pub fn report(&self, stage: Stage, done: usize, total: usize) {
        self.observer.progress(Progress { stage, done, total });
    }
}
