//! `POST /v1/uploads/{u}` with `X-HTTP-Method-Override`, for clients behind proxies that let only GET and POST pass.

use axum::body::Body;
use axum::extract::{MatchedPath, Request, State};
use axum::http::{HeaderMap, Method, StatusCode};
use axum::response::{IntoResponse, Response};

use super::append::continue_upload;
use super::headers::text;
use super::show::{get_upload, head_upload, terminate_upload};
use super::version::{Tus, description};
use crate::http::download::Bytes;
use crate::http::extract::Ids;
use crate::http::problem::{Problem, Problems};
use crate::http::router::Api;
use crate::project::UploadId;

/// The header that names the method.
const OVERRIDE: &str = "x-http-method-override";

/// The method that a request means: its own, unless it is a POST that stands for another.
pub(in crate::http) fn meant(request: &Request) -> Method {
    let template = request.extensions().get::<MatchedPath>().map(MatchedPath::as_str);
    let stands = *request.method() == Method::POST && template == Some("/v1/uploads/{upload}");
    let named = stands.then(|| text(request.headers(), OVERRIDE).ok().flatten()).flatten();
    named.and_then(|name| name.parse().ok()).unwrap_or_else(|| request.method().clone())
}

/// Does what the method in `x-http-method-override` does, and answers as that does.
#[utoipa::path(post, path = "/v1/uploads/{upload}", tag = "uploads", params(
    ("upload" = String, Path, description = "Id of the upload"),
    ("x-http-method-override" = String, Header, description = "The method that is meant", pattern = "^(PATCH|HEAD|DELETE|GET|OPTIONS)$"),
    ("tus-resumable" = String, Header, description = "1.0.0", pattern = "^1\\.0\\.0$"),
    ("upload-offset" = Option<u64>, Header, description = "For PATCH: where these bytes belong"),
    ("upload-checksum" = Option<String>, Header, description = "For PATCH: sha1, sha256 or sha512, a space, and base64"),
    ("content-digest" = Option<String>, Header, description = "For PATCH: RFC 9530")),
    request_body(content = Option<Bytes>, content_type = "application/offset+octet-stream", description = "For PATCH: the bytes"),
    responses(
    (status = 200, description = "As HEAD or GET"),
    (status = 204, description = "As PATCH, DELETE or OPTIONS"),
    (status = 405, description = "No method is named that this address answers", body = Problem, content_type = "application/problem+json"),
    (status = 408, description = "No byte came for too long", body = Problem, content_type = "application/problem+json"),
    (status = 409, description = "The upload has another offset, or a later request has taken it over", body = Problem, content_type = "application/problem+json"),
    (status = 410, description = "The upload has expired", body = Problem, content_type = "application/problem+json"),
    (status = 412, description = "Another version of tus is spoken here", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "More bytes than announced", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "As PATCH", body = Problem, content_type = "application/problem+json"),
    (status = 422, description = "As PATCH", body = Problem, content_type = "application/problem+json"),
    (status = 423, description = "Another request is finishing the upload", body = Problem, content_type = "application/problem+json"),
    (status = 460, description = "The bytes are not those that were sent", body = Problem, content_type = "application/problem+json"),
    (status = 503, description = "The service is stopping", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn post_upload(
    tus: Tus,
    State(api): State<Api>,
    Ids(id): Ids<UploadId>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, Problem> {
    let (state, ids) = (State(api), Ids::<UploadId>(id));
    match text(&headers, OVERRIDE)?.unwrap_or("POST") {
        "PATCH" => continue_upload(tus, state, ids, headers, body).await,
        "HEAD" => head_upload(tus, state, ids).await,
        "DELETE" => terminate_upload(tus, state, ids).await.map(IntoResponse::into_response),
        "GET" => get_upload(state, ids).await.map(IntoResponse::into_response),
        "OPTIONS" => Ok(description(&state)),
        _ => Err(Problem {
            field: Some("x-http-method-override".to_owned()),
            ..Problem::new(
                StatusCode::METHOD_NOT_ALLOWED,
                "method-not-allowed",
                "this address answers PATCH, HEAD, DELETE, GET and OPTIONS; a POST must name one of them",
            )
        }),
    }
}
