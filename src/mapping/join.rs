//! One join: a scan into a component, or a component into another. From the candidate pose through a fit to pooled matches and
//! a dense alignment to the verdict on everything that overlaps.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use nalgebra::Vector3;

use super::belief::hardly_believed;
use super::candidates::{Backing, Candidate, moved, near, support_of};
use super::close_look::objection;
use super::component::Component;
use super::gravity::Gravity;
use super::options::{JoinLevel, MappingOptions};
use super::surfaces::{align, judge};
use super::violation::{ViolationLimit, violation_of};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::{Kernel, Pose, rigid_fit};
use crate::graph::ScanGraph;
use crate::pairwise::{Counts, inlier_matches, is_clearly_worse, look_finely};

const FIT_ITERATIONS: usize = 5;
/// Pairs of each of two poses that a second look is taken at, the firmest.
const SECOND_LOOKS: usize = 6;
/// A pair is sure by itself with these log-odds, a likelihood of 0.88, …
const SURE: f64 = 2.0;
/// … and clearly surer than another with as many more as this.
const LEAD: f64 = 1.0;
/// Edges whose own poses are tried where the fit to all of them fails.
pub const SINGLE_STARTS: usize = 6;

/// Why a join was not made. Stored by the order of its variants, so new ones come last.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Refusal {
    /// Too little support, rivals aside.
    Support {
        /// What there is.
        found: f64,
        /// What the level asks.
        needed: f64,
    },
    /// A different pose is about as well supported, or a pair is surer of it than any of this one.
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
        /// What is allowed.
        allowed: f64,
    },
    /// A client decided the join, and forbade what it would bring together.
    Forbidden,
    /// Two pieces of several scans each share one pair alone, or what one scan sees little of.
    SinglePair {
        /// Its support.
        support: f64,
    },
    /// What the scans of all pairs that have a voice for it share is little more than three planes: such a corner fits in many places. Or one weak pair alone
    /// speaks for it, and shows no more than that.
    Indistinct {
        /// Share of the coinciding points that lie beyond the three largest planes, the most of any pair.
        found: f64,
        /// The least share.
        needed: f64,
    },
    /// Two components that do not fit each other have about as much for it.
    Torn {
        /// Support in the one that it was taken out of.
        support: f64,
        /// The most support in another.
        rival: f64,
    },
}

/// A candidate after alignment.
#[derive(Debug, Clone, Copy)]
struct Placed {
    a_from_b: Pose,
    /// Support of the edges at the aligned pose.
    support: f64,
    /// Edges that say something for it.
    edges: usize,
    /// Share of the judged points that lie in free space.
    violation: f64,
}

/// What a candidate must show once it is aligned.
struct Needed<'l, 'm> {
    support: f64,
    edges: usize,
    limit: &'l ViolationLimit<'m>,
    gravity: Option<Gravity>,
}

