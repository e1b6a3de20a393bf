//! `/v1/projects/{p}/cloud`: the merged cloud.

use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::Response;

use super::download::{Bytes, Download, serve};
use super::extract::Ids;
use super::problem::{Problem, Problems};
use super::query::Params;
use super::router::Api;
use crate::jobs::ComponentChoice;
use crate::project::ProjectId;

/// Downloads the merged cloud as binary PLY: the uploads, moved into the frame of their component. Coordinates are metres
/// in single precision; where they are as large as georeferenced ones, a comment in the header names the offset that was
/// subtracted. Scans that were deleted since are left out. Name a version to be sure that ranges belong to the same file.
#[utoipa::path(get, path = "/v1/projects/{project}/cloud", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("version" = Option<u32>, Query, description = "Number of the version; the newest if absent"),
    ("component" = Option<String>, Query, description = "Index of a component, 0 (the largest) if absent, or `all`: each stays in its own frame, so they lie over one another without any relation", pattern = "^(all|[0-9]{1,9})$"),
    ("voxel" = Option<f64>, Query, description = "One point for each occupied cube of this edge, metres; every point if absent", minimum = 0.00001, maximum = 1000),
    ("range" = Option<String>, Header, description = "One range of bytes"),
    ("if-none-match" = Option<String>, Header, description = "ETags that the client holds")),
    responses(
    (status = 200, description = "The cloud", body = Bytes, content_type = "model/ply"),
    (status = 206, description = "The range", body = Bytes, content_type = "model/ply"),
    (status = 304, description = "The client holds it already"),
    (status = 416, description = "The range is outside the file", body = Problem, content_type = "application/problem+json"),
    (status = 422, description = "More cubes than `limit` are occupied", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn get_cloud(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let version = query.version()?;
    let component = component(&mut query)?;
    let voxel = query.with("voxel", "a length between 0.00001 and 1000 m", |text| {
        text.trim().parse().ok().filter(|edge| (1e-5..=1e3).contains(edge))
    })?;
    query.finish()?;
    let reading = api.readings.read(&api.store, project, version).await?;
    let file_name = format!("cloud-{}.ply", reading.version);
    let part = api.exports.part(project, &reading.content, component).await?;
    // To be made it may wait for others, and must not keep them from reading meanwhile.
    drop(reading);
    let blob = api.exports.cloud(part, voxel).await?;
    serve(&api.store, Download { blob, media_type: "model/ply", file_name }, &headers).await
}

/// `component` of a cloud or a picture.
pub(super) fn component(query: &mut Params) -> Result<ComponentChoice, Problem> {
    let choice = query.with("component", "the index of a component, or all", |text| match text {
        "all" => Some(ComponentChoice::All),
        index => index.parse().ok().map(ComponentChoice::One),
    })?;
    Ok(choice.unwrap_or(ComponentChoice::One(0)))
}
