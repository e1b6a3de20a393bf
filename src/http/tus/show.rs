//! `HEAD`, `GET` and `DELETE /v1/uploads/{u}`: how far an upload is, what became of it, and taking it back. `GET /v1/projects/{p}/uploads`:
//! which are not complete.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use utoipa::ToSchema;

use super::append::detached;
use super::headers::standing;
use super::version::Tus;
use crate::http::extract::Ids;
use crate::http::job::JobBody;
use crate::http::link::Link;
use crate::http::problem::{Problem, Problems};
use crate::http::query::{Params, next};
use crate::http::router::Api;
use crate::http::scan::ScanBody;
use crate::project::{Name, ProjectId, Timestamp, Upload, UploadId};
use crate::storage::StorageError;

/// An upload that comes in several requests.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ResumableBody {
    /// Its id.
    #[schema(value_type = String)]
    id: UploadId,
    /// The project that will own the scan.
    #[schema(value_type = String)]
    project: ProjectId,
    /// What the scan will be called.
    #[schema(value_type = String)]
    name: Name,
    /// Bytes that were announced.
    length: u64,
    /// Bytes that are safe.
    offset: u64,
    /// When it was announced.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// When it is forgotten unless it is continued.
    #[schema(value_type = String, format = DateTime)]
    expires: Timestamp,
    /// The scan, once all bytes have come and unless it was deleted.
    scan: Option<ScanBody>,
    /// The job that registers it.
    job: Option<JobBody>,
    /// Whether the project had this content already, registered or on its way; absent until all bytes have come.
    duplicate: Option<bool>,
    /// Itself and its project.
    links: Vec<Link>,
}

/// A part of the list of uploads.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ResumableList {
    /// Oldest first.
    items: Vec<ResumableBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl ResumableBody {
    fn new(upload: Upload, scan: Option<ScanBody>, job: Option<JobBody>) -> Self {
        let Upload { id, announced, received, end, created, expires, .. } = upload;
        let project = format!("/v1/projects/{}", announced.project);
        Self {
            id,
            project: announced.project,
            name: announced.name,
            length: announced.length,
            offset: received,
            created,
            expires,
            scan,
            job,
            duplicate: end.map(|end| end.duplicate),
            links: vec![Link::new("self", format!("/v1/uploads/{id}")), Link::new("project", project)],
        }
    }
}

/// Lists the uploads into a project that are neither complete nor expired. Who may send scans may take them back.
#[utoipa::path(get, path = "/v1/projects/{project}/uploads", tag = "uploads", params(
    ("project" = String, Path, description = "Id of the project"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = ResumableList), Problems))]
pub(in crate::http) async fn list_uploads(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Json<ResumableList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    api.store.project(project).await?;
    let found = api.store.open_uploads(project, page).await?;
    let next = next(page, &found);
    let items = found.into_iter().map(|(_, upload)| ResumableBody::new(upload, None, None)).collect();
    Ok(Json(ResumableList { items, next }))
}

/// Shows how far an upload is, without disturbing who writes to it, and what became of it.
#[utoipa::path(get, path = "/v1/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "Id of the upload")), responses(
    (status = 200, description = "The upload", body = ResumableBody),
    (status = 410, description = "The upload has expired", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn get_upload(
    State(api): State<Api>,
    Ids(id): Ids<UploadId>,
) -> Result<Json<ResumableBody>, Problem> {
    let upload = api.resumable.peek(id).await?;
    let (scan, job) = match upload.end {
        None => (None, None),
        Some(end) => {
            let scan = match api.store.scan(upload.announced.project, end.scan).await {
                Err(StorageError::NoScan(_)) => None,
                other => Some(other?.into()),
            };
            (scan, Some(api.store.job(end.job).await?.into()))
        }
    };
    Ok(Json(ResumableBody::new(upload, scan, job)))
}

/// Says where an upload goes on. A request that still writes to it is asked to end first, so that the answer stays true.
#[utoipa::path(head, path = "/v1/uploads/{upload}", tag = "uploads", params(
    ("upload" = String, Path, description = "Id of the upload"),
    ("tus-resumable" = String, Header, description = "1.0.0", pattern = "^1\\.0\\.0$")),
    responses(
    (status = 200, description = "In its headers", headers(
        ("upload-offset" = u64, description = "Bytes that are safe"),
        ("upload-length" = u64, description = "Bytes that were announced"),
        ("upload-metadata" = String, description = "What was announced"),
        ("upload-expires" = Option<String>, description = "When it is forgotten unless it is continued"),
        ("cairn-scan" = Option<String>, description = "The scan, once all bytes have come"),
        ("cairn-job" = Option<String>, description = "The job that registers it"),
        ("cairn-duplicate" = Option<bool>, description = "Whether the project had this content already"))),
    (status = 404, description = "There is no such upload"),
    (status = 410, description = "The upload has expired"),
    (status = 412, description = "Another version of tus is spoken here"),
    (status = 423, description = "Another request is finishing the upload"),
    (status = 429, description = "The upload is complete, but the project or the key has as much as it may"),
    (status = 500, description = "The service failed"),
    (status = 503, description = "Its files or its database cannot be used just now"),
    (status = 507, description = "It has no space left")))]
pub(super) async fn head_upload(
    _: Tus,
    State(api): State<Api>,
    Ids(id): Ids<UploadId>,
) -> Result<Response, Problem> {
    let upload = detached(async move { Ok(api.resumable.resume(id).await?) }).await?;
    let mut headers = standing(&upload)?;
    headers.insert("upload-length", HeaderValue::from(upload.announced.length));
    let metadata = HeaderValue::from_str(&upload.announced.metadata).map_err(Problem::internal)?;
    headers.insert("upload-metadata", metadata);
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok((StatusCode::OK, headers).into_response())
}

/// Takes an upload back (tus: termination). A scan that it became stays.
#[utoipa::path(delete, path = "/v1/uploads/{upload}", tag = "uploads", params(
    ("upload" = String, Path, description = "Id of the upload"),
    ("tus-resumable" = String, Header, description = "1.0.0", pattern = "^1\\.0\\.0$")),
    responses(
    (status = 204, description = "It is gone"),
    (status = 410, description = "The upload has expired", body = Problem, content_type = "application/problem+json"),
    (status = 412, description = "Another version of tus is spoken here", body = Problem, content_type = "application/problem+json"),
    (status = 423, description = "Another request is finishing the upload", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn terminate_upload(
    _: Tus,
    State(api): State<Api>,
    Ids(id): Ids<UploadId>,
) -> Result<StatusCode, Problem> {
    detached(async move { Ok(api.resumable.terminate(id).await?) }).await?;
    Ok(StatusCode::NO_CONTENT)
}
