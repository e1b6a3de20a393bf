//! What the service does not take on: more work while its queue is full or its disk nearly so.
//!
//! Deleting, dismissing and looking go on, so that there is a way out.

use std::num::NonZeroU16;

use axum::extract::{Request, State};
use axum::http::{Method, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use crate::http::tus::meant;
use crate::http::{Api, Problem};

/// When no more work is taken on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LoadLimits {
    /// Jobs of all projects that wait or run.
    pub open_jobs: u64,
    /// Free bytes of disk that must remain.
    pub free_bytes: u64,
}

/// Seconds after which a refused client may ask again.
const RETRY_AFTER: Option<NonZeroU16> = NonZeroU16::new(30);

/// Lets a request through unless it brings work that cannot be taken on now.
pub(in crate::http) async fn shed(State(api): State<Api>, request: Request, next: Next) -> Response {
    if brings_work(&meant(&request))
        && let Err(problem) = has_room(&api).await
    {
        return problem.into_response();
    }
    next.run(request).await
}

/// Whether requests of this method make work: others look, or give something back.
pub(super) fn brings_work(method: &Method) -> bool {
    matches!(*method, Method::POST | Method::PUT | Method::PATCH)
}

/// Fails if the queue is full or the disk nearly so.
async fn has_room(api: &Api) -> Result<(), Problem> {
    if let Err(problem) = has_space(api) {
        // What can be made again goes first: whoever tries again finds its room.
        if let Err(error) = api.exports.give_way().await {
            tracing::error!(%error, "merged clouds and pictures could not be given up");
        }
        return Err(problem);
    }
    let most = api.access.load.open_jobs;
    if api.store.open_jobs(most).await? >= most {
        let detail = "the service has as many jobs waiting as it takes on";
        let refusal = Problem::new(StatusCode::SERVICE_UNAVAILABLE, "queue-full", detail);
        return Err(Problem { retry_after: RETRY_AFTER, ..refusal });
    }
    Ok(())
}

/// Fails if the disk is nearly full.
pub(in crate::http) fn has_space(api: &Api) -> Result<(), Problem> {
    if api.store.free_bytes()? < api.access.load.free_bytes {
        return Err(Problem::low_disk());
    }
    Ok(())
}
