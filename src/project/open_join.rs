//! What a version of a model leaves open, and what it took back: the engine's words in the ids that clients know.

use serde::{Deserialize, Serialize};

use super::{Reason, ScanId};
use crate::geometry::Pose;

/// Two pieces of a model that were not joined although something speaks for it. A waiting scan is a piece of one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenJoin {
    /// The scan that stands for the larger piece …
    pub scan_a: ScanId,
    /// … and for the smaller. A decision about these two decides the join.
    pub scan_b: ScanId,
    /// Scans in the larger piece.
    pub scans_a: usize,
    /// Scans in the smaller.
    pub scans_b: usize,
    /// Why it was not made.
    pub reason: Reason,
    /// The poses that were weighed, the best first.
    pub poses: Vec<RivalPose>,
}

/// One of the poses at which two pieces could be joined.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RivalPose {
    /// Maps points of scan b into scan a: metres, own frames of the scans.
    pub a_from_b: Pose,
    /// Support by edges: log-odds, summed.
    pub support: f64,
    /// Edges that agree on it.
    pub edges: usize,
    /// Share of the judged points that lie in free space at this pose, 0 to 1.
    pub violation: f64,
    /// Points of either piece on surfaces of the other.
    pub inliers: u32,
}

/// A placement that later scans contradicted, and that was taken back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Undone {
    /// The scans that were detached.
    pub scans: Vec<ScanId>,
    /// The loop that proved it: edges that each stand on their own but do not close; it begins and ends at one scan.
    pub evidence: Vec<ScanId>,
    /// How far the loop fails to close: radians. This and the distance are zero where no pair is for another place, but the ends of the
    /// path stand in each other's free space.
    pub angle: f64,
    /// How far the loop fails to close: metres.
    pub distance: f64,
    /// Support that the old place had.
    pub support_before: f64,
    /// Support that speaks for a different place.
    pub support_elsewhere: f64,
}
