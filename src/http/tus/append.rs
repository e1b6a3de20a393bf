//! `PATCH /v1/uploads/{u}`: an upload goes on.

use std::sync::Arc;

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use tracing::Instrument;

use super::create::wrong_type;
use super::headers::{brings_bytes, bytes, continuation, standing};
use super::version::Tus;
use crate::http::download::Bytes;
use crate::http::extract::Ids;
use crate::http::metrics::Metrics;
use crate::http::problem::{Problem, Problems};
use crate::http::router::Api;
use crate::project::{Upload, UploadId};

/// Continues an upload. What came before a broken connection is kept, unless a checksum was given: then all bytes of the
/// request are kept or none. The answer to the last byte names the scan; it comes when that is acknowledged like a direct
/// upload.
#[utoipa::path(patch, path = "/v1/uploads/{upload}", tag = "uploads", params(
    ("upload" = String, Path, description = "Id of the upload"),
    ("tus-resumable" = String, Header, description = "1.0.0", pattern = "^1\\.0\\.0$"),
    ("upload-offset" = u64, Header, description = "Where these bytes belong: what HEAD says"),
    ("upload-checksum" = Option<String>, Header, description = "sha1, sha256 or sha512, a space, and the base64 of what these bytes hash to"),
    ("content-digest" = Option<String>, Header, description = "RFC 9530: sha-256 or sha-512 of these bytes")),
    request_body(content = Bytes, content_type = "application/offset+octet-stream", description = "The bytes"),
    responses(
    (status = 204, description = "They are safe", headers(
        ("upload-offset" = u64, description = "Bytes of the upload that are safe"),
        ("upload-expires" = Option<String>, description = "When it is forgotten unless it is continued"),
        ("cairn-scan" = Option<String>, description = "The scan, once all bytes have come"),
        ("cairn-job" = Option<String>, description = "The job that registers it"),
        ("cairn-duplicate" = Option<bool>, description = "Whether the project had this content already"))),
    (status = 408, description = "No byte came for too long", body = Problem, content_type = "application/problem+json"),
    (status = 409, description = "The upload has another offset, or a later request has taken it over", body = Problem, content_type = "application/problem+json"),
    (status = 410, description = "The upload has expired", body = Problem, content_type = "application/problem+json"),
    (status = 412, description = "Another version of tus is spoken here", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "More bytes than announced; nothing of the request is kept", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is no bytes of an upload, or the content is in no known format: then the upload is gone", body = Problem, content_type = "application/problem+json"),
    (status = 422, description = "The content is not what the name says; the upload is gone", body = Problem, content_type = "application/problem+json"),
    (status = 423, description = "Another request is finishing the upload", body = Problem, content_type = "application/problem+json"),
    (status = 460, description = "The bytes are not those that were sent; nothing of the request is kept", body = Problem, content_type = "application/problem+json"),
    (status = 503, description = "The service is stopping", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn continue_upload(
    _: Tus,
    State(api): State<Api>,
    Ids(id): Ids<UploadId>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    if !brings_bytes(&headers) {
        return Err(wrong_type());
    }
    let offset = bytes(&headers, "upload-offset")?
        .ok_or_else(|| Problem::invalid("upload-offset", "`upload-offset` is missing"))?;
    let request = continuation(&headers, offset)?;
    let metrics = Arc::clone(&api.metrics);
    let upload =
        detached(async move { Ok(api.resumable.append(id, request, body.into_data_stream()).await?) })
            .await?;
    count(&metrics, &upload);
    Ok((StatusCode::NO_CONTENT, standing(&upload)?).into_response())
}

/// Counts an upload that has become a scan.
pub(super) fn count(metrics: &Metrics, upload: &Upload) {
    if let Some(end) = upload.end {
        metrics.uploaded(upload.announced.length, end.duplicate);
    }
}

/// Runs to its end even if the connection breaks and nobody waits for the answer: what came is to be made safe.
pub(super) async fn detached<T: Send + 'static>(
    work: impl Future<Output = Result<T, Problem>> + Send + 'static,
) -> Result<T, Problem> {
    tokio::spawn(work.in_current_span()).await.map_err(Problem::internal)?
}
