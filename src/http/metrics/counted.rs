//! What has happened since the service started.

use std::any::Any;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::{MatchedPath, Request, State};
use axum::http::Method;
use axum::middleware::{Next, from_fn_with_state};
use axum::response::{IntoResponse, Response};
use prometheus_client::metrics::counter::Counter;
use prometheus_client::metrics::family::Family;
use prometheus_client::metrics::histogram::{Histogram, exponential_buckets};
use prometheus_client::registry::{Registry, Unit};
use tokio::sync::Mutex;
use tower_http::catch_panic::CatchPanicLayer;

use crate::http::Problem;
use crate::http::problem::Reason;
use crate::jobs::Demand;
use crate::project::{JobId, Timestamp};
use crate::storage::{StorageError, Store};

type Seconds<const N: usize> = Family<[(&'static str, String); N], Histogram, fn() -> Histogram>;
type Count<const N: usize> = Family<[(&'static str, String); N], Counter>;

/// Counters and histograms of one service.
#[derive(Debug)]
pub struct Metrics {
    registry: Registry,
    requests: Count<3>,
    request_seconds: Seconds<2>,
    rejections: Count<1>,
    uploads: Count<1>,
    upload_bytes: Counter,
    job_seconds: Seconds<2>,
    job_wait_seconds: Seconds<1>,
    jobs: Mutex<Ended>,
}

/// Which ended jobs are counted.
#[derive(Debug)]
struct Ended {
    /// All that ended before this moment are.
    until: Timestamp,
    /// So are these, which ended after it.
    after: BTreeSet<(i64, JobId)>,
}

/// How long after the moment that it names the end of a job may be committed, ms.
const LAG_MS: i64 = 60_000;
/// Ended jobs that are read at once.
const PART: u32 = 1000;

impl Default for Metrics {
    fn default() -> Self {
        let request_buckets: fn() -> Histogram = || Histogram::new(exponential_buckets(0.001, 2.5, 13));
        let job_buckets: fn() -> Histogram = || Histogram::new(exponential_buckets(0.05, 2.5, 14));
        let mut metrics = Self {
            registry: Registry::with_prefix("cairn"),
            requests: Count::default(),
            request_seconds: Seconds::new_with_constructor(request_buckets),
            rejections: Count::default(),
            uploads: Count::default(),
            upload_bytes: Counter::default(),
            job_seconds: Seconds::new_with_constructor(job_buckets),
            job_wait_seconds: Seconds::new_with_constructor(job_buckets),
            jobs: Mutex::new(Ended { until: Timestamp::now(), after: BTreeSet::new() }),
        };
        let to = &mut metrics.registry;
        to.register(
            "http_requests",
            "Answered requests by method, route and status",
            metrics.requests.clone(),
        );
        let help = "Time until an answer began, by method and route";
        to.register_with_unit("http_request", help, Unit::Seconds, metrics.request_seconds.clone());
        to.register(
            "rejections",
            "Requests that were refused, by the kind of problem",
            metrics.rejections.clone(),
        );
        to.register("uploads", "Uploads that were acknowledged, by outcome", metrics.uploads.clone());
        to.register_with_unit(
            "upload",
            "Bytes of acknowledged uploads",
            Unit::Bytes,
            metrics.upload_bytes.clone(),
        );
        let help = "Time from the first worker to the end of a job, by kind and status";
        to.register_with_unit("job", help, Unit::Seconds, metrics.job_seconds.clone());
        let help = "Time from acceptance to the first worker, by kind";
        to.register_with_unit("job_wait", help, Unit::Seconds, metrics.job_wait_seconds.clone());
        metrics
    }
}

impl Metrics {
    /// All of them, to be encoded.
    pub(super) fn registry(&self) -> &Registry {
        &self.registry
    }

    /// Counts an acknowledged upload.
    pub fn uploaded(&self, bytes: u64, duplicate: bool) {
        let outcome = if duplicate { "duplicate" } else { "accepted" };
        self.uploads.get_or_create(&[("outcome", outcome.to_owned())]).inc();
        self.upload_bytes.inc_by(bytes);
    }

    /// Counts a connection that was not taken because its address has as many as it may.
    pub fn turned_away(&self) {
        self.rejections.get_or_create(&[("reason", "too-many-connections".to_owned())]).inc();
    }

    /// Counts the jobs that have ended since the last call, each once.
    pub(super) async fn catch_up(&self, store: &Store) -> Result<(), StorageError> {
        let mut jobs = self.jobs.lock().await;
        loop {
            // The last moment is read again, for what was committed late or cut off by the limit.
            let ended = store.jobs_ended_since(jobs.until, PART).await?;
            let full = ended.len() == PART as usize;
            let mut new = 0;
            let newest = ended.last().map_or(jobs.until.0, |job| job.finished.0);
            for job in ended {
                if !jobs.after.insert((job.finished.0, job.id)) {
                    continue;
                }
                new += 1;
                let kind = job.kind.as_str().to_owned();
                let started = job.started.unwrap_or(job.finished);
                let labels = [("kind", kind.clone()), ("status", job.state.as_str().to_owned())];
                self.job_seconds.get_or_create(&labels).observe(seconds(started, job.finished));
                self.job_wait_seconds.get_or_create(&[("kind", kind)]).observe(seconds(job.created, started));
            }
            let settled = if full && new > 0 { newest } else { newest.min(Timestamp::now().0 - LAG_MS) };
            jobs.until = Timestamp(jobs.until.0.max(settled));
            let until = jobs.until.0;
            jobs.after.retain(|(finished, _)| *finished >= until);
            if !full || new == 0 {
                return Ok(());
            }
        }
    }
}

fn seconds(from: Timestamp, to: Timestamp) -> f64 {
    (to.0 - from.0).max(0) as f64 / 1000.0
}

/// Counts the requests to these routes, and how they are answered. A panic is an internal error, and counted as one.
pub(in crate::http) fn count<S: Clone + Send + Sync + 'static>(
    routes: Router<S>,
    metrics: Arc<Metrics>,
    demand: Arc<Demand>,
) -> Router<S> {
    routes.layer(CatchPanicLayer::custom(panicked)).layer(from_fn_with_state((metrics, demand), observe))
}

/// Something panicked: the client learns only that.
fn panicked(_: Box<dyn Any + Send + 'static>) -> Response {
    Problem::internal("a handler panicked").into_response()
}

/// Counts a request and how it was answered, under the template of its route: addresses are endless, routes are few.
async fn observe(
    State((metrics, demand)): State<(Arc<Metrics>, Arc<Demand>)>,
    request: Request,
    next: Next,
) -> Response {
    let route = request.extensions().get::<MatchedPath>().map_or("none", MatchedPath::as_str).to_owned();
    let method = known(request.method()).to_owned();
    let begun = Instant::now();
    demand.asked();
    let response = next.run(request).await;
    let labels = [("method", method.clone()), ("route", route.clone())];
    metrics.request_seconds.get_or_create(&labels).observe(begun.elapsed().as_secs_f64());
    let status = response.status().as_u16().to_string();
    metrics.requests.get_or_create(&[("method", method), ("route", route), ("status", status)]).inc();
    if let Some(Reason(reason)) = response.extensions().get() {
        metrics.rejections.get_or_create(&[("reason", reason.clone())]).inc();
    }
    response
}

/// The method, unless a client made it up.
fn known(method: &Method) -> &str {
    match *method {
        Method::GET
        | Method::HEAD
        | Method::POST
        | Method::PUT
        | Method::PATCH
        | Method::DELETE
        | Method::OPTIONS => method.as_str(),
        _ => "other",
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use axum::routing::get;
    use prometheus_client::encoding::text::encode_registry;
    use tower::ServiceExt;

    use super::*;

    async fn broken() -> &'static str {
        panic!("a handler that panics");
    }

    #[tokio::test]
    async fn a_panic_is_answered_as_an_internal_error_and_counted_as_one() {
        let metrics: Arc<Metrics> = Arc::default();
        let app = count(
            Router::new().route("/broken", get(broken)),
            Arc::clone(&metrics),
            Arc::new(Demand::new(0)),
        );
        let request = Request::get("/broken").body(Body::empty()).unwrap();
        assert_eq!(app.oneshot(request).await.unwrap().status(), 500);
        let mut text = String::new();
        encode_registry(&mut text, metrics.registry()).unwrap();
        for line in [
            "cairn_http_requests_total{method=\"GET\",route=\"/broken\",status=\"500\"} 1",
            "cairn_rejections_total{reason=\"internal-error\"} 1",
        ] {
            assert!(text.lines().any(|found| found == line), "{line} is not in\n{text}");
        }
    }
}
