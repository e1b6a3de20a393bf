//! `/healthz`, `/readyz` and `/openapi.yaml`.

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;

use super::problem::Problem;
use super::router::Api;

/// Says that the process answers.
#[utoipa::path(get, path = "/healthz", tag = "service",
    responses((status = 200, description = "It answers", body = String, content_type = "text/plain")))]
pub(super) async fn healthz() -> &'static str {
    "ok\n"
}

/// Says whether requests make sense now: the database can be written, there is disk left, and the service is not stopping. If stored
/// files are damaged that could not be made again, it says how many; `cairn check` names them.
#[utoipa::path(get, path = "/readyz", tag = "service", responses(
    (status = 200, description = "It is ready", body = String, content_type = "text/plain"),
    (status = 503, description = "It is stopping, or cannot write its data, or has too little disk left", body = Problem, content_type = "application/problem+json")))]
pub(super) async fn readyz(State(api): State<Api>) -> Result<String, Problem> {
    api.readiness.check(&api).await?;
    Ok(match api.store.damage().await?.len() {
        0 => "ready\n".to_owned(),
        n => format!("ready, but {n} stored files are damaged; cairn check names them\n"),
    })
}

/// The description of this interface.
#[utoipa::path(get, path = "/openapi.yaml", tag = "service",
    responses((status = 200, description = "OpenAPI 3.1", body = String, content_type = "application/yaml")))]
pub(super) async fn openapi(State(api): State<Api>) -> impl IntoResponse {
    ([(header::CONTENT_TYPE, "application/yaml")], api.openapi.as_ref().to_owned())
}
