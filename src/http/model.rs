//! `/v1/projects/{p}/model` and `/versions`: what a version of the model is made of.

use axum::Json;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::download::none_match;
use super::extract::Ids;
use super::link::Link;
use super::open_join::{Names, OpenJoinBody, UndoneBody};
use super::problem::{Problem, Problems};
use super::query::{Params, cursor};
use super::reading::Reading;
use super::router::Api;
use super::scan::standing_body;
use crate::project::{
    Component, DecisionId, JobId, JobKind, ModelContent, ProjectId, ScanId, Timestamp, Version, VersionNumber,
};

/// One rigid piece of a model. Frames of different components are unrelated.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ComponentBody {
    /// Its index; 0 is the largest.
    index: usize,
    /// Its scans, in order of arrival.
    #[schema(value_type = Vec<String>)]
    scans: Vec<ScanId>,
    /// The scan at identity.
    #[schema(value_type = String)]
    gauge: ScanId,
    /// Landmarks with at least two observations.
    landmarks: usize,
    /// Observations of those landmarks.
    observations: usize,
    /// Root mean square distance between observations and landmarks, metres.
    landmark_rms: f64,
}

/// Where one scan stands in a version.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct StandingBody {
    /// The scan.
    #[schema(value_type = String)]
    scan: ScanId,
    /// `status` registered (with `component`, `model_from_scan` and quality) or waiting (with the `reason`).
    #[schema(value_type = Object)]
    outcome: Value,
}

/// A version of a model.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ModelBody {
    /// The project.
    #[schema(value_type = String)]
    project: ProjectId,
    /// Its number; 0 is the empty model before the first.
    #[schema(value_type = u32)]
    version: VersionNumber,
    /// Voxel size from which every length scale derives, metres.
    resolution: f64,
    /// Largest first.
    components: Vec<ComponentBody>,
    /// Every scan that the model knows, in order of arrival.
    scans: Vec<StandingBody>,
    /// Joins that were not made although something speaks for them, the best supported first.
    open_joins: Vec<OpenJoinBody>,
    /// Placements that later scans contradicted, and that this version took back.
    undone: Vec<UndoneBody>,
    /// The decisions that this version obeys; one that is taken back later stays here.
    #[schema(value_type = Vec<String>)]
    decisions: Vec<DecisionId>,
    /// Poses, cloud, graph and picture of this very version.
    links: Vec<Link>,
}

/// A version in the list.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct VersionBody {
    /// Its number.
    #[schema(value_type = u32)]
    version: VersionNumber,
    /// The job that published it.
    #[schema(value_type = String)]
    job: JobId,
    /// What that job did.
    #[schema(value_type = String)]
    kind: JobKind,
    /// Voxel size, metres.
    resolution: f64,
    /// Number of components.
    components: u64,
    /// Scans in a component.
    registered: u64,
    /// Scans in none.
    waiting: u64,
    /// When it was published.
    #[schema(value_type = String, format = DateTime)]
    created: Timestamp,
    /// The version in full.
    links: Vec<Link>,
}

/// A part of the list of versions.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct VersionList {
    /// Oldest first.
    items: Vec<VersionBody>,
    /// The `cursor` of the next part, if there is one.
    next: Option<String>,
}

impl ModelBody {
    fn new(project: ProjectId, version: VersionNumber, content: ModelContent, names: &Names) -> Self {
        let own = format!("/v1/projects/{project}");
        let mut links = vec![Link::new("self", format!("{own}/versions/{version}"))];
        let exports = ["poses", "cloud", "graph", "preview"];
        links.extend(exports.map(|rel| Link::new(rel, format!("{own}/{rel}?version={version}"))));
        Self {
            project,
            version,
            resolution: content.resolution,
            components: components(content.components),
            scans: content
                .scans
                .iter()
                .map(|(scan, standing)| StandingBody { scan: *scan, outcome: standing_body(standing) })
                .collect(),
            open_joins: names.open_joins(&content.open_joins),
            undone: names.undone(&content.undone),
            decisions: content.decisions.iter().map(|(id, _)| *id).collect(),
            links,
        }
    }
}

/// Components with their indices.
pub(super) fn components(components: Vec<Component>) -> Vec<ComponentBody> {
    let body = |(index, c): (usize, Component)| ComponentBody {
        index,
        scans: c.scans,
        gauge: c.gauge,
        landmarks: c.landmarks,
        observations: c.observations,
        landmark_rms: c.landmark_rms,
    };
    components.into_iter().enumerate().map(body).collect()
}

impl From<Version> for VersionBody {
    fn from(v: Version) -> Self {
        Self {
            version: v.number,
            job: v.job,
            kind: v.kind,
            resolution: v.resolution,
            components: v.components,
            registered: v.registered,
            waiting: v.waiting,
            created: v.created,
            links: vec![Link::new("self", format!("/v1/projects/{}/versions/{}", v.project, v.number))],
        }
    }
}

/// Shows the newest version of a model.
#[utoipa::path(get, path = "/v1/projects/{project}/model", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("if-none-match" = Option<String>, Header, description = "The ETag of an earlier answer")), responses(
    (status = 200, description = "The model", body = ModelBody, headers(("etag" = String, description = "Changes with the version"))),
    (status = 304, description = "The version is the one of the earlier answer"), Problems))]
pub(super) async fn get_model(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let tag = |version| format!("\"{project}-{version}\"");
    // Most who ask again have it, and for them it need not be read.
    let head = api.store.project(project).await?.head;
    let (mut response, tag) = if none_match(&headers, &tag(head)) {
        (StatusCode::NOT_MODIFIED.into_response(), tag(head))
    } else {
        let reading = api.readings.read(&api.store, project, None).await?;
        let tag = tag(reading.version);
        (model(&api, project, reading).await?, tag)
    };
    response.headers_mut().insert(header::ETAG, HeaderValue::from_str(&tag).map_err(Problem::internal)?);
    Ok(response)
}

/// Lists the versions of a model.
#[utoipa::path(get, path = "/v1/projects/{project}/versions", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("cursor" = Option<String>, Query, description = "The `next` of an earlier answer", pattern = "^[0-9a-f]{1,15}$"),
    ("limit" = Option<u32>, Query, description = "At most so many items, 1 to 200; 50 if absent", minimum = 1, maximum = 200)),
    responses((status = 200, description = "A part of the list", body = VersionList), Problems))]
pub(super) async fn list_versions(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Json<VersionList>, Problem> {
    let page = query.page()?;
    query.finish()?;
    api.store.project(project).await?;
    let found = api.store.versions(project, page).await?;
    let full = found.len() == page.limit as usize;
    let next = found.last().filter(|_| full).map(|v| cursor(v.number.0.into()));
    Ok(Json(VersionList { items: found.into_iter().map(VersionBody::from).collect(), next }))
}

/// Shows one version of a model. It never changes.
#[utoipa::path(get, path = "/v1/projects/{project}/versions/{version}", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("version" = u32, Path, description = "Number of the version")),
    responses((status = 200, description = "The version", body = ModelBody), Problems))]
pub(super) async fn get_version(
    State(api): State<Api>,
    Ids((project, version)): Ids<(ProjectId, u32)>,
) -> Result<Response, Problem> {
    let reading = api.readings.read(&api.store, project, Some(VersionNumber(version))).await?;
    model(&api, project, reading).await
}

/// The answer that shows a version.
async fn model(api: &Api, project: ProjectId, reading: Reading) -> Result<Response, Problem> {
    let names = Names::needed(&api.store, project, &reading.content).await?;
    reading.json(move |version, content| ModelBody::new(project, version, content, &names)).await
}
