//! `Idempotency-Key`: a POST that is sent again, because its answer was lost, is answered again and done once.
//!
//! The layer hashes the request while the handler reads it, and keeps the answer under the key for a day. A key that
//! comes with another request is refused (422), one whose first request still runs as well (409). Not kept are failures
//! of the service, refusals for want of room and for what stands in the way just now (409), and answers that were given before the whole
//! request was read: then trying again is right.
//! A handler that changes rows has the answer kept in the same transaction ([`Once`]), so that no death of the process comes
//! between the two; uploads know their content again instead. Uses [`crate::storage::KeptAnswer`].

mod description;
mod hashing;
mod key;
mod once;
mod running;

use std::time::Duration;

use axum::body::{Body, to_bytes};
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use tracing::Instrument;

use super::problem::Problem;
use super::router::Api;
use crate::jobs::Pace;
use crate::project::Timestamp;
use crate::storage::Answer;

pub(super) use description::describe;
use hashing::{Hashing, of_head};
use key::key;
use once::receipt;
pub(super) use once::{Once, Reply};
pub(super) use running::Running;

/// How long answers are kept.
const KEPT: Duration = Duration::from_hours(24);
/// The longest answer that is kept, bytes. Answers to POSTs are a few kilobytes.
const MAX_ANSWER: usize = 1 << 20;
/// Says that an answer was given before.
const REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// The layer: answers a request with a key once and for all.
pub(super) async fn idempotent(
    State((api, running)): State<(Api, Running)>,
    request: Request,
    next: Next,
) -> Response {
    let key = match key(&request) {
        Ok(None) => return next.run(request).await,
        Ok(Some(key)) => key,
        Err(problem) => return problem.into_response(),
    };
    let scope = scope(request.headers());
    // It runs to its end even if the connection breaks: what is done is to be remembered.
    let work = async move { once(&api, &running, &scope, &key, request, next).await };
    match tokio::spawn(work.in_current_span()).await {
        Ok(answer) => answer.unwrap_or_else(Problem::into_response),
        Err(error) => Problem::internal(error).into_response(),
    }
}

/// Who asks: the hash of what the request shows as its right to ask.
fn scope(headers: &HeaderMap) -> String {
    headers
        .get(axum::http::header::AUTHORIZATION)
        .map_or_else(String::new, |shown| blake3::hash(shown.as_bytes()).to_hex().to_string())
}

async fn once(
    api: &Api,
    running: &Running,
    scope: &str,
    key: &str,
    request: Request,
    next: Next,
) -> Result<Response, Problem> {
    let _claim = running.claim(scope, key).ok_or_else(|| {
        let detail = "the first request with this key still runs; try again when it has been answered";
        Problem::new(StatusCode::CONFLICT, "request-running", detail)
    })?;
    let hasher = of_head(&request);
    if let Some(kept) = api.store.kept_answer(scope, key, Timestamp::now()).await? {
        let found = of_body(api, hasher, request.into_body()).await?;
        return if found == kept.request {
            replay(kept.answer)
        } else {
            Err(Problem {
                field: Some(key::FIELD.to_owned()),
                ..Problem::new(
                    StatusCode::UNPROCESSABLE_ENTITY,
                    "key-reused",
                    "this key came before, with another request",
                )
            })
        };
    }
    let (mut parts, body) = request.into_parts();
    let (body, hash) = Hashing::new(hasher, body);
    let ticket = Once::new(scope, key, hash.clone());
    parts.extensions.insert(ticket.clone());
    let answer = next.run(Request::from_parts(parts, Body::new(body))).await;
    let Some(request) = hash.whole() else { return Ok(answer) };
    if passes(answer.status()) {
        return Ok(answer);
    }
    if ticket.is_sealed() && answer.status().is_success() {
        return Ok(answer);
    }
    keep(api, scope, key, request, answer).await
}

/// Whether the same request may be answered otherwise once something else has changed: the service is well again, there is room, or what
/// stood in the way has gone.
fn passes(status: StatusCode) -> bool {
    status.is_server_error() || matches!(status, StatusCode::TOO_MANY_REQUESTS | StatusCode::CONFLICT)
}

/// Keeps an answer, and gives it.
async fn keep(
    api: &Api,
    scope: &str,
    key: &str,
    request: [u8; 32],
    answer: Response,
) -> Result<Response, Problem> {
    let (parts, body) = answer.into_parts();
    let body = to_bytes(body, MAX_ANSWER).await.map_err(Problem::internal)?;
    let text = |(name, value): (&HeaderName, &HeaderValue)| {
        Some((name.as_str().to_owned(), value.to_str().ok()?.to_owned()))
    };
    let kept = Answer {
        status: parts.status.as_u16(),
        headers: parts.headers.iter().filter_map(text).collect(),
        body: body.to_vec(),
    };
    if let Err(error) = api.store.keep_answer(&receipt(scope, key, request), &kept).await {
        // What was asked for is done, so the client is told so.
        tracing::error!(%error, "an answer could not be kept for its key");
    }
    Ok(Response::from_parts(parts, Body::from(body)))
}

/// The answer that was kept, given again.
fn replay(kept: Answer) -> Result<Response, Problem> {
    let mut answer = given(kept)?;
    answer.headers_mut().insert(REPLAYED, HeaderValue::from_static("true"));
    Ok(answer)
}

fn given(kept: Answer) -> Result<Response, Problem> {
    let status = StatusCode::from_u16(kept.status).map_err(Problem::internal)?;
    let mut answer = (status, kept.body).into_response();
    answer.headers_mut().clear();
    for (name, value) in kept.headers {
        let name = HeaderName::from_bytes(name.as_bytes()).map_err(Problem::internal)?;
        answer.headers_mut().append(name, HeaderValue::from_str(&value).map_err(Problem::internal)?);
    }
    Ok(answer)
}

/// Reads a body that is not needed, under the limits of an upload, for its hash.
async fn of_body(api: &Api, mut hasher: blake3::Hasher, body: Body) -> Result<[u8; 32], Problem> {
    let (limit, idle) = (api.resumable.max_bytes(), api.resumable.idle());
    let (mut pieces, mut bytes, mut pace) = (body.into_data_stream(), 0, Pace::new(idle));
    loop {
        let next = pace.next(&mut pieces).await.map_err(|_| {
            Problem::new(
                StatusCode::REQUEST_TIMEOUT,
                "upload-stalled",
                "nearly nothing of the body came for too long",
            )
        })?;
        let Some(piece) = next else { return Ok(*hasher.finalize().as_bytes()) };
        let piece = piece.map_err(|error| {
            Problem::new(
                StatusCode::BAD_REQUEST,
                "upload-interrupted",
                format!("the body broke off: {error}"),
            )
        })?;
        bytes += piece.len() as u64;
        if bytes > limit {
            let detail = "the body has more bytes than any request may have";
            let problem = Problem::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", detail);
            return Err(Problem { limit: Some(limit), ..problem });
        }
        hasher.update(&piece);
    }
}
