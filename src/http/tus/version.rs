//! Which version and which extensions of the protocol are spoken.

use axum::extract::{FromRequestParts, State};
use axum::http::request::Parts;
use axum::http::{HeaderName, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};

use crate::http::Problem;
use crate::http::router::Api;

pub(super) const RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
const VERSIONS: HeaderName = HeaderName::from_static("tus-version");
pub(super) const VERSION: &str = "1.0.0";
const EXTENSIONS: &str = "creation,creation-with-upload,checksum,expiration,termination";
const ALGORITHMS: &str = "sha1,sha256,sha512";

/// The request speaks the version that is spoken here.
pub(super) struct Tus;

impl<S: Sync> FromRequestParts<S> for Tus {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        match parts.headers.get(RESUMABLE) {
            Some(version) if version == VERSION => Ok(Self),
            found => {
                let found = found.map_or("missing", |v| v.to_str().unwrap_or("unreadable"));
                let found: String = found.chars().take(40).collect();
                let detail = format!("`tus-resumable` is {found}; version {VERSION} is spoken here");
                let status = StatusCode::PRECONDITION_FAILED;
                Err(Problem {
                    field: Some(RESUMABLE.as_str().to_owned()),
                    ..Problem::new(status, "unsupported-tus-version", detail)
                })
            }
        }
    }
}

/// Every answer says which version it speaks.
pub(super) async fn speak(mut response: Response) -> Response {
    let mismatch = response.status() == StatusCode::PRECONDITION_FAILED;
    let headers = response.headers_mut();
    headers.insert(RESUMABLE, HeaderValue::from_static(VERSION));
    if mismatch {
        headers.insert(VERSIONS, HeaderValue::from_static(VERSION));
    }
    response
}

/// Says which version and extensions of tus are spoken here.
#[utoipa::path(options, path = "/v1/uploads", tag = "uploads", responses(
    (status = 204, description = "In its headers", headers(
        ("tus-resumable" = String, description = "1.0.0"),
        ("tus-version" = String, description = "1.0.0"),
        ("tus-extension" = String, description = "Names of extensions"),
        ("tus-max-size" = u64, description = "The largest upload, bytes"),
        ("tus-checksum-algorithm" = String, description = "Names of hash functions")))))]
pub(super) async fn describe_uploads(State(api): State<Api>) -> Response {
    description(&api)
}

/// Says which version and extensions of tus are spoken here.
#[utoipa::path(options, path = "/v1/uploads/{upload}", tag = "uploads",
    params(("upload" = String, Path, description = "Id of the upload; any will do")), responses(
    (status = 204, description = "In its headers, as for all uploads")))]
pub(super) async fn describe_upload(State(api): State<Api>) -> Response {
    description(&api)
}

pub(super) fn description(api: &Api) -> Response {
    let headers = [
        (VERSIONS, VERSION.to_owned()),
        (HeaderName::from_static("tus-extension"), EXTENSIONS.to_owned()),
        (HeaderName::from_static("tus-max-size"), api.resumable.max_bytes().to_string()),
        (HeaderName::from_static("tus-checksum-algorithm"), ALGORITHMS.to_owned()),
    ];
    (StatusCode::NO_CONTENT, headers).into_response()
}
