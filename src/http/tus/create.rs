//! `POST /v1/uploads`: an upload is announced, perhaps with its first bytes.

use axum::body::{Body, HttpBody};
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};

use super::append::{count, detached};
use super::headers::{BYTES, brings_bytes, bytes, continuation, standing, text};
use super::metadata::parse_metadata;
use super::version::{RESUMABLE, Tus, VERSION};
use crate::http::access::Caller;
use crate::http::download::Bytes;
use crate::http::idempotency::{Once, Reply};
use crate::http::problem::{Problem, Problems};
use crate::http::query::Params;
use crate::http::router::Api;
use crate::project::{NewUpload, Scope, Upload};
use crate::storage::Seal;

/// Announces an upload that will come in several requests (tus: creation, creation-with-upload). The metadata are the
/// parameters of a direct upload and `project`. When the last byte has come, the upload is a scan like any other: the
/// answer to the request that brings it names scan and job.
#[utoipa::path(post, path = "/v1/uploads", tag = "uploads", params(
    ("tus-resumable" = String, Header, description = "1.0.0", pattern = "^1\\.0\\.0$"),
    ("upload-length" = u64, Header, description = "Bytes that will come", minimum = 1),
    ("upload-metadata" = String, Header, description = "Pairs of a key and its value in base64, separated by commas: project, name (or filename), units, sensor_position, up"),
    ("upload-checksum" = Option<String>, Header, description = "sha1, sha256 or sha512, a space, and the base64 of what the bytes of this request hash to"),
    ("content-digest" = Option<String>, Header, description = "RFC 9530: sha-256 or sha-512 of the bytes of this request")),
    request_body(content = Option<Bytes>, content_type = "application/offset+octet-stream", description = "The first bytes, if any"),
    responses(
    (status = 201, description = "The upload", headers(
        ("location" = String, description = "The upload: continue it there"),
        ("upload-offset" = u64, description = "Bytes that came and are safe"),
        ("upload-expires" = Option<String>, description = "When it is forgotten unless it is continued"),
        ("cairn-scan" = Option<String>, description = "The scan, once all bytes have come"),
        ("cairn-job" = Option<String>, description = "The job that registers it"),
        ("cairn-duplicate" = Option<bool>, description = "Whether the project had this content already"))),
    (status = 408, description = "No byte came for too long", body = Problem, content_type = "application/problem+json"),
    (status = 412, description = "Another version of tus is spoken here", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "More bytes than `limit`", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is no bytes of an upload, or the content is in no known format", body = Problem, content_type = "application/problem+json"),
    (status = 422, description = "The content is empty or not what the name says", body = Problem, content_type = "application/problem+json"),
    (status = 460, description = "The bytes are not those that were sent", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn create_upload(
    _: Tus,
    State(api): State<Api>,
    caller: Caller,
    once: Once,
    query: Params,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    query.finish()?;
    let length = length(&headers)?;
    let metadata = text(&headers, "upload-metadata")?.unwrap_or("");
    let parsed = parse_metadata(metadata)?;
    caller.admit(Scope::Upload, parsed.project)?;
    let with_bytes = brings_bytes(&headers);
    if !with_bytes && !body.is_end_stream() {
        return Err(wrong_type());
    }
    let request = continuation(&headers, 0)?;
    let new = NewUpload {
        project: parsed.project,
        name: parsed.name,
        interpretation: parsed.interpretation,
        metadata: metadata.to_owned(),
        length,
        sender: caller.key(),
    };
    // With bytes, the answer is known only when they have come.
    let seal = if with_bytes { Seal::none() } else { once.seal(announced) };
    let upload = api.resumable.create(new, seal).await?;
    let upload = if with_bytes { first_bytes(&api, upload, request, body).await? } else { upload };
    count(&api.metrics, &upload);
    Ok(announced(&upload)?.into_response())
}

/// The answer to an announcement.
fn announced(upload: &Upload) -> Result<Reply, Problem> {
    let mut headers = standing(upload)?;
    headers.insert(RESUMABLE, HeaderValue::from_static(VERSION));
    let location = format!("/v1/uploads/{}", upload.id);
    let told: Vec<_> =
        headers.iter().filter_map(|(name, value)| Some((name.clone(), value.to_str().ok()?))).collect();
    Ok(Reply::made(StatusCode::CREATED, location, &told))
}

/// Takes the bytes in that came with the announcement.
async fn first_bytes(
    api: &Api,
    upload: Upload,
    request: crate::jobs::Continuation,
    body: Body,
) -> Result<Upload, Problem> {
    let (resumable, id) = (api.resumable.clone(), upload.id);
    detached(async move {
        match resumable.append(id, request, body.into_data_stream()).await {
            // What came is safe; the client goes on from there.
            Err(error) if error.leaves_good_bytes() => Ok(resumable.peek(id).await?),
            Err(error) => {
                // The client does not know the upload's address, so it cannot go on. If the content was to blame, the
                // upload is gone already.
                if let Err(cause) = resumable.terminate(id).await {
                    tracing::debug!(%cause, upload = %id, "an upload that failed at once is gone already");
                }
                Err(error.into())
            }
            Ok(upload) => Ok(upload),
        }
    })
    .await
}

fn length(headers: &HeaderMap) -> Result<u64, Problem> {
    for name in ["upload-defer-length", "upload-concat"] {
        if headers.contains_key(name) {
            let detail = format!("`{name}` belongs to an extension of tus that is not spoken here");
            return Err(Problem::invalid(name, detail));
        }
    }
    bytes(headers, "upload-length")?
        .ok_or_else(|| Problem::invalid("upload-length", "`upload-length` is missing"))
}

/// The body is not declared as bytes of an upload.
pub(super) fn wrong_type() -> Problem {
    let detail = format!("bytes of an upload must be sent as content-type: {BYTES}");
    Problem::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "not-upload-bytes", detail)
}
