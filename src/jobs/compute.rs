//! The bridge from tokio, which waits, to rayon, which computes.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Arc, PoisonError, RwLock};

use tokio::sync::oneshot;

use super::precedence::yield_to_clients;

/// A computation panicked. It is caught here: the job fails, the process lives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the computation panicked: {0}")]
pub struct Panicked(pub String);

/// The thread pool of all computations. Clones share it.
#[derive(Debug, Clone)]
pub struct Compute {
    threads: usize,
    pool: Arc<RwLock<Arc<rayon::ThreadPool>>>,
}

impl Compute {
    /// Starts `threads` threads; 0 is one for each core.
    pub fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        Ok(Self { threads, pool: Arc::new(RwLock::new(Arc::new(build(threads)?))) })
    }

    /// Starts new threads for what is computed from now on, because a computation does not stop. What runs in the old ones goes on;
    /// those that are free end when it has.
    pub fn renew(&self) {
        match build(self.threads) {
            Ok(pool) => *self.pool.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(pool),
            Err(error) => tracing::error!(%error, "no new threads could be started"),
        }
    }

    /// Runs `work` in the pool and waits for it without blocking an async thread. Dropping the future does not stop
    /// the work: that is what cancellation tokens are for.
    pub async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Panicked> {
        let (sender, receiver) = oneshot::channel();
        let pool = Arc::clone(&self.pool.read().unwrap_or_else(PoisonError::into_inner));
        pool.spawn(move || {
            let result = catch_unwind(AssertUnwindSafe(work)).map_err(|p| Panicked(message(p.as_ref())));
            // An error only says that nobody waits for the result any more.
            let _ = sender.send(result);
        });
        receiver.await.unwrap_or_else(|_| Err(Panicked("the thread pool is gone".to_owned())))
    }
}

fn build(threads: usize) -> Result<rayon::ThreadPool, rayon::ThreadPoolBuildError> {
    rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .thread_name(|i| format!("compute-{i}"))
        .start_handler(|_| yield_to_clients())
        .build()
}

/// What a panic said, if it said it in words.
fn message(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied().map(str::to_owned);
    text.or_else(|| payload.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_computation_that_does_not_end_does_not_keep_others_waiting() {
        let compute = Compute::new(1).unwrap();
        let (release, stuck) = std::sync::mpsc::channel::<()>();
        let endless = tokio::spawn({
            let compute = compute.clone();
            async move { compute.run(move || stuck.recv().is_err()).await }
        });
        tokio::task::yield_now().await;
        compute.renew();
        assert_eq!(compute.run(|| 6 * 7).await, Ok(42));
        drop(release);
        assert_eq!(endless.await.unwrap(), Ok(true));
    }

    #[tokio::test]
    async fn a_panic_fails_the_computation_and_the_pool_lives_on() {
        let compute = Compute::new(1).unwrap();
        let failed = compute.run(|| -> u32 { panic!("bad scan {}", 7) }).await;
        assert_eq!(failed, Err(Panicked("bad scan 7".to_owned())));
        assert_eq!(compute.run(|| 6 * 7).await, Ok(42));
    }
}
