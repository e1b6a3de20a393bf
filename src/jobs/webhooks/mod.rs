//! Telling webhooks of the ends of jobs: messages wait in a table, are signed, sent, and sent again until they are taken.
//!
//! A message is sent at least once, in the order of the ends for each address, unless an earlier one has to wait for its
//! next attempt. Only hosts that the operator has listed are spoken to, at addresses that are public or listed too
//! (`target`). Used by `app`, which runs [`Courier`], and `http`, which asks [`Targets`] what may be registered.

mod send;
mod sign;
mod target;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

use tokio::task::JoinSet;
use tokio_util::sync::CancellationToken;

use crate::project::{JobId, Timestamp, WebhookId};
use crate::storage::{Attempt, DueDelivery, StorageError, Store};

pub use send::SendError;
pub use sign::{new_secret, reveal, signature};
pub use target::{BadTarget, HostPattern, Target, Targets};

/// How messages are sent.
#[derive(Debug, Clone)]
pub struct CourierOptions {
    /// Whom may be spoken to.
    pub targets: Targets,
    /// Pause after the first attempt that fails; it doubles with each.
    pub pause: Duration,
}

/// Sends what waits. Stops when told, and sends the rest when started again.
#[derive(Debug)]
pub struct Courier {
    store: Store,
    options: Arc<CourierOptions>,
    sender: send::Sender,
}

/// Messages on their way at once; to one address, one.
const AT_ONCE: usize = 16;
/// Attempts until a message is given up; with a pause of 10 s that is after two days.
const ATTEMPTS: u32 = 16;
/// The longest pause.
const LONGEST_PAUSE: Duration = Duration::from_hours(6);
/// How often the table is looked at if nothing seems to happen.
const LOOK: Duration = Duration::from_secs(30);
/// How often it is looked at, at most.
const BREATH: Duration = Duration::from_millis(50);

impl Courier {
    /// A courier for this store. Fails if the certificates of the system's authorities cannot be read.
    pub fn new(store: Store, options: CourierOptions) -> Result<Self, SendError> {
        Ok(Self { store, sender: send::Sender::new()?, options: Arc::new(options) })
    }

    /// Sends until `stop` is cancelled. What is on its way then is sent again after the next start.
    pub async fn run(self, stop: CancellationToken) {
        let mut changes = self.store.changes();
        let mut on_their_way = JoinSet::new();
        let mut busy = BTreeSet::new();
        let mut swept = tokio::time::Instant::now();
        loop {
            if let Err(error) = self.dispatch(&mut on_their_way, &mut busy).await {
                tracing::error!(%error, "messages to webhooks cannot be read");
            }
            if swept.elapsed() > LOOK {
                swept = tokio::time::Instant::now();
                if let Err(error) = self.store.forget_deliveries(Timestamp::now()).await {
                    tracing::warn!(%error, "old messages to webhooks cannot be forgotten");
                }
            }
            let pause = self.until_next(&busy).await;
            tokio::select! {
                Some(ended) = on_their_way.join_next(), if !on_their_way.is_empty() => match ended {
                    Ok(webhook) => { busy.remove(&webhook); }
                    Err(error) => {
                        tracing::error!(%error, "a message to a webhook broke off");
                        busy.clear();
                        on_their_way.abort_all();
                    }
                },
                // The end of a job may have made messages. A listener that lagged behind looks as well.
                _ = changes.recv() => tokio::time::sleep(BREATH).await,
                () = tokio::time::sleep(pause) => {}
                () = stop.cancelled() => return on_their_way.shutdown().await,
            }
        }
    }

