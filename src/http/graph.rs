//! `/v1/projects/{p}/graph`: which scans hold which in place.

use axum::extract::State;
use axum::response::Response;
use serde::Serialize;
use utoipa::ToSchema;

use super::extract::Ids;
use super::model::{ComponentBody, components};
use super::open_join::{Names, OpenJoinBody, UndoneBody};
use super::problem::{Problem, Problems};
use super::query::Params;
use super::router::Api;
use crate::project::{Edge, ModelContent, ProjectId, ScanId, ScanState, Standing, VersionNumber};

/// A scan in the graph.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct NodeBody {
    /// The scan.
    #[schema(value_type = String)]
    scan: ScanId,
    /// registered, waiting or failed.
    #[schema(value_type = String)]
    state: ScanState,
    /// Its component, if it has one.
    component: Option<usize>,
    /// Verified edges to scans of its component.
    neighbours: usize,
}

/// A verified edge.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct EdgeBody {
    /// One scan.
    #[schema(value_type = String)]
    a: ScanId,
    /// The other.
    #[schema(value_type = String)]
    b: ScanId,
    /// Correspondences that agree with the edge's motion.
    inliers: usize,
    /// Overlap of the dense clouds under that motion, 0 to 1.
    overlap: f64,
    /// Log-odds that the motion is right.
    score: f64,
}

/// The scan graph of a version.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct GraphBody {
    /// The version.
    #[schema(value_type = u32)]
    version: VersionNumber,
    /// Every scan that the model knows, in order of arrival.
    nodes: Vec<NodeBody>,
    /// Verified edges.
    edges: Vec<EdgeBody>,
    /// Largest first.
    components: Vec<ComponentBody>,
    /// Joins that were not made although something speaks for them, the best supported first.
    open_joins: Vec<OpenJoinBody>,
    /// Placements that later scans contradicted, and that this version took back.
    undone: Vec<UndoneBody>,
}

/// Shows the scan graph.
#[utoipa::path(get, path = "/v1/projects/{project}/graph", tag = "model", params(
    ("project" = String, Path, description = "Id of the project"),
    ("version" = Option<u32>, Query, description = "Number of the version; the newest if absent")),
    responses((status = 200, description = "The graph", body = GraphBody), Problems))]
pub(super) async fn get_graph(
    State(api): State<Api>,
    Ids(project): Ids<ProjectId>,
    mut query: Params,
) -> Result<Response, Problem> {
    let version = query.version()?;
    query.finish()?;
    let reading = api.readings.read(&api.store, project, version).await?;
    let names = Names::needed(&api.store, project, &reading.content).await?;
    reading.json(move |version, content| GraphBody::new(version, content, &names)).await
}

impl GraphBody {
    fn new(version: VersionNumber, content: ModelContent, names: &Names) -> Self {
        let node = |(scan, standing): &(ScanId, Standing)| {
            let (state, place) = match standing {
                Standing::Registered(p) => (ScanState::Registered, Some(p)),
                Standing::Waiting(_) => (ScanState::Waiting, None),
                Standing::Failed(_) => (ScanState::Failed, None),
            };
            let neighbours = place.map_or(0, |p| p.neighbours);
            NodeBody { scan: *scan, state, component: place.map(|p| p.component), neighbours }
        };
        let edge =
            |e: &Edge| EdgeBody { a: e.a, b: e.b, inliers: e.inliers, overlap: e.overlap, score: e.score };
        Self {
            version,
            nodes: content.scans.iter().map(node).collect(),
            edges: content.edges.iter().map(edge).collect(),
            open_joins: names.open_joins(&content.open_joins),
            undone: names.undone(&content.undone),
            components: components(content.components),
        }
    }
}
