//! Joins that were not made although something speaks for them: what a client may decide, or what one more scan may settle.

use serde::{Deserialize, Serialize};

use super::candidates::{Candidate, candidates};
use super::component::Component;
use super::decision::between_own_frames;
use super::join::{Refusal, pooled_fit};
use super::mapper::{LARGE_PIECE, Mapper};
use super::options::MappingOptions;
use super::surfaces::{align, judge};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// Poses listed for one open join.
const POSES: usize = 4;
/// Open joins listed for a model.
const LISTED: usize = 40;
/// A join with less support than this share of what a join needs is not worth a person's time.
const WORTH_SHARE: f64 = 0.5;
/// A pose that weighs less than this share of the heaviest is not offered beside it.
const WORTH_NAMING: f64 = 0.02;

/// One of the poses at which two pieces could be joined.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RivalPose {
    /// Maps points of scan b into scan a: metres, own frames of the two scans that stand for the pieces.
    pub a_from_b: Pose,
    /// Support by edges: log-odds, summed.
    pub support: f64,
    /// Edges that agree on it.
    pub edges: usize,
    /// Share of the judged points that lie in free space at this pose.
    pub violation: f64,
    /// Points of either piece on surfaces of the other.
    pub inliers: u32,
}

/// Two pieces that were not joined.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OpenJoin {
    /// A scan of the larger piece …
    pub a: ScanKey,
    /// … and one of the smaller: the ends of the strongest edge. A decision about these two decides the join.
    pub b: ScanKey,
    /// Scans in the larger piece.
    pub scans_a: usize,
    /// Scans in the smaller.
    pub scans_b: usize,
    /// Why it was not made.
    pub refusal: Refusal,
    /// The poses that were weighed, the best first.
    pub poses: Vec<RivalPose>,
}

/// A placement that later evidence contradicted, and that was taken back.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Undone {
    /// The scans that were detached, ascending.
    pub scans: Vec<ScanKey>,
    /// The loop that proved it: scans along edges that each stand on their own but do not close, beginning and ending at one scan.
    pub evidence: Vec<ScanKey>,
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

/// Lists what could be joined but was not: between components, and between components or waiting scans and waiting scans.
pub fn open_joins(
    graph: &ScanGraph,
    mapper: &Mapper,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Vec<OpenJoin>, Cancelled> {
    let Some(last) = options.levels.last() else { return Ok(Vec::new()) };
    let Mapper { components, waiting, .. } = mapper;
    let singles: Vec<Component> = waiting.keys().map(|key| Component::single(*key)).collect();
    let pieces: Vec<&Component> = components.iter().chain(&singles).collect();
    let mut found: Vec<(f64, usize, usize, Vec<Candidate>)> = Vec::new();
    for i in 0..pieces.len() {
        control.check()?;
        for j in i + 1..pieces.len() {
            let poses = candidates(graph, pieces[i], pieces[j], voxel, options, POSES);
            let weight = poses.first().map_or(0.0, |best| best.support.max(best.rival));
            if weight >= WORTH_SHARE * last.support {
                found.push((weight, i, j, poses));
            }
        }
    }
    found.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    found.truncate(LISTED);
    let mut listed = Vec::with_capacity(found.len());
    for (_, i, j, poses) in found {
        control.check()?;
        let (a, b) = (pieces[i], pieces[j]);
        let Some((best, member)) = poses.first().and_then(|best| Some((best, best.members.first()?))) else {
            continue;
        };
        let word = |candidate: &Candidate| candidate.support.max(candidate.doubt);
        let least = WORTH_NAMING * poses.iter().map(word).fold(0.0, f64::max);
        let mut weighed: Vec<RivalPose> = Vec::with_capacity(poses.len());
        let mut violation = 0.0;
        for (rank, candidate) in poses.iter().enumerate() {
            if rank > 0 && word(candidate) < least {
                continue;
            }
            let a_from_b = align(graph, a, b, &pooled_fit(graph, a, b, candidate, voxel), voxel);
            let counts = judge(graph, a, b, &a_from_b);
            if rank == 0 {
                violation = counts.violation_share();
            }
            let (Some(a_from_x), Some(b_from_y)) = (a.poses.get(&member.in_a), b.poses.get(&member.in_b))
            else {
                continue;
            };
            let local = a_from_x.inverse() * a_from_b * *b_from_y;
            let Some(a_from_b) = between_own_frames(graph, member.in_a, member.in_b, &local) else {
                continue;
            };
            weighed.push(RivalPose {
                a_from_b,
                support: candidate.support,
                edges: candidate.members.len(),
                violation: counts.violation_share(),
                inliers: counts.inliers,
            });
        }
        let contradicted = [a, b].iter().filter(|c| c.len() == 1).find_map(|c| match waiting.get(&c.gauge) {
            Some(Some(refusal @ Refusal::Contradicted { .. })) => Some(*refusal),
            _ => None,
        });
        let refusal = contradicted.or_else(|| mapper.refusal_between(a, b)).unwrap_or_else(|| {
            let large = a.len().min(b.len()) >= LARGE_PIECE;
            let needed = if large { last.support.max(options.least_large_support) } else { last.support };
            if best.decided {
                Refusal::Forbidden
            } else if best.support < needed {
                Refusal::Support { found: best.support, needed }
            } else if options.asks_for_several(a.len(), b.len(), last) && !best.rests_on_several() {
                Refusal::SinglePair { support: best.support }
            } else if best.margin(options) < needed {
                Refusal::Rival { support: best.support, rival: best.rival }
            } else if violation <= last.violation {
                // They were joined, and parted as one scan alone sees little of the other piece.
                Refusal::SinglePair { support: best.support }
            } else {
                Refusal::Violation { found: violation, allowed: last.violation }
            }
        });
        listed.push(OpenJoin {
            a: member.in_a,
            b: member.in_b,
            scans_a: a.len(),
            scans_b: b.len(),
            refusal,
            poses: weighed,
        });
    }
    Ok(listed)
}
