//! Extractors whose refusals are problems too.

use std::time::Duration;

use axum::extract::rejection::JsonRejection;
use axum::extract::{FromRequest, FromRequestParts, Path, Request};
use axum::http::StatusCode;
use axum::http::request::Parts;
use serde::de::DeserializeOwned;
use tokio::time::timeout;

use super::Problem;

/// Ids in the path. One that is no id names nothing, so the answer is 404.
pub(super) struct Ids<T>(pub T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for Ids<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        match Path::<T>::from_request_parts(parts, state).await {
            Ok(Path(ids)) => Ok(Self(ids)),
            Err(_) => Err(no_id()),
        }
    }
}

/// Text of the path that is no id names nothing.
pub(super) fn no_id() -> Problem {
    Problem::not_found("the path holds something that is no id")
}

/// How long a JSON body may take: it is small.
const PATIENCE: Duration = Duration::from_secs(30);

/// A JSON body.
pub(super) struct Body<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Body<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        match timeout(PATIENCE, axum::Json::<T>::from_request(request, state)).await {
            Ok(Ok(axum::Json(body))) => Ok(Self(body)),
            Ok(Err(rejection)) => Err(refusal(&rejection)),
            Err(_) => Err(Problem::new(
                StatusCode::REQUEST_TIMEOUT,
                "body-stalled",
                format!("the body did not come within {} s", PATIENCE.as_secs()),
            )),
        }
    }
}

fn refusal(rejection: &JsonRejection) -> Problem {
    let status = rejection.status();
    match rejection {
        JsonRejection::JsonDataError(_) | JsonRejection::JsonSyntaxError(_) => {
            Problem::invalid("body", rejection.body_text())
        }
        _ if status == StatusCode::PAYLOAD_TOO_LARGE => {
            Problem::new(status, "too-large", "the JSON body has more than 2 MiB, which is the limit")
        }
        _ if status == StatusCode::UNSUPPORTED_MEDIA_TYPE => {
            Problem::new(status, "not-json", "the body must be sent as content-type: application/json")
        }
        _ => Problem::invalid("body", rejection.body_text()),
    }
}
