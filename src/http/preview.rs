//! `/v1/projects/{p}/preview`: a picture of the model.

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;

use super::cloud::component;
use super::download::{Bytes, Download, serve};
use super::extract::Ids;
use super::problem::{Problem, Problems};
use super::query::Params;
use super::router::Api;
use crate::project::ProjectId;

/// Downloads a picture of a component: from above and from the side, PNG.
#[utoipa::path(get, path = "/v1/projects/{project}/preview", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("version" = Option<u32>, Query, description = "Number of the version; the newest if absent"),
    ("component" = Option<String>, Query, description = "Index of a component, 0 (the largest) if absent, or `all`, each in its own frame", pattern = "^(all|[0-9]{1,9})$"),
    ("range" = Option<String>, Header, description = "One range of bytes"),
    ("if-none-match" = Option<String>, Header, description = "ETags that the client holds")),
    responses(
    (status = 200, description = "The picture", body = Bytes, content_type = "image/png"),
    (status = 206, description = "The range", body = Bytes, content_type = "image/png"),
    (status = 304, description = "The client holds it already"),
    (status = 416, description = "The range is outside the file", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn get_preview(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let version = query.version()?;
    let component = component(&mut query)?;
    query.finish()?;
    let reading = api.readings.read(&api.store, project, version).await?;
    let file_name = format!("preview-{}.png", reading.version);
    let part = api.exports.part(project, &reading.content, component).await?;
    // To be made it may wait for others, and must not keep them from reading meanwhile.
    drop(reading);
    let blob = api.exports.preview(part).await?;
    serve(&api.store, Download { blob, media_type: "image/png", file_name }, &headers).await
}
