//! Joining pieces that are a little bent: the last resort where no rigid motion fits. Used by `mapper`.

use super::candidates::{Candidate, LEAST_WORD, support_of};
use super::close_look::FEW;
use super::component::Component;
use super::consistency::thrown;
use super::gravity::Gravity;
use super::join::{Refusal, SINGLE_STARTS, pooled_fit, weigh_join};
use super::options::{JoinLevel, MappingOptions};
use super::refine::{Reach, dense, pose_graph};
use super::surfaces::{align, judge};
use super::violation::{ViolationLimit, violation_of};
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// What was bent may violate free space this many times as much as a straight join. Wrong joins do so more than twice as much.
const LENIENCE: f64 = 1.5;
/// Where straightening made pairs agree that had it elsewhere, it may this many times as much: what agrees around a loop does not by chance …
const LENIENCE_AROUND_LOOP: f64 = 2.0;
/// … if they add as much support as this.
const AROUND_LOOP: f64 = 2.5;
/// A scan can show that a component is bent with the support of so many firm pairs, those with a voice of their own; pieces of several scans can with less.
const SURE_OF_SCAN: f64 = 4.0;
/// Dense adjustments, each of the pairs that overlap as the one before left them.
const DENSE_ROUNDS: usize = 2;

/// How two components can be one.
pub enum Joined {
    /// As they are: `a_from_b`.
    Rigid(Pose),
    /// Straightened together.
    Bent(Component),
}

/// Weighs a join as [`weigh_join`] does. Where only free space speaks against what more than a few pairs say, one or both are taken for bent.
pub fn weigh_even_bent(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidates: &[Candidate],
    level: &JoinLevel,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Result<Joined, Refusal>, Cancelled> {
    let refusal = match weigh_join(graph, (a, b), candidates, level, voxel, options, control)? {
        Ok(a_from_b) => return Ok(Ok(Joined::Rigid(a_from_b))),
        Err(refusal) => refusal,
    };
    if let (Refusal::Violation { .. }, Some(best)) = (refusal, candidates.first())
        && best.members.iter().filter(|member| member.evidence > LEAST_WORD).count() > FEW
        && (a.len().min(b.len()) > 1 || best.own_support() >= SURE_OF_SCAN * options.firm_support)
        && let Some(joined) = bent_join(graph, (a, b), best, level, voxel, options, control)?
    {
        return Ok(Ok(Joined::Bent(joined)));
    }
    Ok(Err(refusal))
}

/// A join of two components that are each a little bent, so that no rigid motion fits all that they share: they are joined on
/// trial, adjusted together, and judged as they then stand, or as they stood before. `None` when that does not help, or when another pose is nearly as well supported.
fn bent_join(
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
    let start = clearest_start(graph, (a, b), candidate, voxel);
    let before = support_of(graph, a, b, &start, voxel, options).support;
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
        let lenience = lenience(before, kept.support);
        kept.support >= level.support
            && (kept.edges > 1 || !several)
            && !options.decisions.forbids(graph, &x, &y, &still, options)
            && Gravity::between(graph, &x, &y).is_none_or(|gravity| gravity.admits(&still))
            && violation_of(&judge(graph, &x, &y, &still)) <= lenience * limit.share(candidate.support)
    };
    let mut joined = a.clone();
    joined.absorb(b.clone(), &start, graph, options);
    let unadjusted = joined.clone();
    // Adjustment straightens what is bent, but where it is bent more than surfaces reach it can pull them past each other; so the start counts too.
    let mut fitting = fits(&joined).then(|| joined.clone());
    pose_graph(graph, &mut joined, Reach::FAR, voxel, options, control)?;
    for _ in 0..DENSE_ROUNDS {
        dense(graph, &mut joined, None, Reach::FAR, voxel, control)?;
    }
    if !thrown(graph, &unadjusted, &joined, options).is_empty() {
        return Ok(None);
    }
    if fits(&joined) {
        fitting = Some(joined);
    }
    Ok(fitting)
}

