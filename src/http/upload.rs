//! `POST /v1/projects/{p}/scans`: a scan arrives as the raw body.

use axum::Json;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::IntoResponse;
use serde::Serialize;
use utoipa::ToSchema;

use super::access::Caller;
use super::content_digest::content_digest;
use super::download::Bytes;
use super::extract::Ids;
use super::job::JobBody;
use super::problem::{Problem, Problems};
use super::query::Params;
use super::router::Api;
use super::scan::ScanBody;
use crate::jobs::{UploadRequest, metres_per_unit};
use crate::project::{BadInterpretation, Interpretation, Name, ProjectId, three_numbers};

/// An acknowledged upload.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct UploadBody {
    /// The scan.
    scan: ScanBody,
    /// The job that registers it.
    job: JobBody,
    /// Whether the project had this content already, registered or on its way; then nothing was changed.
    duplicate: bool,
}

/// Uploads a scan. It is acknowledged when its bytes are synced to disk; the job says what becomes of it. Content that
/// the project has already is answered with the scan and job that it is (200); if that scan has failed or was dismissed, a
/// new job tries again (202).
#[utoipa::path(post, path = "/v1/projects/{project}/scans", tag = "scans", params(
    ("project" = String, Path, description = "Id of the project"),
    ("name" = String, Query, description = "What to call the scan, such as its file name", min_length = 1, max_length = 200),
    ("units" = Option<String>, Query, description = "Unit of its coordinates: mm, cm, m, km, in, ft, us-ft, or metres in one unit; m if absent", min_length = 1),
    ("sensor_position" = Option<String>, Query, description = "Where the sensor stood, in the scan's own frame, metres: x,y,z"),
    ("up" = Option<String>, Query, description = "Against gravity, in the scan's own frame: x,y,z, of any length; believed to within 3 degrees"),
    ("content-digest" = Option<String>, Header, description = "RFC 9530: sha-256 or sha-512 of the body; a body that differs is refused")),
    request_body(content = Bytes, content_type = "application/octet-stream", description = "The file: PLY, PCD, XYZ or PTS"),
    responses(
    (status = 200, description = "The project has this content already", body = UploadBody),
    (status = 202, description = "The scan and its job", body = UploadBody, headers(
        ("location" = String, description = "The job"), ("retry-after" = u32, description = "Seconds until polling makes sense"))),
    (status = 408, description = "No byte came for too long", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "More bytes than `limit`", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The content is in no known format", body = Problem, content_type = "application/problem+json"),
    (status = 422, description = "The content is empty or not what the name says", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn upload_scan(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    caller: Caller,
    mut query: Params,
    headers: HeaderMap,
    body: Body,
) -> Result<impl IntoResponse, Problem> {
    let request = UploadRequest {
        project,
        name: name(&mut query, None)?,
        interpretation: interpretation(&mut query)?,
        declared_bytes: declared(&headers),
        sender: caller.key(),
        digests: content_digest(&headers)?,
    };
    query.finish()?;
    if is_form(&headers) {
        let detail = "send the file itself as the body (curl -T FILE), not in a form";
        return Err(Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "not-a-file", detail));
    }
    let admission = api.intake.receive(request, body.into_data_stream()).await?;
    api.metrics.uploaded(admission.scan.bytes, admission.duplicate);
    let status = if admission.duplicate { StatusCode::OK } else { StatusCode::ACCEPTED };
    let location = format!("/v1/jobs/{}", admission.job.id);
    let body =
        UploadBody { scan: admission.scan.into(), job: admission.job.into(), duplicate: admission.duplicate };
    Ok((status, [(header::LOCATION, location), (header::RETRY_AFTER, "1".to_owned())], Json(body)))
}

/// Whether the body is a form with files in it, which clients may take for the way to upload.
fn is_form(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).map(HeaderValue::as_bytes).unwrap_or_default();
    kind.get(..10).is_some_and(|start| start.eq_ignore_ascii_case(b"multipart/"))
}

fn declared(headers: &HeaderMap) -> Option<u64> {
    headers.get(header::CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}

/// The scan's name, or `otherwise` if it is not given.
pub(super) fn name(params: &mut Params, otherwise: Option<String>) -> Result<Name, Problem> {
    let text = params.text("name").or(otherwise);
    let text = text.ok_or_else(|| Problem::invalid("name", "`name` is missing"))?;
    Name::parse(&text).map_err(|e| Problem::invalid("name", e.to_string()))
}

/// `units`, `sensor_position` and `up`.
pub(super) fn interpretation(query: &mut Params) -> Result<Interpretation, Problem> {
    let units =
        query.with("units", "mm, cm, m, km, in, ft, us-ft, or metres in one unit", metres_per_unit)?;
    let sensor_position = query.with("sensor_position", "three numbers in metres: x,y,z", three_numbers)?;
    let up = query.with("up", "three numbers: x,y,z", three_numbers)?;
    let interpretation = Interpretation { metres_per_unit: units.unwrap_or(1.0), sensor_position, up };
    match interpretation.validate() {
        Ok(()) => Ok(interpretation),
        Err(e @ BadInterpretation::Units(_)) => Err(Problem::invalid("units", e.to_string())),
        Err(e @ BadInterpretation::SensorPosition(_)) => {
            Err(Problem::invalid("sensor_position", e.to_string()))
        }
        Err(e @ BadInterpretation::Up(_)) => Err(Problem::invalid("up", e.to_string())),
    }
}
