//! Whether a grown component would still be joined as it is. Joins are made one at a time, each on what is known then, and near-alike places
//! (a symmetric hall, identical rooms) can take in scan after scan by a small lead each. With all of it there, the sides of the doubtful
//! cut are weighed against each other as two components: where the runner-up is nearly as good, nothing tells which is right. Used by
//! `undo`.

use std::collections::BTreeSet;

use super::candidates::{CLUSTERS, candidates, moved};
use super::component::Component;
use super::cuts::smaller_side;
use super::hearing::{Hearing, Ruling};
use super::join::{Refusal, weigh_join};
use super::options::{JoinLevel, MappingOptions};
use super::testimony::{CLEARLY_DIFFERENT, Contradiction, Testimony};
use super::voice::{Word, loudest};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::{ScanGraph, evidence};
use crate::pairwise::centred_difference;

/// A runner-up with this share of the support is nearly as good.
const NEARLY_AS_GOOD: f64 = 0.5;
/// Contradictions from which a cut is sought, the strongest first.
const TRIED: usize = 8;
/// Evidence for another pose below this is noise: a likelihood of 0.63.
const LEAST_DOUBT: f64 = 1.0;
/// Pairs that say the same show that places are alike. A single one may be wrong by itself, and what it leaves in doubt is only the cut.
const ALIKE_PAIRS: usize = 2;
/// A gain of a move below this is rounding.
const NO_GAIN: f64 = -1e-9;

/// Two sides of a component that would not be joined as they are.
pub struct Undecided {
    /// The smaller side.
    pub side: BTreeSet<ScanKey>,
    /// The pair that led to it.
    pub strongest: Contradiction,
    /// Places are alike: both poses are about as good, and several pairs say so. Otherwise the sides only do not belong together as they are.
    pub alike: bool,
}

