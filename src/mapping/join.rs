//! One join: a scan into a component, or a component into another. From the candidate pose through a fit to pooled matches and
//! a dense alignment to the verdict on everything that overlaps.

use serde::{Deserialize, Serialize};

use nalgebra::Vector3;

use super::candidates::{Candidate, near, support_of};
use super::component::Component;
use super::options::{JoinLevel, MappingOptions};
use super::surfaces::{align, judge};
use crate::geometry::{Kernel, Pose, rigid_fit};
use crate::graph::ScanGraph;
use crate::pairwise::inlier_matches;

const FIT_ITERATIONS: usize = 5;

/// Why a join was not made.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Refusal {
    /// Too little support, rivals aside.
    Support {
        /// What there is.
        found: f64,
        /// What the level asks.
        needed: f64,
    },
    /// A different pose is about as well supported.
    Rival {
        /// Support of the candidate.
        support: f64,
        /// Support of the rival.
        rival: f64,
    },
    /// Too many pairs speak against where the scan was: alike places were taken for one.
    Contradicted {
        /// Pairs that are sure of another pose.
        against: usize,
        /// Pairs that were sure of this one.
        agreeing: usize,
    },
    /// Surfaces in free space.
    Violation {
        /// Share of the judged points.
        found: f64,
        /// What the level allows.
        allowed: f64,
    },
}

/// Checks a candidate's support against a level.
pub fn check_support(
    candidate: &Candidate,
    level: &JoinLevel,
    options: &MappingOptions,
) -> Result<(), Refusal> {
    if candidate.support < level.support {
        return Err(Refusal::Support { found: candidate.support, needed: level.support });
    }
    if candidate.margin(options) < level.support {
        return Err(Refusal::Rival { support: candidate.support, rival: candidate.rival });
    }
    Ok(())
}

/// Refines and verifies a candidate. Returns `a_from_b`.
pub fn verify_join(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    candidate: &Candidate,
    level: &JoinLevel,
    voxel: f64,
    options: &MappingOptions,
) -> Result<Pose, Refusal> {
    let pooled = pooled_fit(graph, a, b, candidate, voxel);
    let aligned = align(graph, a, b, &pooled, voxel);
    if candidate.decided {
        let agrees = candidate.members.iter().all(|m| near(&aligned, m, voxel, options));
        return Ok(if agrees { aligned } else { candidate.a_from_b });
    }
    // The alignment must stay at the pose that the edges voted for.
    let kept = support_of(graph, a, b, &aligned, voxel, options);
    if kept < level.support {
        return Err(Refusal::Support { found: kept, needed: level.support });
    }
    let counts = judge(graph, a, b, &aligned);
    let found = counts.violation_share();
    if found > level.violation {
        return Err(Refusal::Violation { found, allowed: level.violation });
    }
    Ok(aligned)
}

/// Pools the matches of all edges in the cluster, against landmarks where there are tracks and against the neighbours' keypoints
/// elsewhere, and fits one rigid motion by reweighted least squares from the cluster's centre.
#[must_use]
pub fn pooled_fit(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    candidate: &Candidate,
    voxel: f64,
) -> Pose {
    let mut pooled: Vec<(Vector3<f64>, Vector3<f64>)> = Vec::new();
    for member in &candidate.members {
        let (Some(x), Some(y), Some(edge)) =
            (graph.scan(member.in_a), graph.scan(member.in_b), graph.edge(member.in_a, member.in_b))
        else {
            continue;
        };
        let (Some(a_from_x), Some(b_from_y)) = (a.poses.get(&member.in_a), b.poses.get(&member.in_b)) else {
            continue;
        };
        let forward = edge.pair.a == member.in_a;
        let (first, second) = if forward { (x, y) } else { (y, x) };
        let motion = if forward { member.in_a_from_in_b } else { member.in_a_from_in_b.inverse() };
        for (in_first, in_second) in inlier_matches(first, second, &edge.matches, &motion) {
            let (in_x, in_y) = if forward { (in_first, in_second) } else { (in_second, in_first) };
            let target = match a.tracks.landmark_of((member.in_a, in_x)) {
                Some(landmark) => landmark.position,
                None => a_from_x.transform(&x.keypoint(in_x as usize)),
            };
            pooled.push((b_from_y.transform(&y.keypoint(in_y as usize)), target));
        }
    }
    let kernel = Kernel::GemanMcClure(2.0 * voxel);
    let mut pose = candidate.a_from_b;
    for _ in 0..FIT_ITERATIONS {
        let weighted = pooled
            .iter()
            .map(|(from, to)| (*from, *to, kernel.weight((pose.transform(from) - to).norm_squared())));
        match rigid_fit(weighted) {
            Some(fitted) => pose = fitted,
            None => return candidate.a_from_b,
        }
    }
    pose
}
