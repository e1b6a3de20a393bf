//! What the model leaves open and what it took back, by the names of files: for `report.json` and its summary.

use serde::Serialize;
use serde_json::{Map, Value};

use super::pipeline::Registration;
use super::poses::told;
use crate::cloud::ScanKey;
use crate::jobs::reason_of_refusal;
use crate::mapping::{OpenJoin, Undone};

/// Two pieces that were not joined although something speaks for it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct OpenJoinReport {
    /// Stands for the larger piece. A decision about these two decides the join.
    scan_a: String,
    /// Stands for the smaller.
    scan_b: String,
    /// Scans in the larger piece.
    scans_a: usize,
    scans_b: usize,
    /// Why it was not made: `reason` and the numbers behind it.
    refusal: Map<String, Value>,
    /// The best first.
    poses: Vec<RivalReport>,
}

/// A pose at which they could be joined.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct RivalReport {
    /// 4x4, row-major, metres, own frames of the scans.
    a_from_b: [[f64; 4]; 4],
    /// Log-odds, summed over edges.
    support: f64,
    edges: usize,
    /// Share of the judged points that lie in free space.
    violation: f64,
    inliers: u32,
}

/// A placement that was taken back.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct UndoneReport {
    scans: Vec<String>,
    /// The loop that does not close.
    evidence: Vec<String>,
    angle_deg: f64,
    /// Metres.
    distance: f64,
    support_before: f64,
    support_elsewhere: f64,
}

/// Everything that was left open, the best supported first.
pub(super) fn open_joins(registration: &Registration) -> Vec<OpenJoinReport> {
    let report = |open: &OpenJoin| {
        let reason = reason_of_refusal(&open.refusal);
        let mut refusal = reason.numbers;
        refusal.insert("reason".to_owned(), reason.reason.into());
        let pose = |pose: &crate::mapping::RivalPose| RivalReport {
            a_from_b: pose.a_from_b.to_rows(),
            support: pose.support,
            edges: pose.edges,
            violation: pose.violation,
            inliers: pose.inliers,
        };
        OpenJoinReport {
            scan_a: name(registration, open.a),
            scan_b: name(registration, open.b),
            scans_a: open.scans_a,
            scans_b: open.scans_b,
            refusal,
            poses: open.poses.iter().map(pose).collect(),
        }
    };
    registration.snapshot.open_joins.iter().map(report).collect()
}

/// Everything that was taken back.
pub(super) fn undone(registration: &Registration) -> Vec<UndoneReport> {
    let names = |keys: &[ScanKey]| keys.iter().map(|key| name(registration, *key)).collect();
    let report = |undone: &Undone| UndoneReport {
        scans: names(&undone.scans),
        evidence: names(&undone.evidence),
        angle_deg: undone.angle.to_degrees(),
        distance: undone.distance,
        support_before: undone.support_before,
        support_elsewhere: undone.support_elsewhere,
    };
    registration.snapshot.undone.iter().map(report).collect()
}

fn name(registration: &Registration, key: ScanKey) -> String {
    registration.scans.get(&key).and_then(|scan| scan.names.first()).cloned().unwrap_or_default()
}

impl OpenJoinReport {
    /// In a line for people.
    pub fn line(&self) -> String {
        let piece = |name: &str, scans: usize| match scans {
            0 | 1 => name.to_owned(),
            more => format!("{name} (with {} more)", more - 1),
        };
        let supports: Vec<String> = self.poses.iter().map(|pose| format!("{:.1}", pose.support)).collect();
        format!(
            "open: {} and {}: {}; poses of support {}",
            piece(&self.scan_a, self.scans_a),
            piece(&self.scan_b, self.scans_b),
            told(&self.refusal),
            supports.join(", ")
        )
    }
}

impl UndoneReport {
    /// In a line for people.
    pub fn line(&self) -> String {
        let path = self.evidence.join(" - ");
        let proof = if self.angle_deg > 0.0 || self.distance > 0.0 {
            format!("{path} does not close by {:.1} deg and {:.2} m", self.angle_deg, self.distance)
        } else {
            format!("{path} puts scans into each other's free space")
        };
        format!("taken back: {} scans, because {proof}", self.scans.len())
    }
}
