//! A version of a project's model in the ids that clients know.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{
    Decision, DecisionId, Fault, JobId, JobKind, OpenJoin, ProjectId, ScanId, Timestamp, Undone,
    VersionNumber,
};
use crate::geometry::Pose;

/// Where a scan stands in the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "status", rename_all = "kebab-case")]
pub enum Standing {
    /// In a component.
    Registered(Placement),
    /// In none, and why.
    Waiting(Reason),
    /// It cannot take part, and why.
    Failed(Fault),
}

/// Why a scan waits: a stable word and the numbers behind it, as the engine gave them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reason {
    /// Such as `no-verified-pair`.
    pub reason: String,
    /// Measured values and thresholds, by name.
    #[serde(flatten)]
    pub numbers: serde_json::Map<String, Value>,
}

/// A scan's place in a component.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// Index of the component; 0 is the largest.
    pub component: usize,
    /// Maps points of the scan's own frame (metres) into the component's model frame.
    pub model_from_scan: Pose,
    /// Landmarks that the scan observes.
    pub landmarks: usize,
    /// Scans of the component that overlap it in a verified edge.
    pub neighbours: usize,
    /// Root mean square distance between its keypoints and their landmarks, metres.
    pub landmark_rms: f64,
}

/// One rigid piece of the model. Frames of different components are unrelated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Component {
    /// Its scans, in order of arrival.
    pub scans: Vec<ScanId>,
    /// The scan at identity.
    pub gauge: ScanId,
    /// Landmarks with at least two observations.
    pub landmarks: usize,
    /// Observations of those landmarks.
    pub observations: usize,
    /// Root mean square distance between observations and landmarks, metres.
    pub landmark_rms: f64,
}

/// A verified edge of the scan graph.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Edge {
    /// The scan that arrived first.
    pub a: ScanId,
    /// The other scan.
    pub b: ScanId,
    /// Correspondences that agree with the edge's motion.
    pub inliers: usize,
    /// Overlap of the two dense clouds under the edge's motion, 0 to 1.
    pub overlap: f64,
    /// Log-odds that the motion is right, by the pair's own evidence and that of third scans.
    pub score: f64,
}

/// Everything that readers see of one version. Stored as a blob of JSON, never changed.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct ModelContent {
    /// Voxel size from which every length scale derives, metres; 0 for the empty model.
    pub resolution: f64,
    /// Largest first.
    pub components: Vec<Component>,
    /// Every scan that the model knows, in order of arrival.
    pub scans: Vec<(ScanId, Standing)>,
    /// Verified edges between scans of the model.
    pub edges: Vec<Edge>,
    /// Joins that were not made although something speaks for them, the best supported first. Programs before 0.1 wrote none.
    #[serde(default)]
    pub open_joins: Vec<OpenJoin>,
    /// Placements that later scans contradicted, and that this version took back.
    #[serde(default)]
    pub undone: Vec<Undone>,
    /// What clients had decided, and this version obeys, in the order it was decided.
    #[serde(default)]
    pub decisions: Vec<(DecisionId, Decision)>,
}

impl ModelContent {
    /// Scans with a place, in order of arrival; of one component if asked for.
    pub fn placed(&self, component: Option<usize>) -> impl Iterator<Item = (ScanId, &Placement)> {
        self.scans.iter().filter_map(move |(scan, standing)| match standing {
            Standing::Registered(p) if component.is_none_or(|c| c == p.component) => Some((*scan, p)),
            _ => None,
        })
    }

    /// Where a scan stands; `None` if the version does not know it.
    #[must_use]
    pub fn standing(&self, scan: ScanId) -> Option<&Standing> {
        self.scans.iter().find(|(id, _)| *id == scan).map(|(_, standing)| standing)
    }
}

/// The row of a version.
#[derive(Debug, Clone, PartialEq)]
pub struct Version {
    /// The project.
    pub project: ProjectId,
    /// Its number.
    pub number: VersionNumber,
    /// The job that published it.
    pub job: JobId,
    /// What that job did.
    pub kind: JobKind,
    /// Hash of the blob with the engine's snapshot.
    pub snapshot: String,
    /// Hash of the blob with the [`ModelContent`].
    pub content: String,
    /// Voxel size, metres.
    pub resolution: f64,
    /// Number of components.
    pub components: u64,
    /// Scans in a component.
    pub registered: u64,
    /// Scans in none.
    pub waiting: u64,
    /// When it was published.
    pub created: Timestamp,
}
