//! `GET /v1/jobs/{j}/events`: a job's changes as server-sent events.

use std::convert::Infallible;
use std::time::Duration;

use axum::extract::State;
use axum::http::{HeaderMap, HeaderName, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::Stream;
use futures_util::stream::unfold;
use tokio::sync::broadcast;
use tokio_util::sync::CancellationToken;
use utoipa::ToSchema;

use super::extract::Ids;
use super::job::JobBody;
use super::problem::{Problem, Problems};
use super::router::Api;
use crate::project::JobId;
use crate::storage::Store;

/// Silence after which a comment keeps proxies from closing the connection.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// One event, in the words of OpenAPI.
#[derive(ToSchema)]
#[expect(dead_code, reason = "only describes events, which are written field by field")]
struct JobEvent {
    /// The job's revision.
    id: String,
    /// The job's status.
    event: String,
    /// The job, as JSON.
    data: String,
}

/// Follows a job. Every event is named after the job's status, holds the whole job and has its revision as id, so that a
/// client that comes back with `Last-Event-ID` gets the job as it is now, unless it has that already. The stream ends
/// with the job.
#[utoipa::path(get, path = "/v1/jobs/{job}/events", tag = "jobs", params(
    ("job" = String, Path, description = "Id of the job"),
    ("last-event-id" = Option<String>, Header, description = "The id of the last event that the client has")),
    responses(
    (status = 200, description = "The events", body = JobEvent, content_type = "text/event-stream"),
    (status = 204, description = "The job has ended, and the client has its last event"),
    Problems))]
pub(super) async fn follow_job(
    State(api): State<Api>,
    Ids(id): Ids<JobId>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let seen = headers.get("last-event-id").and_then(|v| v.to_str().ok()?.parse().ok()).unwrap_or(0);
    let changes = api.store.changes();
    let job = api.store.job(id).await?;
    // A number that is not its own, such as from before a backup was restored, tells nothing.
    let seen = if seen > job.revision { 0 } else { seen };
    if job.state.is_final() && seen == job.revision {
        // A client that comes back with nothing left to hear is told not to come again.
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let follower = Follower { store: api.store, id, seen, changes, ended: false, stop: api.stop };
    let sse = Sse::new(events(follower)).keep_alive(KeepAlive::new().interval(KEEP_ALIVE));
    let no_buffering = [(HeaderName::from_static("x-accel-buffering"), "no")];
    Ok((no_buffering, sse).into_response())
}

struct Follower {
    store: Store,
    id: JobId,
    seen: u64,
    changes: broadcast::Receiver<JobId>,
    ended: bool,
    stop: CancellationToken,
}

fn events(follower: Follower) -> impl Stream<Item = Result<Event, Infallible>> {
    unfold(follower, |mut follower| async {
        let event = follower.next().await?;
        Some((Ok(event), follower))
    })
}

impl Follower {
    /// The next event; `None` when the job has ended, is gone, or the service stops.
    async fn next(&mut self) -> Option<Event> {
        while !self.ended {
            let job = self.store.job(self.id).await.ok()?;
            self.ended = job.state.is_final();
            if job.revision > self.seen {
                self.seen = job.revision;
                let event = Event::default().id(job.revision.to_string()).event(job.state.as_str());
                return event.json_data(JobBody::from(job)).ok();
            }
            if self.ended {
                return None;
            }
            tokio::select! {
                () = changed(&mut self.changes, self.id) => {}
                () = self.stop.cancelled() => return None,
            }
        }
        None
    }
}

/// Returns when the job may have changed.
async fn changed(changes: &mut broadcast::Receiver<JobId>, id: JobId) {
    // A listener that lagged behind looks again to be sure.
    while changes.recv().await.is_ok_and(|changed| changed != id) {}
}
