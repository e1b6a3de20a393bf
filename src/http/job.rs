//! `/v1/jobs`: asking for jobs, listing, polling and dismissing them. Their events are in `events`.

use std::time::Duration;

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use utoipa::ToSchema;

use super::access::Caller;
use super::download::none_match;
use super::extract::{Body, Ids};
use super::idempotency::{Once, Reply};
use super::link::Link;
use super::problem::{Problem, Problems};
use super::query::{Params, next};
use super::router::Api;
use crate::project::{Job, JobId, JobKind, JobState, ProjectId, ScanId, Timestamp};
use crate::storage::{JobFilter, Store};

/// A job to be accepted.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewJob {
    /// global-bundle-adjustment, track-refinement, dense-refinement or rebuild.
    #[schema(
        examples("global-bundle-adjustment"),
        pattern = "^(global-bundle-adjustment|track-refinement|dense-refinement|rebuild)$"
    )]
    kind: String,
}

/// A job, in the words of OGC API Processes.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobBody {
    /// Its id.
    #[schema(value_type = String)]
    id: JobId,
    /// The project that it works on.
    #[schema(value_type = String)]
    project: ProjectId,
    /// The scan that it is about, for registrations and removals.
    #[schema(value_type = Option<String>)]
    scan: Option<ScanId>,
    /// registration, global-bundle-adjustment, track-refinement, dense-refinement, rebuild, removal or decision.
    #[schema(value_type = String)]
    kind: JobKind,
    /// accepted, running, succeeded, failed or dismissed.
    #[schema(value_type = String)]
    status: JobState,
    /// What is being done, such as `match`.
    stage: Option<String>,
    /// Percent done; never falls.
    #[schema(maximum = 100)]
    progress: u8,
    /// How often a worker has taken it up.
    attempt: u32,
    /// What came of it. For a registration: `status` registered (with `component` and `version`) or waiting (with the
    /// `reason`). For work on the whole model: its `version`, and how many `components`, scans `registered`, `open_joins` and
    /// placements `undone` that has.
    #[schema(value_type = Option<Object>)]
    outcome: Option<Value>,
    /// Why it failed.
    problem: Option<Problem>,
    /// When it was accepted.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// When a worker took it up first.
    #[schema(value_type = Option<String>, format = DateTime)]
    started: Option<Timestamp>,
    /// When it ended.
    #[schema(value_type = Option<String>, format = DateTime)]
    finished: Option<Timestamp>,
    /// When it changed last.
    #[schema(value_type = String, format = DateTime)]
    updated: Timestamp,
    /// Itself, its events, its project and its scan.
    links: Vec<Link>,
}

/// A part of the list of jobs.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct JobList {
    /// Oldest first.
    items: Vec<JobBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl From<Job> for JobBody {
    fn from(j: Job) -> Self {
        let (own, project) = (format!("/v1/jobs/{}", j.id), format!("/v1/projects/{}", j.project));
        let mut links = vec![Link::new("self", own.clone()), Link::new("events", format!("{own}/events"))];
        links.extend(j.scan.map(|scan| Link::new("scan", format!("{project}/scans/{scan}"))));
        links.push(Link::new("project", project));
        Self {
            id: j.id,
            project: j.project,
            scan: j.scan,
            kind: j.kind,
            status: j.state,
            stage: j.stage,
            progress: j.progress,
            attempt: j.attempt,
            outcome: j.outcome,
            problem: j.fault.as_ref().map(Problem::of_fault),
            created: j.created,
            started: j.started,
            finished: j.finished,
            updated: j.updated,
            links,
        }
    }
}

/// Accepts a job on the model of a project.
#[utoipa::path(post, path = "/v1/projects/{project}/jobs", tag = "jobs", request_body = NewJob,
    params(("project" = String, Path, description = "Id of the project")), responses(
    (status = 202, description = "The job", body = JobBody, headers(("location" = String, description = "The job"))),
    (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn create_job(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    caller: Caller,
    once: Once,
    Body(new): Body<NewJob>,
) -> Result<Reply, Problem> {
    let kind = new.kind.parse::<JobKind>().ok().filter(|k| k.on_request()).ok_or_else(|| {
        let words: Vec<_> = JobKind::ALL.iter().filter(|k| k.on_request()).map(|k| k.as_str()).collect();
        Problem::invalid("kind", format!("the kind must be one of {}", words.join(", ")))
    })?;
    let answer = |job: &Job| {
        let location = format!("/v1/jobs/{}", job.id);
        Reply::made(StatusCode::ACCEPTED, location, &[(header::RETRY_AFTER, "1")])
            .json(&JobBody::from(job.clone()))
    };
    let job = api.store.create_job(project, kind, caller.key(), once.seal(answer)).await?;
    answer(&job)
}

/// Lists the jobs of a project.
#[utoipa::path(get, path = "/v1/projects/{project}/jobs", tag = "jobs", params(
    ("project" = String, Path, description = "Id of the project"),
    ("status" = Option<String>, Query, description = "Only jobs with this status",
        pattern = "^(accepted|running|succeeded|failed|dismissed)$"),
    ("kind" = Option<String>, Query, description = "Only jobs of this kind",
        pattern = "^(registration|global-bundle-adjustment|track-refinement|dense-refinement|rebuild|removal|decision)$"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = JobList), Problems))]
