//! Joining two pieces that are each a little bent: the last resort where no rigid motion fits. Used by `mapper`.

use super::candidates::{Candidate, support_of};
use super::component::Component;
use super::consistency::thrown;
use super::gravity::Gravity;
use super::join::{SINGLE_STARTS, pooled_fit};
use super::options::{JoinLevel, MappingOptions};
use super::refine::{Reach, dense, pose_graph};
use super::surfaces::{align, judge};
use super::violation::{ViolationLimit, violation_of};
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// What was bent may violate free space this many times as much as a straight join. Wrong joins do so more than twice as much.
const LENIENCE: f64 = 1.5;
/// Dense adjustments, each of the pairs that overlap as the one before left them.
const DENSE_ROUNDS: usize = 2;

/// A join of two components that are each a little bent, so that no rigid motion fits all that they share: they are joined on
/// trial, adjusted together, and judged as they then stand, or as they stood before. `None` when that does not help, or when another pose is nearly as well supported.
pub fn bent_join(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidate: &Candidate,
    level: &JoinLevel,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<Component>, Cancelled> {
    if candidate.margin(options) < level.support {
        return Ok(None);
    }
    let limit = ViolationLimit::new(graph, (a, b), level, options);
    let several = options.asks_for_several(a.len(), b.len(), level);
    let fits = |joined: &Component| {
        let part = |of: &Component| {
            let mut part = of.clone();
            part.poses.retain(|key, pose| joined.poses.get(key).map(|moved| *pose = *moved).is_some());
            part
        };
        let (x, y) = (part(a), part(b));
        let still = Pose::identity();
        let kept = support_of(graph, &x, &y, &still, voxel, options);
        kept.support >= level.support
            && (kept.edges > 1 || !several)
            && !options.decisions.forbids(graph, &x, &y, &still, options)
            && Gravity::between(graph, &x, &y).is_none_or(|gravity| gravity.admits(&still))
            && violation_of(&judge(graph, &x, &y, &still)) <= LENIENCE * limit.share(candidate.support)
    };
    let mut joined = a.clone();
    joined.absorb(b.clone(), &clearest_start(graph, (a, b), candidate, voxel), graph, options);
    let before = joined.clone();
    // Adjustment straightens what is bent, but where it is bent more than surfaces reach it can pull them past each other; so the start counts too.
    let mut fitting = fits(&joined).then(|| joined.clone());
    pose_graph(graph, &mut joined, Reach::FAR, voxel, options, control)?;
    for _ in 0..DENSE_ROUNDS {
        dense(graph, &mut joined, None, Reach::FAR, voxel, control)?;
    }
    if !thrown(graph, &before, &joined, options).is_empty() {
        return Ok(None);
    }
    if fits(&joined) {
        fitting = Some(joined);
    }
    Ok(fitting)
}

/// Of the fit to all edges and the poses of single edges, as they are and aligned, the one that is most clear of free space. The fit lies where the adjustment
/// cannot return from when the edges differ by more than they are wide.
fn clearest_start(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidate: &Candidate,
    voxel: f64,
) -> Pose {
    let violation = |pose: &Pose| violation_of(&judge(graph, a, b, pose));
    let fit = pooled_fit(graph, a, b, candidate, voxel);
    let single = candidate.members.iter().take(SINGLE_STARTS).map(|member| member.a_from_b);
    let aligned = |start: Pose| [start, align(graph, a, b, &start, voxel)];
    let mut best = (violation(&fit), fit);
    for pose in aligned(fit).into_iter().skip(1).chain(single.flat_map(aligned)) {
        let found = violation(&pose);
        if found < best.0 {
            best = (found, pose);
        }
    }
    best.1
}
