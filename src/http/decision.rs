//! `/v1/projects/{p}/decisions`: what clients decide about two scans where the data alone cannot tell.

use axum::Json;
use axum::extract::State;
use axum::http::{StatusCode, header};
use axum::response::IntoResponse;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::access::Caller;
use super::extract::{Body, Ids};
use super::idempotency::{Once, Reply};
use super::job::JobBody;
use super::link::Link;
use super::problem::{Problem, Problems};
use super::query::{Params, next};
use super::router::Api;
use crate::geometry::Pose;
use crate::project::{
    Decision, DecisionId, Job, KeptDecision, ProjectId, ScanId, Timestamp, Verdict, VersionNumber, motion,
};
use crate::storage::StorageError;

/// A decision to be made.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewDecision {
    /// join: the two belong together at about this pose, which their surfaces then refine. forbid: they do not, at this pose or,
    /// without one, in no way.
    #[schema(examples("join"), pattern = "^(join|forbid)$")]
    verdict: String,
    /// Id of one scan. It stands for the whole component that holds it.
    scan_a: String,
    /// Id of the other scan.
    scan_b: String,
    /// Maps points of scan b into scan a: 4x4, row-major, metres, own frames of the scans. A join needs this or `pose`.
    #[schema(value_type = Option<Vec<Vec<f64>>>)]
    a_from_b: Option<Value>,
    /// Instead of `a_from_b`: the index of a pose that the model lists in the open join of the two scans.
    #[schema(minimum = 0)]
    pose: Option<u32>,
    /// In which version the pose is listed; the newest if absent.
    #[schema(minimum = 0)]
    version: Option<u32>,
}

/// A decision.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct DecisionBody {
    /// Its id.
    #[schema(value_type = String)]
    id: DecisionId,
    /// join or forbid.
    verdict: &'static str,
    /// One scan.
    #[schema(value_type = String)]
    scan_a: ScanId,
    /// The other.
    #[schema(value_type = String)]
    scan_b: ScanId,
    /// Maps points of scan b into scan a: 4x4, row-major, metres. Absent where they are forbidden to meet at all.
    #[schema(value_type = Option<Vec<Vec<f64>>>)]
    a_from_b: Option<[[f64; 4]; 4]>,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// Itself, its project and its scans.
    links: Vec<Link>,
}

/// A decision with the job that makes the model obey it.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct DecidedBody {
    /// The decision.
    decision: DecisionBody,
    /// The job. Whatever changes the model from now on obeys too.
    job: JobBody,
}

/// A part of the list of decisions.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct DecisionList {
    /// Oldest first.
    items: Vec<DecisionBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl DecisionBody {
    fn new(project: ProjectId, kept: &KeptDecision) -> Self {
        let Decision { scan_a, scan_b, verdict } = kept.decision;
        let project = format!("/v1/projects/{project}");
        let links = vec![
            Link::new("self", format!("{project}/decisions/{}", kept.id)),
            Link::new("scan_a", format!("{project}/scans/{scan_a}")),
            Link::new("scan_b", format!("{project}/scans/{scan_b}")),
            Link::new("project", project),
        ];
        Self {
            id: kept.id,
            verdict: verdict.word(),
            scan_a,
            scan_b,
            a_from_b: verdict.a_from_b().map(|pose| pose.to_rows()),
            created: kept.created,
            links,
        }
    }
}

/// Decides about two scans. It replaces earlier decisions about them that it contradicts, holds for all later versions until it is
/// taken back or a scan is deleted, and comes with a job that publishes a version which obeys.
#[utoipa::path(post, path = "/v1/projects/{project}/decisions", tag = "decisions", request_body = NewDecision,
    params(("project" = String, Path, description = "Id of the project")), responses(
    (status = 202, description = "The decision and its job", body = DecidedBody,
        headers(("location" = String, description = "The job"))),
    (status = 409, description = "The project holds as many decisions as it may", body = Problem, content_type = "application/problem+json"),
    (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn create_decision(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    caller: Caller,
    once: Once,
    Body(new): Body<NewDecision>,
) -> Result<Reply, Problem> {
    api.store.project(project).await?;
    let decision = checked(&api, project, &new).await?;
    let answer = |(kept, job): &(KeptDecision, Job)| {
        let location = format!("/v1/jobs/{}", job.id);
        let body = DecidedBody { decision: DecisionBody::new(project, kept), job: job.clone().into() };
        Reply::made(StatusCode::ACCEPTED, location, &[(header::RETRY_AFTER, "1")]).json(&body)
    };
    let done =
        api.store.decide(project, &decision, caller.key(), once.seal(answer)).await.map_err(|e| match e {
            // Whoever names a scan in a body is told which field names it.
            StorageError::NoScan(id) => Problem::invalid(field_of(&decision, id), e.to_string()),
            other => other.into(),
        })?;
    answer(&done)
}

/// Lists the decisions that hold.
#[utoipa::path(get, path = "/v1/projects/{project}/decisions", tag = "decisions", params(
    ("project" = String, Path, description = "Id of the project"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = DecisionList), Problems))]
pub(super) async fn list_decisions(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Json<DecisionList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    api.store.project(project).await?;
    let found = api.store.decisions(project, page).await?;
    let next = next(page, &found);
    let items = found.iter().map(|(_, kept)| DecisionBody::new(project, kept)).collect();
    Ok(Json(DecisionList { items, next }))
}

