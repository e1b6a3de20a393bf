//! What a version leaves open and what it took back, as `model`, `versions` and `graph` show it.

use std::collections::HashMap;

use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::problem::Problem;
use crate::project::{ModelContent, OpenJoin, ProjectId, RivalPose, ScanId, Undone};
use crate::storage::Store;

/// A scan, by id and name.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct NamedScan {
    /// Its id.
    #[schema(value_type = String)]
    id: ScanId,
    /// What the client called it.
    name: String,
}

/// Two pieces of the model that were not joined although something speaks for it; a waiting scan is a piece of one. A decision about
/// the two scans, or a scan that tells the poses apart, settles it.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct OpenJoinBody {
    /// The scan that stands for the larger piece.
    scan_a: NamedScan,
    /// The scan that stands for the smaller piece.
    scan_b: NamedScan,
    /// Scans in the larger piece.
    scans_a: usize,
    /// Scans in the smaller piece.
    scans_b: usize,
    /// Why it was not made: `reason`, a stable word (ambiguous, contradicted, violates-free-space, too-little-support, single-pair, indistinct,
    /// forbidden), and the numbers behind it.
    #[schema(value_type = Object)]
    refusal: Value,
    /// The poses that were weighed, the best first. A decision may name one by its index.
    poses: Vec<RivalPoseBody>,
}

/// One of the poses at which two pieces could be joined.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct RivalPoseBody {
    /// Maps points of scan b into scan a: 4x4, row-major, metres, own frames of the scans.
    #[schema(value_type = Vec<Vec<f64>>)]
    a_from_b: [[f64; 4]; 4],
    /// Support by edges: log-odds, summed.
    support: f64,
    /// Edges that agree on it.
    edges: usize,
    /// Share of the judged points that lie in free space at this pose, 0 to 1.
    violation: f64,
    /// Points of either piece on surfaces of the other.
    inliers: u32,
}

/// A placement that later scans contradicted, and that this version took back.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct UndoneBody {
    /// The scans that were detached.
    scans: Vec<NamedScan>,
    /// The loop that proved it: edges that each stand on their own but do not close; it begins and ends at one scan.
    evidence: Vec<NamedScan>,
    /// How far the loop fails to close, degrees. This and the distance are zero where no pair is for another place, but the ends of the
    /// path stand in each other's free space.
    angle_deg: f64,
    /// How far the loop fails to close, metres.
    distance: f64,
    /// Support that the old place had.
    support_before: f64,
    /// Support that speaks for a different place.
    support_elsewhere: f64,
}

/// Names of scans.
#[derive(Debug, Default)]
pub(super) struct Names(HashMap<ScanId, String>);

impl Names {
    /// Names of a project's scans, deleted ones included, if a version has anything to say that needs them.
    pub async fn needed(store: &Store, project: ProjectId, content: &ModelContent) -> Result<Self, Problem> {
        if content.open_joins.is_empty() && content.undone.is_empty() {
            return Ok(Self::default());
        }
        let scans = store.names_ever(project).await?;
        Ok(Self(scans.into_iter().map(|(scan, name)| (scan, name.to_string())).collect()))
    }

    fn of(&self, id: ScanId) -> NamedScan {
        NamedScan { id, name: self.0.get(&id).cloned().unwrap_or_default() }
    }

    /// Open joins for clients.
    pub fn open_joins(&self, open_joins: &[OpenJoin]) -> Vec<OpenJoinBody> {
        let body = |open: &OpenJoin| {
            let mut refusal = open.reason.numbers.clone();
            refusal.insert("reason".to_owned(), open.reason.reason.clone().into());
            OpenJoinBody {
                scan_a: self.of(open.scan_a),
                scan_b: self.of(open.scan_b),
                scans_a: open.scans_a,
                scans_b: open.scans_b,
                refusal: Value::Object(refusal),
                poses: open.poses.iter().map(RivalPoseBody::from).collect(),
            }
        };
        open_joins.iter().map(body).collect()
    }

    /// What was taken back, for clients.
    pub fn undone(&self, undone: &[Undone]) -> Vec<UndoneBody> {
        let named = |ids: &[ScanId]| ids.iter().map(|id| self.of(*id)).collect();
        let body = |u: &Undone| UndoneBody {
            scans: named(&u.scans),
            evidence: named(&u.evidence),
            angle_deg: u.angle.to_degrees(),
            distance: u.distance,
            support_before: u.support_before,
            support_elsewhere: u.support_elsewhere,
        };
        undone.iter().map(body).collect()
    }
}

impl From<&RivalPose> for RivalPoseBody {
    fn from(pose: &RivalPose) -> Self {
        Self {
            a_from_b: pose.a_from_b.to_rows(),
            support: pose.support,
            edges: pose.edges,
            violation: pose.violation,
            inliers: pose.inliers,
        }
    }
}
