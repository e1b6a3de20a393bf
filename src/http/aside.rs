//! Answers that grow with the project are written aside: a thread that attends to connections would keep all others waiting meanwhile.

use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::to_vec;

use super::problem::Problem;

/// What takes longer the more scans a project has. A panic in it is an internal error.
pub(super) async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Problem> {
    tokio::task::spawn_blocking(work).await.map_err(Problem::internal)
}

/// An answer as JSON, made and written aside.
pub(super) async fn json<T: Serialize>(
    body: impl FnOnce() -> T + Send + 'static,
) -> Result<Response, Problem> {
    let bytes = aside(move || to_vec(&body())).await?.map_err(Problem::internal)?;
    Ok(([(header::CONTENT_TYPE, "application/json")], bytes).into_response())
}
