//! `/metrics`: what an operator watches, in the text format of Prometheus (`OpenMetrics`).
//!
//! Requests, refusals, uploads and ended jobs are counted as they happen (`counted`); what there is right now, such as
//! the length of the queue, is asked of the database for each answer (`now`).

mod counted;
mod now;

use axum::extract::State;
use axum::http::header;
use axum::response::IntoResponse;
use prometheus_client::encoding::text::{encode_eof, encode_registry};

use super::problem::{Problem, Problems};
use super::router::Api;

pub use counted::Metrics;
pub(super) use counted::count;

const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";

/// Tells what an operator watches: the queue, jobs, scans, models, disk, requests and refusals. Needs a key for every project.
#[utoipa::path(get, path = "/metrics", tag = "service", responses(
    (status = 200, description = "OpenMetrics 1.0", body = String, content_type = "application/openmetrics-text"),
    Problems))]
pub(super) async fn metrics(State(api): State<Api>) -> Result<impl IntoResponse, Problem> {
    api.metrics.catch_up(&api.store).await?;
    let mut text = String::new();
    encode_registry(&mut text, api.metrics.registry()).map_err(Problem::internal)?;
    encode_registry(&mut text, &now::registry(&api.store).await?).map_err(Problem::internal)?;
    encode_eof(&mut text).map_err(Problem::internal)?;
    Ok(([(header::CONTENT_TYPE, OPEN_METRICS), (header::CACHE_CONTROL, "no-store")], text))
}