pub(super) async fn list_jobs(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Json<JobList>, Problem> {
    let filter = JobFilter {
        state: query.with("status", "a job's status", JobState::from_word)?,
        kind: query.value("kind", "a kind of job")?,
    };
    let page = query.page()?;
    query.finish()?;
    api.store.project(project).await?;
    let found = api.store.jobs(project, filter, page).await?;
    let next = next(page, &found);
    Ok(Json(JobList { items: found.into_iter().map(|(_, j)| j.into()).collect(), next }))
}

/// Shows a job. With `wait`, the answer comes when the job has ended (or, given `if-none-match`, when it has changed), at
/// the latest after so many seconds.
#[utoipa::path(get, path = "/v1/jobs/{job}", tag = "jobs", params(
    ("job" = String, Path, description = "Id of the job"),
    ("wait" = Option<u32>, Query, description = "Seconds to wait for a change, at most 60", maximum = 60),
    ("if-none-match" = Option<String>, Header, description = "The ETag of an earlier answer")),
    responses(
    (status = 200, description = "The job", body = JobBody, headers(
        ("etag" = String, description = "Changes with the job"),
        ("retry-after" = Option<u32>, description = "Seconds until polling makes sense; absent once it has ended"))),
    (status = 304, description = "The job is as in the earlier answer"),
    Problems))]
pub(super) async fn get_job(
    State(api): State<Api>,
    Ids(id): Ids<JobId>,
    mut query: Params,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let wait = query
        .with("wait", "a whole number of seconds, at most 60", |t| t.parse().ok().filter(|s| *s <= 60))?;
    query.finish()?;
    let known = headers.contains_key(header::IF_NONE_MATCH);
    let enough = |job: &Job| job.state.is_final() || (known && !none_match(&headers, &etag(job)));
    let job = settled(&api.store, id, Duration::from_secs(wait.unwrap_or(0)), enough).await?;
    let tag = etag(&job);
    let mut response = if none_match(&headers, &tag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        let ended = job.state.is_final();
        let mut response = Json(JobBody::from(job)).into_response();
        if !ended {
            response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from_static("1"));
        }
        response
    };
    response.headers_mut().insert(header::ETAG, HeaderValue::from_str(&tag).map_err(Problem::internal)?);
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    Ok(response)
}

/// Dismisses a job that has not ended.
#[utoipa::path(delete, path = "/v1/jobs/{job}", tag = "jobs",
    params(("job" = String, Path, description = "Id of the job")), responses(
    (status = 200, description = "The dismissed job", body = JobBody),
    (status = 409, description = "It has ended, or is a removal or a decision", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn dismiss_job(
    State(api): State<Api>,
    Ids(job): Ids<JobId>,
) -> Result<Json<JobBody>, Problem> {
    Ok(Json(api.store.dismiss_job(job).await?.into()))
}

fn etag(job: &Job) -> String {
    format!("\"{}-{}\"", job.id, job.revision)
}

/// The job as soon as it is `enough`, at the latest when `wait` is over.
async fn settled(
    store: &Store,
    id: JobId,
    wait: Duration,
    enough: impl Fn(&Job) -> bool,
) -> Result<Job, Problem> {
    let deadline = tokio::time::Instant::now() + wait;
    // Listening begins before the first look, so that no change falls between.
    let mut changes = store.changes();
    loop {
        let job = store.job(id).await?;
        if enough(&job) || tokio::time::Instant::now() >= deadline {
            return Ok(job);
        }
        let change = async {
            // A listener that lagged behind looks again to be sure.
            while changes.recv().await.is_ok_and(|changed| changed != id) {}
        };
        // The end of the wait is seen at the next look.
        let _ = tokio::time::timeout_at(deadline, change).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_description_knows_every_word_that_is_understood() {
        let yaml = crate::http::openapi_yaml().unwrap();
        let choice = |words: Vec<&str>| format!("^({})$", words.join("|"));
        let kinds = || JobKind::ALL.iter();
        assert!(yaml.contains(&choice(JobState::ALL.iter().map(|s| s.as_str()).collect())));
        assert!(yaml.contains(&choice(kinds().map(|k| k.as_str()).collect())));
        assert!(yaml.contains(&choice(kinds().filter(|k| k.on_request()).map(|k| k.as_str()).collect())));
    }
}
