//! The routes, the layers around them, and the OpenAPI description that is read off them.

use std::sync::Arc;

use axum::Router;
use axum::extract::Request;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{from_fn, from_fn_with_state};
use axum::routing::get;
use tokio_util::sync::CancellationToken;
use tower::ServiceBuilder;
use tower::util::option_layer;
use tower_http::request_id::{MakeRequestId, PropagateRequestIdLayer, RequestId, SetRequestIdLayer};
use tower_http::sensitive_headers::SetSensitiveRequestHeadersLayer;
use tower_http::trace::TraceLayer;
use ulid::Ulid;
use utoipa::OpenApi;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::idempotency::{self, Running, idempotent};
use super::{
    Access, Metrics, Problem, Readiness, Readings, access, cloud, decision, events, graph, health, job,
    metrics, model, page, pose, preview, project, scan, shield, tus, upload, webhook,
};
use crate::jobs::webhooks::Targets;
use crate::jobs::{Demand, Exports, Intake, Resumable};
use crate::storage::Store;

/// What handlers work with. Clones share everything.
#[derive(Clone)]
pub struct Api {
    /// Rows and blobs.
    pub store: Store,
    /// Takes uploads in.
    pub intake: Intake,
    /// Takes uploads in that come in several requests.
    pub resumable: Resumable,
    /// Makes files for download.
    pub exports: Exports,
    /// Reads versions, few at a time.
    pub readings: Readings,
    /// Who is let in.
    pub access: Access,
    /// Whom webhooks may reach.
    pub webhooks: Arc<Targets>,
    /// What is counted.
    pub metrics: Arc<Metrics>,
    /// How much is asked for at this moment.
    pub demand: Arc<Demand>,
    /// Whether requests make sense now.
    pub readiness: Arc<Readiness>,
    /// Cancelled when the service begins to stop: long answers end then.
    pub stop: CancellationToken,
    /// The description of the interface, YAML.
    pub openapi: Arc<str>,
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "Cairn",
        description = "Multiview scan registration. Upload scans into a project; each is added to the project's model \
            by a job; poll the job, then download poses and the merged cloud. A key is sent as a bearer token; \
            each operation says in `x-cairn-scope` whether it needs one that may `read`, `upload` or `manage`, and what a key does \
            not reach is answered as what does not exist. Poses are `model_from_scan`: they map \
            points of a scan into the frame of its component. Lengths are metres. Errors are RFC 9457 problem details."
    ),
    tags(
        (name = "projects", description = "Sets of scans of one place"),
        (name = "scans", description = "Uploads"),
        (name = "uploads", description = "Uploads that survive broken connections: tus 1.0 (https://tus.io)"),
        (name = "jobs", description = "Work in progress, in the words of OGC API Processes"),
        (name = "decisions", description = "What clients decide where the data alone cannot tell: identical rooms, symmetric halls"),
        (name = "webhooks", description = "Addresses that are told when jobs end"),
        (name = "model", description = "Versions of a project's model, and what can be downloaded of them"),
        (name = "service", description = "The service itself"),
    )
)]
struct Description;

fn routes() -> OpenApiRouter<Api> {
    OpenApiRouter::with_openapi(Description::openapi())
        .routes(routes!(project::create_project, project::list_projects))
        .routes(routes!(project::get_project, project::delete_project))
        .routes(routes!(upload::upload_scan, scan::list_scans))
        .routes(routes!(scan::get_scan, scan::delete_scan))
        .routes(routes!(scan::get_original))
        .merge(tus::routes())
        .routes(routes!(job::create_job, job::list_jobs))
        .routes(routes!(job::get_job, job::dismiss_job))
        .routes(routes!(events::follow_job))
        .routes(routes!(decision::create_decision, decision::list_decisions))
        .routes(routes!(decision::get_decision, decision::delete_decision))
        .routes(routes!(webhook::create_webhook, webhook::list_webhooks))
        .routes(routes!(webhook::get_webhook, webhook::delete_webhook))
        .routes(routes!(webhook::list_deliveries))
        .routes(routes!(model::get_model))
        .routes(routes!(model::list_versions))
        .routes(routes!(model::get_version))
        .routes(routes!(pose::get_poses))
        .routes(routes!(cloud::get_cloud))
        .routes(routes!(graph::get_graph))
        .routes(routes!(preview::get_preview))
        .routes(routes!(health::healthz))
        .routes(routes!(health::readyz))
        .routes(routes!(health::openapi))
        .routes(routes!(metrics::metrics))
}

/// The description of the interface.
#[must_use]
pub fn description() -> utoipa::openapi::OpenApi {
    access::describe(idempotency::describe(routes().into_openapi()))
}

/// The description of the interface as YAML: what `/openapi.yaml` answers and the repository keeps.
pub fn openapi_yaml() -> Result<String, Problem> {
    description().to_yaml().map_err(Problem::internal)
}

/// The whole service as a router.
pub fn router(api: Api) -> Router {
    let id = HeaderName::from_static("x-request-id");
    let layers = ServiceBuilder::new()
        .map_request(without_id)
        .layer(SetRequestIdLayer::new(id.clone(), NewRequestId))
        // Whatever prints headers prints that there is a key, not which.
        .layer(SetSensitiveRequestHeadersLayer::new([header::AUTHORIZATION]))
        .layer(TraceLayer::new_for_http().make_span_with(span))
        .layer(PropagateRequestIdLayer::new(id))
        .layer(from_fn(super::hang_up::hang_up));
    let (router, _) = routes().split_for_parts();
    let router = router
        .route("/", get(page::index))
        .route("/web/{name}", get(page::asset))
        .fallback(|| async { Problem::not_found("there is nothing at this address") })
        .method_not_allowed_fallback(|| async {
            Problem::new(
                StatusCode::METHOD_NOT_ALLOWED,
                "method-not-allowed",
                "this address does not answer this method",
            )
        })
        .layer(from_fn_with_state((api.clone(), Running::default()), idempotent))
        .layer(from_fn_with_state(api.clone(), access::shed))
        .layer(from_fn_with_state(api.clone(), access::guard))
        .layer(from_fn_with_state(api.clone(), access::pace));
    metrics::count(router, Arc::clone(&api.metrics), Arc::clone(&api.demand))
        .layer(option_layer(shield::cors(&api.access.origins)))
        .layer(from_fn(shield::harden))
        .with_state(api)
        .layer(layers)
}

#[derive(Clone, Copy)]
struct NewRequestId;

impl MakeRequestId for NewRequestId {
    fn make_request_id<B>(&mut self, _: &axum::http::Request<B>) -> Option<RequestId> {
        HeaderValue::from_str(&Ulid::generate().to_string()).ok().map(RequestId::new)
    }
}

/// One span a request. The query is left out: names of scans are the client's business.
fn span(request: &Request) -> tracing::Span {
    let id = request.headers().get("x-request-id").and_then(|v| v.to_str().ok()).unwrap_or("");
    tracing::info_span!("request", id, method = %request.method(), path = request.uri().path())
}

/// An id of a request finds its lines in the log: nobody else chooses it.
fn without_id(mut request: Request) -> Request {
    request.headers_mut().remove("x-request-id");
    request
}