/// Shows a decision.
#[utoipa::path(get, path = "/v1/projects/{project}/decisions/{decision}", tag = "decisions", params(
    ("project" = String, Path, description = "Id of the project"),
    ("decision" = String, Path, description = "Id of the decision")),
    responses((status = 200, description = "The decision", body = DecisionBody), Problems))]
pub(super) async fn get_decision(
    State(api): State<Api>,
    Ids((project, decision)): Ids<(ProjectId, DecisionId)>,
) -> Result<Json<DecisionBody>, Problem> {
    let kept = api.store.decision(project, decision).await?;
    Ok(Json(DecisionBody::new(project, &kept)))
}

/// Takes a decision back. The job publishes a version that is free of it.
#[utoipa::path(delete, path = "/v1/projects/{project}/decisions/{decision}", tag = "decisions", params(
    ("project" = String, Path, description = "Id of the project"),
    ("decision" = String, Path, description = "Id of the decision")),
    responses((status = 202, description = "The job", body = JobBody,
        headers(("location" = String, description = "The job"))), Problems))]
pub(super) async fn delete_decision(
    State(api): State<Api>,
    Ids((project, decision)): Ids<(ProjectId, DecisionId)>,
    caller: Caller,
) -> Result<impl IntoResponse, Problem> {
    let job = api.store.take_decision_back(project, decision, caller.key()).await?;
    let location = format!("/v1/jobs/{}", job.id);
    Ok((
        StatusCode::ACCEPTED,
        [(header::LOCATION, location), (header::RETRY_AFTER, "1".to_owned())],
        Json(JobBody::from(job)),
    ))
}

/// The decision that a body means, with every field checked but for whether the scans are there.
async fn checked(api: &Api, project: ProjectId, new: &NewDecision) -> Result<Decision, Problem> {
    let joins = match new.verdict.as_str() {
        "join" => true,
        "forbid" => false,
        _ => return Err(Problem::invalid("verdict", "the verdict must be join or forbid")),
    };
    let id =
        |field: &str, text: &str| text.parse::<ScanId>().map_err(|e| Problem::invalid(field, e.to_string()));
    let (scan_a, scan_b) = (id("scan_a", &new.scan_a)?, id("scan_b", &new.scan_b)?);
    if scan_a == scan_b {
        return Err(Problem::invalid("scan_b", "a decision is about two scans, not twice about the same"));
    }
    for (field, scan) in [("scan_a", scan_a), ("scan_b", scan_b)] {
        api.store.scan(project, scan).await.map_err(|e| match e {
            StorageError::NoScan(_) => Problem::invalid(field, e.to_string()),
            other => other.into(),
        })?;
    }
    let a_from_b = match (&new.a_from_b, new.pose) {
        (Some(_), Some(_)) => return Err(Problem::invalid("pose", "give `a_from_b` or `pose`, not both")),
        (Some(rows), None) => Some(motion(rows).map_err(|e| Problem::invalid("a_from_b", e.to_string()))?),
        (None, Some(index)) => Some(listed(api, project, new.version, scan_a, scan_b, index).await?),
        (None, None) => None,
    };
    if new.version.is_some() && new.pose.is_none() {
        return Err(Problem::invalid("version", "a version only says where `pose` is listed"));
    }
    let verdict = match (joins, a_from_b) {
        (true, None) => return Err(Problem::invalid("a_from_b", "a join needs `a_from_b` or `pose`")),
        (true, Some(a_from_b)) => Verdict::Join { a_from_b },
        (false, a_from_b) => Verdict::Forbid { a_from_b },
    };
    Ok(Decision { scan_a, scan_b, verdict })
}

/// A pose of the open join of two scans, in the order in which the client names them.
async fn listed(
    api: &Api,
    project: ProjectId,
    version: Option<u32>,
    scan_a: ScanId,
    scan_b: ScanId,
    index: u32,
) -> Result<Pose, Problem> {
    let found = api.store.content(project, version.map(VersionNumber)).await;
    let (version, content) = found.map_err(|e| match e {
        StorageError::NoVersion(..) => Problem::invalid("version", e.to_string()),
        other => other.into(),
    })?;
    let forth = content.open_joins.iter().find(|open| (open.scan_a, open.scan_b) == (scan_a, scan_b));
    let back = content.open_joins.iter().find(|open| (open.scan_a, open.scan_b) == (scan_b, scan_a));
    let Some(open) = forth.or(back) else {
        let detail = format!("version {version} lists no open join between scans {scan_a} and {scan_b}");
        return Err(Problem::invalid("pose", detail));
    };
    let Some(pose) = open.poses.get(index as usize) else {
        let count = open.poses.len();
        return Err(Problem {
            limit: Some(count.saturating_sub(1) as u64),
            ..Problem::invalid(
                "pose",
                format!("version {version} lists {count} poses there, numbered from 0"),
            )
        });
    };
    Ok(if forth.is_some() { pose.a_from_b } else { pose.a_from_b.inverse() })
}

fn field_of(decision: &Decision, scan: ScanId) -> &'static str {
    if decision.scan_a == scan { "scan_a" } else { "scan_b" }
}
