//! `/v1/projects/{p}/webhooks`: addresses that are told when jobs end, and what was sent to them.

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::extract::{Body, Ids};
use super::idempotency::{Once, Reply};
use super::link::Link;
use super::problem::{Problem, Problems};
use super::query::{Params, next};
use super::router::Api;
use crate::jobs::webhooks::{new_secret, reveal};
use crate::project::{Delivery, JobId, ProjectId, Timestamp, Webhook, WebhookId};

/// A webhook to be registered.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewWebhook {
    /// Where messages are to be sent: http or https, and a host that the operator has listed.
    #[schema(examples("https://hooks.example.com/cairn"), max_length = 2000)]
    url: String,
}

/// A webhook.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct WebhookBody {
    /// Its id.
    #[schema(value_type = String)]
    id: WebhookId,
    /// The project whose jobs it is told of.
    #[schema(value_type = String)]
    project: ProjectId,
    /// Where messages are sent.
    url: String,
    /// What signs the messages (<https://www.standardwebhooks.com>); shown only when it is registered.
    #[serde(skip_serializing_if = "Option::is_none")]
    secret: Option<String>,
    /// When it was registered.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// Itself, its messages and its project.
    links: Vec<Link>,
}

/// The webhooks of a project.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct WebhookList {
    /// Oldest first; there are few.
    items: Vec<WebhookBody>,
}

/// A message about the end of a job.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct DeliveryBody {
    /// Its id, `webhook-id` in every attempt.
    id: String,
    /// The job.
    #[schema(value_type = String)]
    job: JobId,
    /// pending, delivered or failed.
    #[schema(value_type = String)]
    state: &'static str,
    /// How often it was sent.
    attempts: u32,
    /// The status of the last answer, if there was one.
    status: Option<u16>,
    /// Why the last attempt came to nothing.
    error: Option<String>,
    /// When the job ended.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// When it was delivered or given up.
    #[schema(value_type = Option<String>, format = DateTime)]
    ended: Option<Timestamp>,
}

/// A part of the list of messages.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct DeliveryList {
    /// Oldest first.
    items: Vec<DeliveryBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl From<Webhook> for WebhookBody {
    fn from(w: Webhook) -> Self {
        let project = format!("/v1/projects/{}", w.project);
        let own = format!("{project}/webhooks/{}", w.id);
        let links = vec![
            Link::new("self", own.clone()),
            Link::new("deliveries", format!("{own}/deliveries")),
            Link::new("project", project),
        ];
        Self { id: w.id, project: w.project, url: w.url, secret: None, created: w.created, links }
    }
}

impl From<Delivery> for DeliveryBody {
    fn from(d: Delivery) -> Self {
        let Delivery { id, job, state, attempts, status, error, created, ended, .. } = d;
        Self { id, job, state: state.as_str(), attempts, status, error, created, ended }
    }
}

/// Registers an address that is told when a job of the project ends: a POST with `type` (`job.succeeded`, `job.failed`,
/// `job.dismissed`), `timestamp` and the job as `data`, signed with the secret of this answer, and sent again until it is
/// answered with 2xx.
#[utoipa::path(post, path = "/v1/projects/{project}/webhooks", tag = "webhooks", request_body = NewWebhook,
    params(("project" = String, Path, description = "Id of the project")), responses(
    (status = 201, description = "The webhook and its secret", body = WebhookBody, headers(("location" = String, description = "The webhook"))),
    (status = 409, description = "The project has as many webhooks as it may", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn create_webhook(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    once: Once,
    Body(new): Body<NewWebhook>,
) -> Result<Reply, Problem> {
    if new.url.len() > MAX_URL {
        return Err(Problem::invalid("url", format!("the url is longer than {MAX_URL} bytes")));
    }
    api.webhooks.target(&new.url).map_err(|error| Problem::invalid("url", error.to_string()))?;
    let secret = new_secret().map_err(Problem::internal)?;
    let answer = |made: &Webhook| {
        let location = format!("/v1/projects/{project}/webhooks/{}", made.id);
        let body = WebhookBody { secret: Some(reveal(&secret)), ..made.clone().into() };
        Reply::made(StatusCode::CREATED, location, &[]).json(&body)
    };
    let made = api.store.create_webhook(project, &new.url, &secret, once.seal(answer)).await?;
    answer(&made)
}

/// Lists the webhooks of a project.
#[utoipa::path(get, path = "/v1/projects/{project}/webhooks", tag = "webhooks",
    params(("project" = String, Path, description = "Id of the project")),
    responses((status = 200, description = "The webhooks", body = WebhookList), Problems))]
pub(super) async fn list_webhooks(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
) -> Result<Json<WebhookList>, Problem> {
    api.store.project(project).await?;
    let found = api.store.webhooks(project).await?;
    Ok(Json(WebhookList { items: found.into_iter().map(WebhookBody::from).collect() }))
}

/// Shows a webhook.
#[utoipa::path(get, path = "/v1/projects/{project}/webhooks/{webhook}", tag = "webhooks", params(
    ("project" = String, Path, description = "Id of the project"), ("webhook" = String, Path, description = "Id of the webhook")),
    responses((status = 200, description = "The webhook", body = WebhookBody), Problems))]
pub(super) async fn get_webhook(
    State(api): State<Api>,
    Ids((project, webhook)): Ids<(ProjectId, WebhookId)>,
) -> Result<Json<WebhookBody>, Problem> {
    Ok(Json(api.store.webhook(project, webhook).await?.into()))
}

/// Takes a webhook back, with the messages that wait.
#[utoipa::path(delete, path = "/v1/projects/{project}/webhooks/{webhook}", tag = "webhooks", params(
    ("project" = String, Path, description = "Id of the project"), ("webhook" = String, Path, description = "Id of the webhook")),
    responses((status = 204, description = "It is gone"), Problems))]
pub(super) async fn delete_webhook(
    State(api): State<Api>,
    Ids((project, webhook)): Ids<(ProjectId, WebhookId)>,
) -> Result<StatusCode, Problem> {
    api.store.delete_webhook(project, webhook).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// Lists the messages to a webhook, and what has become of them. Those that have ended are shown for thirty days.
#[utoipa::path(get, path = "/v1/projects/{project}/webhooks/{webhook}/deliveries", tag = "webhooks", params(
    ("project" = String, Path, description = "Id of the project"), ("webhook" = String, Path, description = "Id of the webhook"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = DeliveryList), Problems))]
pub(super) async fn list_deliveries(
    State(api): State<Api>,
    Ids((project, webhook)): Ids<(ProjectId, WebhookId)>,
    mut query: Params,
) -> Result<Json<DeliveryList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    api.store.webhook(project, webhook).await?;
    let found = api.store.deliveries(webhook, page).await?;
    let next = next(page, &found);
    Ok(Json(DeliveryList { items: found.into_iter().map(|(_, d)| d.into()).collect(), next }))
}

/// The longest address, bytes.
const MAX_URL: usize = 2000;