/// Weighs the candidates of two components against each other, best supported first (`candidates`, in that order): the first that keeps
/// its support and stays clear of free space is taken, unless another is nearly as heavy, or of a lone scan clearly surer by one pair, that neither
/// free space rules out nor a second look finds clearly worse. At the strictest level only pairs count that have a voice of their own. Returns
/// `a_from_b`.
pub fn weigh_join(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidates: &[Candidate],
    level: &JoinLevel,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Result<Pose, Refusal>, Cancelled> {
    let mut first_refusal = None;
    let several = options.asks_for_several(a.len(), b.len(), level);
    // What is joined already, and only weighed again, need not show as much.
    let weighed_again = level.support <= 0.0;
    let strictest = !weighed_again && options.is_strictest(level);
    let lone = a.len().min(b.len()) == 1;
    let limit = ViolationLimit::new(graph, (a, b), level, options);
    let gravity = Gravity::between(graph, a, b);
    let place = |candidate: &Candidate, least: f64, edges: usize| {
        let needed = Needed { support: least, edges, limit: &limit, gravity };
        place(graph, (a, b), candidate, &needed, voxel, options)
    };
    for (rank, candidate) in candidates.iter().enumerate() {
        control.check()?;
        if candidate.support < level.support {
            let refusal = Refusal::Support { found: candidate.support, needed: level.support };
            return Ok(Err(first_refusal.unwrap_or(refusal)));
        }
        if several && !candidate.rests_on_several() {
            first_refusal = first_refusal.or(Some(Refusal::SinglePair { support: candidate.support }));
            continue;
        }
        let own = candidate.own_support();
        // Third scans do not make a join of what no pair believes by itself.
        if strictest && own < level.support || !weighed_again && own <= 0.0 {
            first_refusal = first_refusal.or(Some(Refusal::Support { found: own, needed: level.support }));
            continue;
        }
        match place(candidate, level.support, if several { 2 } else { 1 }) {
            Ok(placed) => {
                let backing = Backing { support: placed.support, edges: placed.edges };
                let objected = || {
                    hardly_believed(candidate, backing, options)
                        .or_else(|| objection(graph, (a, b), candidate, backing, &placed.a_from_b, options))
                };
                if !weighed_again && let Some(refusal) = objected() {
                    first_refusal = first_refusal.or(Some(refusal));
                    continue;
                }
                let margin = |rival: f64| placed.support - options.rival_share * rival;
                // Rivals are looked at only as far as they matter. The pairs that one scan has with a piece are no independent witnesses: together they
                // do not outweigh one that is clearly surer than any of them. Rivals that are heavier anyhow are judged by the margin.
                let surest = if lone && !weighed_again { candidate.surest() } else { f64::INFINITY };
                let surer = |rival: &Candidate| {
                    rival.doubt < placed.support && rival.surest() > SURE.max(surest + LEAD)
                };
                let feared = candidates
                    .iter()
                    .enumerate()
                    .filter(|(other, c)| *other != rank && (margin(c.doubt) < level.support || surer(c)));
                for (_, rival) in feared {
                    control.check()?;
                    // A lighter rival that alignment brings to the same place is none.
                    let lighter = margin(rival.doubt) >= level.support;
                    if let Ok(there) = place(rival, 0.0, 0)
                        && (!lighter || moved(graph, b, &placed.a_from_b, &there.a_from_b, voxel, options))
                        && !outdone(graph, (a, b), (candidate, &placed), (rival, &there), voxel, control)?
                    {
                        return Ok(Err(Refusal::Rival { support: placed.support, rival: rival.doubt }));
                    }
                }
                return Ok(Ok(placed.a_from_b));
            }
            Err(refusal) => first_refusal = first_refusal.or(Some(refusal)),
        }
    }
    Ok(Err(first_refusal.unwrap_or(Refusal::Support { found: 0.0, needed: level.support })))
}

/// Whether a second look at the pairs that speak for either of two poses finds the rival's clearly worse.
fn outdone(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    (candidate, placed): (&Candidate, &Placed),
    (rival, rivals): (&Candidate, &Placed),
    voxel: f64,
    control: Control<'_>,
) -> Result<bool, Cancelled> {
    let firmest = |c: &Candidate| {
        let mut members: Vec<(f64, ScanKey, ScanKey)> =
            c.members.iter().map(|m| (m.doubt, m.in_a, m.in_b)).collect();
        members.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        members.into_iter().take(SECOND_LOOKS).map(|(_, in_a, in_b)| (in_a, in_b))
    };
    let pairs: BTreeSet<(ScanKey, ScanKey)> = firmest(candidate).chain(firmest(rival)).collect();
    let (mut mine, mut others) = (Counts::default(), Counts::default());
    for (in_a, in_b) in pairs {
        control.check()?;
        let (Some(x), Some(y)) = (graph.scan(in_a), graph.scan(in_b)) else { continue };
        let (Some(a_from_x), Some(b_from_y)) = (a.poses.get(&in_a), b.poses.get(&in_b)) else { continue };
        let between = |a_from_b: &Pose| a_from_x.inverse() * *a_from_b * *b_from_y;
        if let (Some(at_mine), Some(at_others)) =
            (look_finely(x, y, &between(&placed.a_from_b)), look_finely(x, y, &between(&rivals.a_from_b)))
        {
            mine = mine.plus(&at_mine);
            others = others.plus(&at_others);
        }
    }
    Ok(is_clearly_worse(&mine, &others, voxel / 2.0))
}

/// Aligns one candidate and checks that it keeps what is needed, no ban stands against it, and free space allows it. Where edges
/// agree only roughly, the fit to all of them can slide into free space while one of them is right, so the poses of single edges are
/// tried too.
fn place(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidate: &Candidate,
    needed: &Needed<'_, '_>,
    voxel: f64,
    options: &MappingOptions,
) -> Result<Placed, Refusal> {
    let settle = |start: &Pose| {
        let a_from_b = align(graph, a, b, start, voxel);
        let tips_over = needed.gravity.is_some_and(|gravity| !gravity.admits(&a_from_b));
        // What alignment moved to a banned pose has no support there.
        let Backing { support, edges } =
            if tips_over || options.decisions.forbids(graph, a, b, &a_from_b, options) {
                Backing { support: f64::NEG_INFINITY, edges: 0 }
            } else {
                support_of(graph, a, b, &a_from_b, voxel, options)
            };
        Placed { a_from_b, support, edges, violation: violation_of(&judge(graph, a, b, &a_from_b)) }
    };
    if candidate.decided {
        let aligned = align(graph, a, b, &pooled_fit(graph, a, b, candidate, voxel), voxel);
        let agrees = candidate.members.iter().all(|m| near(&aligned, m, voxel, options));
        let a_from_b = if agrees { aligned } else { candidate.a_from_b };
        if options.decisions.client_forbids(graph, a, b, &a_from_b, options) {
            return Err(Refusal::Forbidden);
        }
        return Ok(Placed { a_from_b, support: candidate.support, edges: 1, violation: 0.0 });
    }
    let backed = |p: &Placed| p.support >= needed.support && p.edges >= needed.edges;
    let allowed = |p: &Placed| needed.limit.admits(p.violation, p.support.min(candidate.support));
    let mut best = settle(&pooled_fit(graph, a, b, candidate, voxel));
    if !(backed(&best) && allowed(&best)) && candidate.members.len() > 1 {
        for member in candidate.members.iter().take(SINGLE_STARTS) {
            let other = settle(&member.a_from_b);
            if backed(&other) && (other.violation < best.violation || !backed(&best)) {
                best = other;
            }
            if backed(&best) && allowed(&best) {
                break;
            }
        }
    }
    // The alignment must stay at the pose that the edges voted for.
    if best.support < needed.support {
        return Err(Refusal::Support { found: best.support.max(0.0), needed: needed.support });
    }
    if best.edges < needed.edges {
        return Err(Refusal::SinglePair { support: best.support });
    }
    if !allowed(&best) {
        let allowed = needed.limit.share(best.support.min(candidate.support));
        return Err(Refusal::Violation { found: best.violation, allowed });
    }
    Ok(best)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::graph::SupportOptions;
    use crate::mapping::candidates::{CLUSTERS, candidates};
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Evidence, Hypothesis, PairKey, PairResult};

    /// What joining the last scan to the others comes to at the levels from the strictest down, where its pairs say this: whether truly, and with
    /// what log-odds.
    fn joined(said: &[((u128, u128), bool, f64)]) -> Vec<Result<Pose, Refusal>> {
        let model = Model::new(6);
        let mut graph = model.coarse();
        let results = said.iter().map(|&(pair, truly, logit)| {
            let a_from_b = model.contradiction(pair, truly).a_from_b;
            let evidence = Evidence::default();
            PairResult {
                pair: PairKey::of(ScanKey(pair.0), ScanKey(pair.1)),
                matches: Vec::new(),
                hypotheses: vec![Hypothesis { a_from_b, evidence, logit }],
            }
        });
        graph.add_results(results, &SupportOptions::default());
        let options = MappingOptions::default();
        let mut rest = model.component.clone();
        rest.remove(ScanKey(6), &options);
        let last = Component::single(ScanKey(6));
        let voxel = model.hall.resolution;
        let found = candidates(&graph, &rest, &last, voxel, &options, CLUSTERS);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let weigh = |level| weigh_join(&graph, (&rest, &last), &found, level, voxel, &options, control);
        options.levels.iter().map(|level| weigh(level).expect("nobody cancels")).collect()
    }

    #[test]
    fn what_only_third_scans_say_does_not_count_at_the_strictest_level() {
        let talked_up = |logit| [((1, 6), true, 6.0), ((2, 6), true, logit), ((3, 6), true, logit)];
        let by_themselves = joined(&[talked_up(6.0), [((4, 6), true, 6.0); 3]].concat());
        assert!(by_themselves[0].is_ok(), "{by_themselves:?}");
        let others = [((4, 6), true, -3.0), ((5, 6), true, -3.0)];
        let one_voice = joined(&[&talked_up(-3.0)[..], &others].concat());
        assert_eq!(one_voice[0], Err(Refusal::Support { found: 4.0, needed: 8.0 }));
        assert!(one_voice[1].is_ok(), "{one_voice:?}");
    }

    #[test]
    fn third_scans_join_nothing_that_no_pair_believes_by_itself() {
        let all = |logit| joined(&(1..=5).map(|k| ((k, 6), true, logit)).collect::<Vec<_>>());
        let last = |results: Vec<Result<Pose, Refusal>>| results.last().copied();
        assert!(matches!(last(all(-0.9)), Some(Ok(_))), "{:?}", all(-0.9));
        assert_eq!(last(all(-1.1)), Some(Err(Refusal::Support { found: 0.0, needed: 1.5 })));
    }

    #[test]
    fn several_pairs_of_one_scan_do_not_outweigh_a_surer_one_elsewhere() {
        let sure = |logit| {
            let others =
                [((2, 6), true, 5.0), ((3, 6), true, 5.0), ((4, 6), true, -9.0), ((5, 6), true, -9.0)];
            joined(&[&[((1, 6), false, logit)][..], &others].concat())
        };
        assert!(sure(4.5)[1].is_ok(), "{:?}", sure(4.5));
        assert!(matches!(sure(7.0)[1], Err(Refusal::Rival { .. })), "{:?}", sure(7.0));
    }
}