    /// Sends what is due to addresses to which nothing is on its way.
    async fn dispatch(
        &self,
        on_their_way: &mut JoinSet<WebhookId>,
        busy: &mut BTreeSet<WebhookId>,
    ) -> Result<(), StorageError> {
        for due in self.store.due_deliveries(Timestamp::now()).await? {
            if on_their_way.len() >= AT_ONCE {
                break;
            }
            let webhook = due.delivery.webhook;
            if busy.insert(webhook) {
                let (store, sender, options) =
                    (self.store.clone(), self.sender.clone(), Arc::clone(&self.options));
                on_their_way.spawn(async move {
                    deliver(&store, &sender, &options, due).await;
                    webhook
                });
            }
        }
        Ok(())
    }

    /// How long nothing will be due.
    async fn until_next(&self, busy: &BTreeSet<WebhookId>) -> Duration {
        match self.store.next_delivery().await {
            // What is due already waits for one that is on its way: its end wakes the loop.
            Ok(Some(next)) if busy.is_empty() || next > Timestamp::now() => {
                let ms = (next.0 - Timestamp::now().0).max(0).cast_unsigned();
                Duration::from_millis(ms).clamp(BREATH, LOOK)
            }
            _ => LOOK,
        }
    }
}

/// One attempt, from the message to its row.
async fn deliver(store: &Store, sender: &send::Sender, options: &CourierOptions, due: DueDelivery) {
    let DueDelivery { delivery, url, secret } = due;
    let sent = match body(store, delivery.job).await {
        // The job went with its project; so does the message.
        Err(error) => Err(SendError::Storage(error)),
        Ok(body) => sender.post(&options.targets, &url, &delivery.id, &secret, body).await,
    };
    let attempt = match sent {
        Ok(status) if (200..300).contains(&status) => {
            Attempt { status: Some(status), error: None, again: None }
        }
        Ok(status) => failed(options, delivery.attempts, Some(status), format!("it answered {status}")),
        Err(error) => failed(options, delivery.attempts, None, error.to_string()),
    };
    if let Some(error) = &attempt.error {
        tracing::info!(webhook = %delivery.webhook, delivery = delivery.id, error, "a webhook did not take a message");
    }
    if let Err(error) = store.record_attempt(&delivery.id, &attempt).await {
        tracing::error!(%error, "what came of a message to a webhook could not be noted; it will be sent again");
    }
}

/// An attempt that came to nothing after `before` others.
fn failed(options: &CourierOptions, before: u32, status: Option<u16>, error: String) -> Attempt {
    let pause = options.pause.saturating_mul(1 << before.min(20)).min(LONGEST_PAUSE);
    // 410 says that the address wants no more.
    let last = before + 1 >= ATTEMPTS || status == Some(410);
    Attempt { status, error: Some(error), again: (!last).then(|| Timestamp::now().plus(pause)) }
}

/// What the message says: the job as it ended.
async fn body(store: &Store, job: JobId) -> Result<String, StorageError> {
    let job = store.job(job).await?;
    let message = serde_json::json!({
        "type": format!("job.{}", job.state.as_str()),
        "timestamp": job.finished.unwrap_or(job.updated),
        "data": {
            "id": job.id,
            "project": job.project,
            "scan": job.scan,
            "kind": job.kind,
            "status": job.state.as_str(),
            "outcome": job.outcome,
            "problem": job.fault.as_ref().map(|fault| serde_json::json!({ "code": fault.code, "detail": fault.detail })),
            "created": job.created,
            "started": job.started,
            "finished": job.finished,
            "href": format!("/v1/jobs/{}", job.id),
        },
    });
    Ok(message.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_up_to_the_longest_and_end_after_the_last_attempt_or_at_410() {
        let options = CourierOptions { targets: Targets::default(), pause: Duration::from_secs(10) };
        let pause = |before| {
            let again = failed(&options, before, Some(500), String::new()).again?;
            Some((again.0 - Timestamp::now().0 + 500) / 1000)
        };
        assert_eq!([pause(0), pause(1), pause(3)], [Some(10), Some(20), Some(80)]);
        assert_eq!(pause(14), Some(6 * 3600));
        assert_eq!(pause(ATTEMPTS - 1), None);
        assert_eq!(failed(&options, 0, Some(410), String::new()).again, None);
    }
}
