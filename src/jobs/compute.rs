//! The bridge from tokio, which waits, to rayon, which computes.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use tokio::sync::oneshot;

/// A computation panicked. It is caught here: the job fails, the process lives.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("the computation panicked: {0}")]
pub struct Panicked(pub String);

/// The thread pool of all computations. Clones share it.
#[derive(Debug, Clone)]
pub struct Compute {
    pool: Arc<rayon::ThreadPool>,
}

impl Compute {
    /// Starts `threads` threads; 0 is one for each core.
    pub fn new(threads: usize) -> Result<Self, rayon::ThreadPoolBuildError> {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .thread_name(|i| format!("compute-{i}"))
            .build()?;
        Ok(Self { pool: Arc::new(pool) })
    }

    /// Runs `work` in the pool and waits for it without blocking an async thread. Dropping the future does not stop
    /// the work: that is what cancellation tokens are for.
    pub async fn run<T: Send + 'static>(
        &self,
        work: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Panicked> {
        let (sender, receiver) = oneshot::channel();
        self.pool.spawn(move || {
            let result = catch_unwind(AssertUnwindSafe(work)).map_err(|p| Panicked(message(p.as_ref())));
            // An error only says that nobody waits for the result any more.
            let _ = sender.send(result);
        });
        receiver.await.unwrap_or_else(|_| Err(Panicked("the thread pool is gone".to_owned())))
    }
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
    async fn a_panic_fails_the_computation_and_the_pool_lives_on() {
        let compute = Compute::new(1).unwrap();
        let failed = compute.run(|| -> u32 { panic!("bad scan {}", 7) }).await;
        assert_eq!(failed, Err(Panicked("bad scan 7".to_owned())));
        assert_eq!(compute.run(|| 6 * 7).await, Ok(42));
    }
}
