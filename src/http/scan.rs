//! `/v1/projects/{p}/scans`: listing, showing, downloading and deleting scans. Uploads are in `upload`.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::{Value, json};
use utoipa::ToSchema;

use super::download::{Bytes, Download, serve};
use super::extract::Ids;
use super::job::JobBody;
use super::link::Link;
use super::problem::{Problem, Problems};
use super::query::{Params, cursor};
use super::router::Api;
use crate::project::{JobId, Name, ProjectId, Scan, ScanId, ScanState, Standing, Timestamp};
use crate::storage::{BlobId, StoredBlob};

/// A scan.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ScanBody {
    /// Its id.
    #[schema(value_type = String)]
    id: ScanId,
    /// The project that it belongs to.
    #[schema(value_type = String)]
    project: ProjectId,
    /// What the client called it.
    #[schema(value_type = String)]
    name: Name,
    /// How far it has come: received, ingested, registered, waiting, failed or dismissed.
    #[schema(value_type = String)]
    state: ScanState,
    /// Where it stands in the newest version of the model (`status` registered, with `component` and
    /// `model_from_scan`, or waiting, with the `reason`), or why it failed. Absent before that.
    #[schema(value_type = Option<Object>)]
    outcome: Option<Value>,
    /// The file format, recognised from the content.
    format: String,
    /// Size of the upload, bytes.
    bytes: u64,
    /// BLAKE3 hash of the upload.
    blake3: String,
    /// Metres in one unit of its coordinates.
    metres_per_unit: f64,
    /// Where the sensor stood, in the scan's own frame, metres, if the client said so.
    sensor_position: Option<[f64; 3]>,
    /// Against gravity, in the scan's own frame, if the client said so.
    up: Option<[f64; 3]>,
    /// Points, once decoded.
    points: Option<u64>,
    /// Diagonal of the box that holds the middle 96 % of each coordinate, metres, once decoded.
    extent: Option<f64>,
    /// The job that registers it.
    #[schema(value_type = String)]
    job: JobId,
    /// When it was acknowledged.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// Itself, its upload, its job and its project.
    links: Vec<Link>,
}

/// A part of the list of scans.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ScanList {
    /// In order of arrival.
    items: Vec<ScanBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl From<Scan> for ScanBody {
    fn from(s: Scan) -> Self {
        let project = format!("/v1/projects/{}", s.project);
        let own = format!("{project}/scans/{}", s.id);
        let links = vec![
            Link::new("original", format!("{own}/original")),
            Link::new("self", own),
            Link::new("job", format!("/v1/jobs/{}", s.job)),
            Link::new("project", project),
        ];
        Self {
            id: s.id,
            project: s.project,
            name: s.name,
            state: s.state,
            outcome: s.standing.as_ref().map(standing_body),
            format: s.format,
            bytes: s.bytes,
            blake3: s.blob,
            metres_per_unit: s.interpretation.metres_per_unit,
            sensor_position: s.interpretation.sensor_position,
            up: s.interpretation.up,
            points: s.points,
            extent: s.extent,
            job: s.job,
            created: s.created,
            links,
        }
    }
}

/// A standing as clients see it, poses as 4x4 row-major matrices.
pub(super) fn standing_body(standing: &Standing) -> Value {
    match standing {
        Standing::Registered(p) => json!({
            "status": "registered",
            "component": p.component,
            "model_from_scan": p.model_from_scan.to_rows(),
            "landmarks": p.landmarks,
            "neighbours": p.neighbours,
            "landmark_rms": p.landmark_rms,
        }),
        Standing::Waiting(reason) => {
            let mut body = reason.numbers.clone();
            body.insert("status".to_owned(), "waiting".into());
            body.insert("reason".to_owned(), reason.reason.clone().into());
            Value::Object(body)
        }
        Standing::Failed(fault) => json!({ "status": "failed", "problem": Problem::of_fault(fault) }),
    }
}

/// Lists the scans of a project.
#[utoipa::path(get, path = "/v1/projects/{project}/scans", tag = "scans", params(
    ("project" = String, Path, description = "Id of the project"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = ScanList), Problems))]
pub(super) async fn list_scans(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Json<ScanList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    api.store.project(project).await?;
    let found = api.store.scans(project, page).await?;
    let full = found.len() == page.limit as usize;
    let next = found.last().filter(|_| full).map(|s| cursor(s.arrival.cast_signed() + 1));
    Ok(Json(ScanList { items: found.into_iter().map(ScanBody::from).collect(), next }))
}

/// Shows a scan.
#[utoipa::path(get, path = "/v1/projects/{project}/scans/{scan}", tag = "scans", params(
    ("project" = String, Path, description = "Id of the project"),
    ("scan" = String, Path, description = "Id of the scan")),
    responses((status = 200, description = "The scan", body = ScanBody), Problems))]
pub(super) async fn get_scan(
    State(api): State<Api>,
    Ids((project, scan)): Ids<(ProjectId, ScanId)>,
) -> Result<Json<ScanBody>, Problem> {
    Ok(Json(api.store.scan(project, scan).await?.into()))
}

/// Downloads a scan as it was uploaded.
#[utoipa::path(get, path = "/v1/projects/{project}/scans/{scan}/original", tag = "scans", params(
    ("project" = String, Path, description = "Id of the project"),
    ("scan" = String, Path, description = "Id of the scan"),
    ("range" = Option<String>, Header, description = "One range of bytes"),
    ("if-none-match" = Option<String>, Header, description = "ETags that the client holds")),
    responses(
    (status = 200, description = "The upload", body = Bytes, content_type = "application/octet-stream"),
    (status = 206, description = "The range", body = Bytes, content_type = "application/octet-stream"),
    (status = 304, description = "The client holds it already"),
    (status = 416, description = "The range is outside the file", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn get_original(
    State(api): State<Api>,
    Ids((project, scan)): Ids<(ProjectId, ScanId)>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let scan = api.store.scan(project, scan).await?;
    let blob = StoredBlob { id: BlobId::parse(&scan.blob)?, bytes: scan.bytes };
    let download =
        Download { blob, media_type: "application/octet-stream", file_name: scan.name.as_str().to_owned() };
    serve(&api.store, download, &headers).await
}

/// Deletes a scan. It is gone at once; the job takes it out of the model.
#[utoipa::path(delete, path = "/v1/projects/{project}/scans/{scan}", tag = "scans", params(
    ("project" = String, Path, description = "Id of the project"),
    ("scan" = String, Path, description = "Id of the scan")),
    responses((status = 202, description = "The job", body = JobBody,
        headers(("location" = String, description = "The job"))), Problems))]
pub(super) async fn delete_scan(
    State(api): State<Api>,
    Ids((project, scan)): Ids<(ProjectId, ScanId)>,
) -> Result<impl IntoResponse, Problem> {
    let job = api.store.delete_scan(project, scan).await?;
    let location = format!("/v1/jobs/{}", job.id);
    Ok((
        StatusCode::ACCEPTED,
        [(header::LOCATION, location), (header::RETRY_AFTER, "1".to_owned())],
        Json(JobBody::from(job)),
    ))
}
