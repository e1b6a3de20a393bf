//! Filtering: scans that belong elsewhere by now are taken out and may register again.

use super::candidates::{Candidate, best_candidate, support_of};
use super::component::Component;
use super::join::Refusal;
use super::mapper::Mapper;
use super::options::MappingOptions;
use super::refusals::Link;
use super::tracks::Tracks;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::centred_difference;

/// A scan is filtered at most this often while the model does not forget.
pub const MAX_FILTERED: usize = 2;
/// A scan is filtered only from components of at least this many scans.
const FILTER_FROM: usize = 4;
/// … and only if another place has this much more support than the one it has.
pub const FILTER_MARGIN: f64 = 2.0;

/// … or this share of it, where the other place is in a component that does not fit the scan's own.
const NEARLY_AS_MUCH: f64 = 0.5;

impl Mapper {
    /// Filtering: takes out scans that have clearly more support at another pose than at their own; they wait, and may register again. Those that
    /// nothing firm holds and that have clearly more support in another component are taken out, too, and set aside; and those with nearly as much in one
    /// that their own does not fit. Returns how many.
    pub fn filter_scans(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<usize, Cancelled> {
        let mut misplaced: Vec<ScanKey> = Vec::new();
        let mut torn: Vec<(ScanKey, Refusal)> = Vec::new();
        for (index, component) in self.components.iter().enumerate().filter(|(_, c)| c.len() >= FILTER_FROM) {
            // Poses are all that is asked of the rest.
            let mut rest = Component {
                gauge: component.gauge,
                poses: component.poses.clone(),
                tracks: Tracks::default(),
            };
            for (scan, pose) in &component.poses {
                control.check()?;
                if self.filtered.get(scan).copied().unwrap_or(0) >= MAX_FILTERED {
                    continue;
                }
                let single = Component::single(*scan);
                rest.poses.remove(scan);
                let best = best_candidate(graph, &rest, &single, voxel, options);
                let own = support_of(graph, &rest, &single, pose, voxel, options).support;
                rest.poses.insert(*scan, *pose);
                let better = |candidate: &Candidate| candidate.support > own + FILTER_MARGIN;
                let elsewhere = best
                    .filter(better)
                    .is_some_and(|best| differs(&best.a_from_b, pose, *scan, graph, voxel, options));
                let others = self.components.iter().enumerate().filter(|(other, _)| *other != index);
                let held = held_by_client(component, *scan, options);
                let in_another = || {
                    let bests =
                        others.filter_map(|(_, other)| best_candidate(graph, other, &single, voxel, options));
                    most(bests.filter(better))
                };
                let claimed = || {
                    let loosely = if own < options.firm_support { in_another() } else { None };
                    loosely.or_else(|| self.tears((index, component), &single, own, graph, voxel, options))
                };
                if elsewhere {
                    misplaced.push(*scan);
                } else if !held && let Some(rival) = claimed() {
                    misplaced.push(*scan);
                    torn.push((*scan, Refusal::Torn { support: own, rival }));
                }
            }
        }
        for scan in &misplaced {
            *self.filtered.entry(*scan).or_default() += 1;
            for component in &mut self.components {
                component.remove(*scan, options);
            }
            self.add_waiting(*scan);
        }
        // Places that look alike, such as the ends of a hall, pull at them from both sides: it is open where they belong.
        for (scan, refusal) in torn {
            self.set_aside.insert(scan);
            self.waiting.insert(scan, Some(refusal));
        }
        self.dissolve_small();
        Ok(misplaced.len())
    }
}

impl Mapper {
    /// The support that a scan, which has this much in its component, has in another that does not fit that, if it is nearly as much, and firm: both
    /// cannot be right.
    fn tears(
        &self,
        (index, component): (usize, &Component),
        single: &Component,
        own: f64,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
    ) -> Option<f64> {
        let others = self.components.iter().enumerate().filter(|(other, _)| *other != index);
        let apart = others.filter(|(_, other)| {
            let refusal = self.refused.get(Link::between(component.gauge, other.gauge));
            matches!(refusal, Some(Refusal::Violation { .. } | Refusal::Rival { .. }))
        });
        let bests = apart.filter_map(|(_, other)| best_candidate(graph, other, single, voxel, options));
        let tears = |best: &Candidate| {
            best.rests_on_several() && best.support > options.firm_support.max(NEARLY_AS_MUCH * own)
        };
        most(bests.filter(tears))
    }
}

/// The support of that candidate which has most.
fn most(candidates: impl Iterator<Item = Candidate>) -> Option<f64> {
    candidates.map(|candidate| candidate.support).max_by(f64::total_cmp)
}

/// Whether a client joined a scan to another of its component.
pub fn held_by_client(component: &Component, scan: ScanKey, options: &MappingOptions) -> bool {
    options.decisions.joined_pairs().any(|pair| {
        let other = if pair.a == scan { pair.b } else { pair.a };
        (pair.a == scan || pair.b == scan) && component.poses.contains_key(&other)
    })
}

fn differs(
    x: &Pose,
    y: &Pose,
    scan: ScanKey,
    graph: &ScanGraph,
    voxel: f64,
    options: &MappingOptions,
) -> bool {
    let Some(scan) = graph.scan(scan) else { return false };
    let (angle, distance) = centred_difference(x, y, &scan.centroid);
    angle > options.rival_angle || distance > options.rival_voxels * voxel
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::decision::{Decision, Decisions, between_own_frames};
    use crate::mapping::refusals::Refused;
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{PairKey, PairResult};

    #[test]
    fn a_scan_that_more_speaks_for_in_another_component_is_taken_out_unless_a_client_put_it_there() {
        let model = Model::new(8);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let mut graph = model.graph.clone();
        let mut options = MappingOptions::default();
        let silent = |a: u128| {
            let pair = PairKey::of(ScanKey(a), ScanKey(8));
            PairResult { pair, matches: Vec::new(), hypotheses: Vec::new() }
        };
        let first: Vec<ScanKey> = [1, 2, 3, 4, 8].map(ScanKey).to_vec();
        let filtered = |graph: &ScanGraph, options: &MappingOptions| {
            let part = |scans: &[ScanKey]| {
                let poses = scans.iter().map(|scan| (*scan, model.component.poses[scan])).collect();
                Component { gauge: scans[0], poses, tracks: Tracks::default() }
            };
            let components = vec![part(&first), part(&[5, 6, 7].map(ScanKey))];
            let mut mapper = Mapper { components, ..Mapper::default() };
            let count = mapper.filter_scans(graph, model.hall.resolution, options, control);
            assert_eq!(count, Ok(mapper.waiting.len()));
            assert!(mapper.waiting.keys().all(|scan| mapper.set_aside.contains(scan)));
            mapper.waiting.into_keys().collect::<Vec<_>>()
        };
        assert_eq!(filtered(&graph, &options), [], "both know it");
        graph.add_results([1, 2, 3, 4].map(silent), &options.support);
        assert_eq!(filtered(&graph, &options), [ScanKey(8)]);
        let local = model.contradiction((1, 8), true).a_from_b;
        let decided =
            between_own_frames(&graph, ScanKey(1), ScanKey(8), &local).expect("both are in the graph");
        options.decisions = Decisions::new(&[Decision::join(ScanKey(1), ScanKey(8), &decided)]);
        assert_eq!(filtered(&graph, &options), [], "a client has the last word");
    }

    #[test]
    fn a_scan_that_two_components_claim_which_do_not_fit_each_other_is_set_aside() {
        let model = Model::new(8);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let options = MappingOptions::default();
        let mut graph = model.graph.clone();
        // The first four would have the eighth at the other end, and know nothing of the others; those have it where it belongs.
        let results = [1, 2, 3, 4].into_iter().flat_map(|k| [5, 6, 7, 8].map(|of| (k, of))).map(|(k, of)| {
            let edge = model.graph.edge(ScanKey(k), ScanKey(of)).expect("all pairs were tried");
            let mut hypotheses: Vec<_> = edge.hypotheses.iter().map(|h| h.hypothesis).collect();
            hypotheses.retain(|_| of == 8);
            for hypothesis in &mut hypotheses {
                hypothesis.a_from_b = model.contradiction((k, of), false).a_from_b;
            }
            PairResult { pair: PairKey::of(ScanKey(k), ScanKey(of)), matches: Vec::new(), hypotheses }
        });
        graph.add_results(results.collect::<Vec<_>>(), &options.support);
        let wrong = model.with_turned(&[8]);
        let part = |scans: &[u128]| {
            let scans = scans.iter().map(|scan| ScanKey(*scan));
            let poses: BTreeMap<ScanKey, Pose> = scans.map(|scan| (scan, wrong.poses[&scan])).collect();
            Component { gauge: *poses.keys().next().expect("some"), poses, tracks: Tracks::default() }
        };
        let mut mapper =
            Mapper { components: vec![part(&[1, 2, 3, 4, 8]), part(&[5, 6, 7])], ..Mapper::default() };
        let filtered =
            |mapper: &mut Mapper| mapper.filter_scans(&graph, model.hall.resolution, &options, control);
        assert_eq!(filtered(&mut mapper), Ok(0), "they may be parts of one place");
        let refusal = Refusal::Violation { found: 0.3, allowed: 0.1 };
        let refused = Refused { support: 8.0, needed: 8.0, refusal };
        mapper.refused.insert(Link::between(ScanKey(1), ScanKey(5)), refused);
        assert_eq!(filtered(&mut mapper), Ok(1));
        assert!(mapper.set_aside.contains(&ScanKey(8)));
        let said = mapper.waiting[&ScanKey(8)];
        assert!(
            matches!(said, Some(Refusal::Torn { support, rival }) if support > 0.0 && rival > 4.0),
            "{said:?}"
        );
        assert_eq!(mapper.components.iter().map(Component::len).collect::<Vec<_>>(), [4, 3]);
    }
}
