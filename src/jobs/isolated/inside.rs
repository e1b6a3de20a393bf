//! The process of jobs, from inside: it does what the service orders, one job after the other, and keeps the models of the projects that
//! it worked on last.

use std::io;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use tokio::sync::mpsc;
use tokio_util::sync::CancellationToken;

use super::memory::taken_by;
use super::message::{Order, Report};
use crate::jobs::perform::Performer;
use crate::jobs::workers::WorkerOptions;
use crate::jobs::{Compute, Demand};
use crate::storage::{StorageError, Store};

/// How long a job that was told to stop is waited for. The service is less patient when a client has dismissed it.
const PATIENCE: Duration = Duration::from_secs(1);

/// Does one claimed job after the other in this process, which does nothing else, until the orders end or a computation does not stop.
///
/// # Errors
/// If a report cannot be given.
pub async fn work_for_service(
    store: Store,
    compute: Compute,
    options: WorkerOptions,
    mut orders: mpsc::Receiver<Order>,
    mut report: impl FnMut(Report) -> io::Result<()>,
) -> io::Result<()> {
    let performer = Performer {
        store,
        compute,
        models: Arc::default(),
        processes: Arc::default(),
        demand: Arc::new(Demand::new(0)),
        options,
        stop: CancellationToken::new(),
        patience: PATIENCE,
    };
    while let Some(order) = orders.recv().await {
        // The job that was to be stopped has ended meanwhile.
        let Order::Work { job, attempt } = order else { continue };
        let (lane, claim) = match performer.store.held(job, attempt).await {
            Ok(held) => held,
            Err(StorageError::Fenced { .. }) => {
                report(Report::Done)?;
                continue;
            }
            Err(error) => {
                tracing::error!(%error, "a job cannot begin");
                report(Report::NotNow)?;
                continue;
            }
        };
        if !performer.models.knows(claim.job.project) && performer.is_half_full() {
            performer.models.keep_newest(0);
        }
        let performer = Performer { stop: CancellationToken::new(), ..performer.clone() };
        let stopped = {
            let mut work = pin!(performer.perform(lane, claim));
            loop {
                tokio::select! {
                    stopped = &mut work => break stopped,
                    order = orders.recv() => match order {
                        Some(Order::Stop) => performer.stop.cancel(),
                        Some(Order::Work { .. }) => tracing::error!("ordered to do two jobs at once"),
                        None => return Ok(()),
                    }
                }
            }
        };
        // What it found damaged nobody else knows.
        if let Err(error) = performer.store.settle_damage().await {
            tracing::error!(%error, "damage cannot be written down");
        }
        if !stopped {
            return Ok(());
        }
        if performer.is_half_full() {
            performer.models.forget_fine();
        }
        if performer.is_half_full() {
            performer.models.keep_newest(1);
        }
        report(Report::Done)?;
    }
    Ok(())
}

impl Performer {
    /// Whether half of the memory is taken that this process may use.
    fn is_half_full(&self) -> bool {
        taken_by(std::process::id()).is_some_and(|bytes| bytes > self.options.memory_bytes / 2)
    }
}