/// How much more than a straight join one may violate that had this support before it was straightened, and has this after.
fn lenience(before: f64, after: f64) -> f64 {
    if after - before >= AROUND_LOOP { LENIENCE_AROUND_LOOP } else { LENIENCE }
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

#[cfg(test)]
mod tests {
    use nalgebra::{Vector3, Vector6};

    use super::*;
    use crate::cloud::ScanKey;
    use crate::control::{CancelToken, Silent};
    use crate::graph::SupportOptions;
    use crate::mapping::candidates::{CLUSTERS, candidates};
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Evidence, Hypothesis, PairKey, PairResult};

    const STATIONS: u128 = 8;

    /// What joining these last scans to the others comes to, where those from the fifth on are turned about the middle of all by this many degrees, and
    /// pairs are sure of the truth that are said to speak.
    fn joined(
        model: &Model,
        turned_deg: f64,
        last: &[u128],
        speaks: impl Fn(u128, u128) -> bool,
    ) -> Result<Joined, Refusal> {
        // Bent components do not allow what they show themselves.
        let options = MappingOptions { violation_contrast: 0.0, ..MappingOptions::default() };
        let mut rest = model.component.clone();
        let mut piece = Component::single(ScanKey(last[0]));
        for scan in last {
            let pose = rest.poses[&ScanKey(last[0])].inverse() * rest.poses[&ScanKey(*scan)];
            piece.poses.insert(ScanKey(*scan), pose);
        }
        for scan in last {
            rest.remove(ScanKey(*scan), &options);
        }
        let sum = rest.poses.values().map(|pose| pose.translation).sum::<Vector3<f64>>();
        let middle = sum / rest.len() as f64;
        let turn = Pose::from_translation(middle)
            * Pose::from_twist(&Vector6::new(0.0, 0.0, turned_deg.to_radians(), 0.0, 0.0, 0.0))
            * Pose::from_translation(-middle);
        for (_, pose) in rest.poses.iter_mut().filter(|(scan, _)| **scan > ScanKey(4)) {
            *pose = turn * *pose;
        }
        let mut graph = model.coarse();
        let pairs = rest.poses.keys().flat_map(|a| last.iter().map(move |b| (a.0, *b)));
        let unsure = pairs.filter(|(a, b)| !speaks(*a, *b)).map(|(a, b)| PairResult {
            pair: PairKey::of(ScanKey(a), ScanKey(b)),
            matches: Vec::new(),
            hypotheses: vec![Hypothesis {
                a_from_b: model.contradiction((a, b), true).a_from_b,
                evidence: Evidence::default(),
                logit: -9.0,
            }],
        });
        graph.add_results(unsure, &SupportOptions::default());
        let voxel = model.hall.resolution;
        let found = candidates(&graph, &rest, &piece, voxel, &options, CLUSTERS);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let level = &options.levels[1];
        weigh_even_bent(&graph, (&rest, &piece), &found, level, voxel, &options, control)
            .expect("nobody cancels")
    }

    /// The most that any scan lies off, metres, seen from the first.
    fn most_off(model: &Model, joined: &Component) -> f64 {
        let from_first =
            |poses: &Component, scan: &ScanKey| poses.poses[&ScanKey(1)].inverse() * poses.poses[scan];
        let off = |scan| {
            (from_first(joined, scan).translation - from_first(&model.component, scan).translation).norm()
        };
        joined.poses.keys().map(off).fold(0.0, f64::max)
    }

    #[test]
    fn what_is_straight_is_joined_as_it_is() {
        let model = Model::new(STATIONS as usize);
        assert!(matches!(joined(&model, 0.0, &[8], |_, _| true), Ok(Joined::Rigid(_))));
    }

    #[test]
    fn a_scan_that_many_pairs_place_straightens_a_bent_component_and_one_that_few_place_does_not() {
        let model = Model::new(STATIONS as usize);
        let Ok(Joined::Bent(straight)) = joined(&model, 10.0, &[8], |_, _| true) else {
            panic!("four pairs of the half that is not turned place the scan")
        };
        assert_eq!(straight.len(), model.component.len());
        let off = most_off(&model, &straight);
        assert!(off < model.hall.resolution, "{off} m");
        let few = joined(&model, 10.0, &[8], |a, _| [1, 2, 5].contains(&a));
        assert!(matches!(few, Err(Refusal::Violation { .. })), "two of them and one of the other half do");
    }

    #[test]
    fn what_closes_a_loop_may_leave_more_in_free_space() {
        assert_eq!([lenience(12.0, 16.0), lenience(12.0, 14.5)], [LENIENCE_AROUND_LOOP; 2]);
        assert_eq!([lenience(12.0, 14.4), lenience(12.0, 12.0), lenience(12.0, 8.0)], [LENIENCE; 3]);
    }

    #[test]
    fn pieces_of_several_scans_are_straightened_on_the_word_of_fewer_pairs() {
        let model = Model::new(STATIONS as usize);
        let said = joined(&model, 10.0, &[7, 8], |a, b| [(1, 7), (2, 8), (5, 7)].contains(&(a, b)));
        let Ok(Joined::Bent(straight)) = said else {
            panic!("two pairs of one half and one of the other place the piece")
        };
        let off = most_off(&model, &straight);
        assert!(off < model.hall.resolution, "{off} m");
    }
}
