//! `/v1/projects`: making, listing, showing and deleting projects.

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::access::Caller;
use super::extract::{Body, Ids};
use super::idempotency::{Once, Reply};
use super::link::Link;
use super::problem::{Problem, Problems};
use super::query::{Params, next};
use super::router::Api;
use crate::control::Seed;
use crate::project::{Name, Project, ProjectId, ProjectSettings, Timestamp, VersionNumber};

/// A project to be made.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub(super) struct NewProject {
    /// What people call it: 1 to 200 characters, no control characters.
    #[schema(min_length = 1, max_length = 200, examples("Town hall"))]
    name: String,
    /// Root of every random choice; at most 2^53 - 1.
    #[serde(default)]
    #[schema(maximum = 9_007_199_254_740_991_i64, required = false)]
    seed: u64,
    /// Voxel size from which every length scale derives, metres. Chosen from the first scans if absent.
    #[schema(minimum = 0.00001, maximum = 100)]
    resolution: Option<f64>,
}

/// A project.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ProjectBody {
    /// Its id.
    #[schema(value_type = String)]
    id: ProjectId,
    /// What people call it.
    #[schema(value_type = String)]
    name: Name,
    /// Root of every random choice.
    seed: u64,
    /// Voxel size that its owner set, metres.
    resolution: Option<f64>,
    /// Scans that it holds.
    scans: u64,
    /// Number of the newest version of its model; 0 is the empty model.
    #[schema(value_type = u32)]
    version: VersionNumber,
    /// When it was made.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// Its scans, jobs, model and downloads.
    links: Vec<Link>,
}

/// A part of the list of projects.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ProjectList {
    /// Oldest first.
    items: Vec<ProjectBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl From<Project> for ProjectBody {
    fn from(p: Project) -> Self {
        let own = format!("/v1/projects/{}", p.id);
        let below = |rel: &str| Link::new(rel, format!("{own}/{rel}"));
        let mut links = vec![Link::new("self", own.clone())];
        links.extend(
            ["scans", "uploads", "jobs", "model", "versions", "poses", "cloud", "graph", "preview"]
                .map(below),
        );
        Self {
            id: p.id,
            name: p.name,
            seed: p.settings.seed.0,
            resolution: p.settings.resolution,
            scans: p.scans,
            version: p.head,
            created: p.created,
            links,
        }
    }
}

/// Makes a project.
#[utoipa::path(post, path = "/v1/projects", tag = "projects", request_body = NewProject, responses(
    (status = 201, description = "The project", body = ProjectBody, headers(("location" = String, description = "The project"))),
    (status = 413, description = "The body is too large", body = Problem, content_type = "application/problem+json"),
    (status = 415, description = "The body is not JSON", body = Problem, content_type = "application/problem+json"),
    Problems))]
pub(super) async fn create_project(
    State(api): State<Api>,
    once: Once,
    Body(new): Body<NewProject>,
) -> Result<Reply, Problem> {
    let name = Name::parse(&new.name).map_err(|e| Problem::invalid("name", e.to_string()))?;
    let settings = ProjectSettings { seed: Seed(new.seed), resolution: new.resolution };
    settings.validate().map_err(|e| {
        let field = match e {
            crate::project::BadSettings::Resolution(_) => "resolution",
            crate::project::BadSettings::Seed(_) => "seed",
        };
        Problem::invalid(field, e.to_string())
    })?;
    let answer = |project: &Project| {
        let location = format!("/v1/projects/{}", project.id);
        Reply::made(StatusCode::CREATED, location, &[]).json(&ProjectBody::from(project.clone()))
    };
    let project = api.store.create_project(&name, &settings, once.seal(answer)).await?;
    answer(&project)
}

/// Lists projects: those that the key reaches.
#[utoipa::path(get, path = "/v1/projects", tag = "projects", params(
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = ProjectList), Problems))]
pub(super) async fn list_projects(
    State(api): State<Api>,
    caller: Caller,
    mut query: Params,
) -> Result<Json<ProjectList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    let found = api.store.projects(page, caller.granted()).await?;
    let next = next(page, &found);
    Ok(Json(ProjectList { items: found.into_iter().map(|(_, p)| p.into()).collect(), next }))
}

/// Shows a project.
#[utoipa::path(get, path = "/v1/projects/{project}", tag = "projects",
    params(("project" = String, Path, description = "Id of the project")),
    responses((status = 200, description = "The project", body = ProjectBody), Problems))]
pub(super) async fn get_project(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
) -> Result<Json<ProjectBody>, Problem> {
    Ok(Json(api.store.project(project).await?.into()))
}

/// Deletes a project with its scans, jobs and versions.
#[utoipa::path(delete, path = "/v1/projects/{project}", tag = "projects",
    params(("project" = String, Path, description = "Id of the project")),
    responses((status = 204, description = "It is gone"), Problems))]
pub(super) async fn delete_project(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
) -> Result<StatusCode, Problem> {
    api.store.delete_project(project).await?;
    Ok(StatusCode::NO_CONTENT)
}
