//! Whether requests make sense now. Anybody may ask, so it is tried at most once a second, whoever asks how often.

use std::num::NonZeroU16;
use std::time::Duration;

use axum::http::StatusCode;
use tokio::sync::Mutex;
use tokio::time::{Instant, timeout};

use super::access::has_space;
use super::problem::Problem;
use super::router::Api;

/// What the last try came to.
#[derive(Debug, Default)]
pub struct Readiness {
    last: Mutex<Option<(Instant, Result<(), Problem>)>>,
}

/// How long an answer holds.
const HOLDS: Duration = Duration::from_secs(1);
/// How long the database may take: longer, and requests pile up.
const PATIENCE: Duration = Duration::from_secs(5);

impl Readiness {
    /// Fails if the service is stopping, cannot write its database, or has too little disk left to take anything in.
    pub(super) async fn check(&self, api: &Api) -> Result<(), Problem> {
        if api.stop.is_cancelled() {
            return Err(not_ready("the service is stopping"));
        }
        let mut last = self.last.lock().await;
        match &*last {
            Some((at, found)) if at.elapsed() < HOLDS => found.clone(),
            _ => {
                let found = tried(api).await;
                *last = Some((Instant::now(), found.clone()));
                found
            }
        }
    }
}

async fn tried(api: &Api) -> Result<(), Problem> {
    let failed = |error: &dyn std::fmt::Display| {
        tracing::error!(%error, "the database cannot be written");
        not_ready("the service cannot write its data")
    };
    match timeout(PATIENCE, api.store.probe()).await {
        Ok(Ok(())) => has_space(api),
        Ok(Err(error)) => Err(failed(&error)),
        Err(elapsed) => Err(failed(&elapsed)),
    }
}

fn not_ready(detail: &str) -> Problem {
    Problem {
        retry_after: NonZeroU16::new(5),
        ..Problem::new(StatusCode::SERVICE_UNAVAILABLE, "not-ready", detail)
    }
}