/// The first of the component's doubtful cuts, the most doubtful first, whose two sides a join would not put together as they are, unless a hearing
/// refutes what pairs across say alike. `voxel`
/// in metres.
pub fn undecided(
    graph: &ScanGraph,
    component: &Component,
    testimony: &Testimony,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<Undecided>, Cancelled> {
    let votes = Votes::of(graph, component, options);
    let mut cuts: Vec<(f64, BTreeSet<ScanKey>, Contradiction)> = Vec::new();
    for strongest in testimony.inside(component).take(TRIED) {
        let (Some(a), Some(b)) = (votes.index(strongest.pair.a), votes.index(strongest.pair.b)) else {
            continue;
        };
        for alone in [true, false] {
            control.check()?;
            let (weight, side) = votes.descend(a, b, alone);
            if weight < 0.0 && cuts.iter().all(|(_, known, _)| *known != side) {
                cuts.push((weight, side, *strongest));
            }
        }
    }
    cuts.sort_by(|x, y| x.0.total_cmp(&y.0).then_with(|| x.1.cmp(&y.1)));
    let inside: Vec<&Contradiction> = testimony.inside(component).collect();
    let mut hearing: Option<Hearing<'_>> = None;
    for (_, side, strongest) in cuts {
        control.check()?;
        if let Some(rivals) = reweigh(graph, component, &side, voxel, options, control).transpose()? {
            // What most pairs across say alike against the sides is heard like any voice.
            let words = Word::on_side(graph, component, &side, &inside, options);
            let voice = loudest(&words, options.rival_angle);
            if !voice.is_empty() && hearing.is_none() {
                hearing = Some(Hearing::open(graph, component, control)?);
            }
            if let Some(hearing) = hearing.as_ref().filter(|_| !voice.is_empty())
                && hearing.hear(&voice, &BTreeSet::new(), options, control)? == Ruling::Refuted
            {
                continue;
            }
            let alike = rivals && voice.len() >= ALIKE_PAIRS;
            return Ok(Some(Undecided { side: smaller_side(component, side), strongest, alike }));
        }
    }
    Ok(None)
}

/// Joins the two sides anew: true if rivals forbid it, false if another pose is better, `None` if it is what it was.
fn reweigh(
    graph: &ScanGraph,
    component: &Component,
    side: &BTreeSet<ScanKey>,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Option<Result<bool, Cancelled>> {
    // What is joined already need show no least support; a rival may have its share of it, however firm it is.
    let level = JoinLevel { support: 0.0, ..*options.levels.last()? };
    // A pose nearby is no other place; and one pair may speak for what is joined already.
    let options = MappingOptions {
        levels: vec![level],
        rival_share: 1.0 / NEARLY_AS_GOOD,
        rival_angle: CLEARLY_DIFFERENT * options.rival_angle,
        rival_voxels: CLEARLY_DIFFERENT * options.rival_voxels,
        ..options.clone()
    };
    let mut rest = component.clone();
    let part = rest.split_off(side, &options)?;
    let model_from = |piece: &Component| {
        Some(*component.poses.get(&piece.gauge)? * piece.poses.get(&piece.gauge)?.inverse())
    };
    let now = model_from(&rest)?.inverse() * model_from(&part)?;
    let found = candidates(graph, &rest, &part, voxel, &options, CLUSTERS);
    let best = found.first()?;
    // What edges alone settle needs no look at surfaces.
    if best.margin(&options) >= level.support && !moved(graph, &part, &now, &best.a_from_b, voxel, &options) {
        return None;
    }
    match weigh_join(graph, (&rest, &part), &found, &level, voxel, &options, control) {
        Ok(Ok(a_from_b)) => moved(graph, &part, &now, &a_from_b, voxel, &options).then_some(Ok(false)),
        Ok(Err(Refusal::Rival { .. })) => Some(Ok(true)),
        Ok(Err(_)) => None,
        Err(cancelled) => Some(Err(cancelled)),
    }
}

/// For every pair of a component's scans, the share of their support for where they are that a rival may have, less what they say for
/// another pose: negative where they lean to it.
struct Votes {
    keys: Vec<ScanKey>,
    /// For each scan the others that it shares a pair with, and what the pair says.
    links: Vec<Vec<(usize, f64)>>,
}

impl Votes {
    fn of(graph: &ScanGraph, component: &Component, options: &MappingOptions) -> Self {
        let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
        let links = keys.iter().map(|a| {
            let voters = graph.neighbors(*a).filter_map(|b| Some((keys.binary_search(&b).ok()?, b)));
            voters
                .filter_map(|(index, b)| {
                    let (x, y) = (b.min(*a), b.max(*a));
                    Some((index, vote(graph, component, x, y, options)?))
                })
                .collect()
        });
        Self { links: links.collect(), keys }
    }

    fn index(&self, key: ScanKey) -> Option<usize> {
        self.keys.binary_search(&key).ok()
    }

    /// The lightest cut between two scans that moving one scan at a time finds, from `from` alone on its side or all but `to`: its weight,
    /// and the side of `from`. Weights may be negative, so there is no exact method that is fast.
    fn descend(&self, from: usize, to: usize, alone: bool) -> (f64, BTreeSet<ScanKey>) {
        let n = self.keys.len();
        let mut inside: Vec<bool> = (0..n).map(|i| if alone { i == from } else { i != to }).collect();
        // By how much the cut grows when a scan changes sides.
        let mut gains: Vec<f64> = (0..n)
            .map(|i| self.links[i].iter().map(|&(j, w)| if inside[j] == inside[i] { w } else { -w }).sum())
            .collect();
        // Every move makes the cut lighter, so no division comes twice.
        loop {
            let lightest = (0..n)
                .filter(|i| *i != from && *i != to)
                .min_by(|x, y| gains[*x].total_cmp(&gains[*y]).then(x.cmp(y)));
            let Some(moved) = lightest.filter(|i| gains[*i] < NO_GAIN) else { break };
            inside[moved] = !inside[moved];
            gains[moved] = -gains[moved];
            for &(other, weight) in &self.links[moved] {
                gains[other] += if inside[other] == inside[moved] { 2.0 * weight } else { -2.0 * weight };
            }
        }
        let outward = (0..n).filter(|i| inside[*i]).flat_map(|i| &self.links[i]);
        let cut = outward.filter(|(other, _)| !inside[*other]).map(|(_, weight)| weight).sum();
        (cut, (0..n).filter(|i| inside[*i]).map(|i| self.keys[i]).collect())
    }
}

fn vote(
    graph: &ScanGraph,
    component: &Component,
    a: ScanKey,
    b: ScanKey,
    options: &MappingOptions,
) -> Option<f64> {
    let (edge, scan) = (graph.edge(a, b)?, graph.scan(b)?);
    let now = component.poses.get(&a)?.inverse() * *component.poses.get(&b)?;
    let reach = options.rival_voxels * scan.prepared.resolution;
    let (mut support, mut doubt) = (0.0_f64, 0.0_f64);
    for h in &edge.hypotheses {
        let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &now, &scan.centroid);
        if angle > options.rival_angle || distance > reach {
            doubt = doubt.max(evidence(h.score.max(h.hypothesis.logit)));
        } else {
            support = support.max(evidence(h.score));
        }
    }
    Some(NEARLY_AS_GOOD * support - if doubt > LEAST_DOUBT { doubt } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_halves_that_lean_to_another_pose_are_found() {
        // Two triangles that hold firmly; across, most pairs lean the other way.
        let weight = |i: usize, j: usize| match (i.min(j), i.max(j)) {
            (2, 3) => 1.0,
            (i, j) => {
                if (i < 3) == (j < 3) {
                    4.0
                } else {
                    -0.5
                }
            }
        };
        let link = |i: usize| (0..6).filter(|j| *j != i).map(|j| (j, weight(i, j))).collect();
        let votes = Votes { keys: (1..=6).map(ScanKey).collect(), links: (0..6).map(link).collect() };
        let (weight, side) = votes.descend(0, 5, true);
        assert_eq!(side, (1..=3).map(ScanKey).collect());
        assert!((weight - (8.0 * -0.5 + 1.0)).abs() < 1e-12);
        assert_eq!(votes.descend(0, 5, false), (weight, side));
    }
}
