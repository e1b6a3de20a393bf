//! Reclaiming: a waiting scan takes a scan of a component with it, where it surely fits that one and the component has no room for both. A scan can
//! be placed before the one arrives, or is compared, that it belongs to; what then holds it is less than what the two have in common.

use super::candidates::{CLUSTERS, candidates};
use super::component::Component;
use super::consistency::agreeing;
use super::filter::{FILTER_MARGIN, MAX_FILTERED, held_by_client};
use super::join::{Refusal, weigh_join};
use super::mapper::Mapper;
use super::options::MappingOptions;
use super::refusals::Link;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::{ScanGraph, softplus};

/// A scan that a waiting scan has more in common with than its component.
struct Claim {
    /// What holds the scan where it is.
    held: f64,
    /// Evidence for the two, beyond that.
    lead: f64,
    component: usize,
    scan: ScanKey,
    by: ScanKey,
}

impl Mapper {
    /// Starts a component of a waiting scan and of one that it takes out of another, the surest such pair. Returns whether there was one.
    pub fn reclaim(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<bool, Cancelled> {
        let Some(level) = options.firm_levels().last() else { return Ok(false) };
        // Where alike places were found, no pair says enough by itself.
        if !self.doubted.is_empty() {
            return Ok(false);
        }
        for claim in self.claims(graph, options) {
            control.check()?;
            let (mut started, other) = (Component::single(claim.scan), Component::single(claim.by));
            let candidates = candidates(graph, &started, &other, voxel, options, CLUSTERS);
            let Ok(a_from_b) =
                weigh_join(graph, (&started, &other), &candidates, level, voxel, options, control)?
            else {
                continue;
            };
            if common(graph, &claim, &a_from_b, options) - claim.held <= FILTER_MARGIN {
                continue;
            }
            *self.filtered.entry(claim.scan).or_default() += 1;
            self.components[claim.component].remove(claim.scan, options);
            started.absorb(other, &a_from_b, graph, options);
            self.waiting.remove(&claim.by);
            self.components.push(started);
            self.joins_since_refinement += 1;
            self.dissolve_small();
            return Ok(true);
        }
        Ok(false)
    }

    /// What waiting scans claim, the surest claim first.
    fn claims(&self, graph: &ScanGraph, options: &MappingOptions) -> Vec<Claim> {
        let mut found: Vec<Claim> = Vec::new();
        for by in self.free() {
            for (index, component) in self.components.iter().enumerate() {
                let refusal = self.refused.get(Link::between(component.gauge, by));
                if !matches!(refusal, Some(Refusal::Violation { .. } | Refusal::Rival { .. })) {
                    continue;
                }
                for scan in graph.neighbors(by) {
                    if !component.poses.contains_key(&scan)
                        || self.filtered.get(&scan).copied().unwrap_or(0) >= MAX_FILTERED
                        || held_by_client(component, scan, options)
                    {
                        continue;
                    }
                    let common = graph.edge(scan, by).map_or(0.0, |edge| softplus(edge.best_score()));
                    let held = holding(graph, component, scan, options);
                    let lead = common - held;
                    if common >= options.firm_support && lead > FILTER_MARGIN {
                        found.push(Claim { held, lead, component: index, scan, by });
                    }
                }
            }
        }
        found.sort_by(|x, y| y.lead.total_cmp(&x.lead).then((x.scan, x.by).cmp(&(y.scan, y.by))));
        found
    }
}

/// What the pair of a claim says for the pose at which its scans were joined.
fn common(graph: &ScanGraph, claim: &Claim, scan_from_by: &Pose, options: &MappingOptions) -> f64 {
    let Some(edge) = graph.edge(claim.scan, claim.by) else { return 0.0 };
    let joined = if edge.pair.a == claim.scan { *scan_from_by } else { scan_from_by.inverse() };
    agreeing(graph, edge, &joined, options).map_or(0.0, |h| softplus(h.score))
}

/// What the pairs of a scan say for where it is in its component. As all that one pair says for a claim is weighed, so is all that each says
/// against it.
fn holding(graph: &ScanGraph, component: &Component, scan: ScanKey, options: &MappingOptions) -> f64 {
    let Some(pose) = component.poses.get(&scan) else { return 0.0 };
    let said = graph.neighbors(scan).filter_map(|other| {
        let (edge, there) = (graph.edge(scan, other)?, component.poses.get(&other)?);
        let now = if edge.pair.a == scan { pose.inverse() * *there } else { there.inverse() * *pose };
        Some(softplus(agreeing(graph, edge, &now, options)?.score))
    });
    said.sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::decision::{Decision, Decisions, between_own_frames};
    use crate::mapping::refusals::Refused;
    use crate::mapping::test_hall::Model;
    use crate::mapping::tracks::Tracks;
    use crate::pairwise::{PairKey, PairResult};

    #[test]
    fn a_scan_goes_with_the_one_it_surely_belongs_to_where_there_is_no_room_for_both() {
        let model = Model::new(6);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let mut options = MappingOptions::default();
        // The first three would have the fourth at the wrong end, not very surely, and know nothing of the fifth and sixth.
        let mut graph = model.graph.clone();
        let said = [1, 2, 3].into_iter().flat_map(|k| [4, 5, 6].map(|of| (k, of)));
        let results = said.map(|(k, of)| {
            let edge = model.graph.edge(ScanKey(k), ScanKey(of)).expect("all pairs were tried");
            let mut hypotheses: Vec<_> = edge.hypotheses.iter().map(|h| h.hypothesis).collect();
            hypotheses.retain(|_| of == 4 && k == 1);
            for hypothesis in &mut hypotheses {
                hypothesis.a_from_b = model.contradiction((k, of), false).a_from_b;
                hypothesis.logit = 1.0;
            }
            PairResult { pair: PairKey::of(ScanKey(k), ScanKey(of)), matches: Vec::new(), hypotheses }
        });
        graph.add_results(results.collect::<Vec<_>>(), &options.support);
        let wrong = model.with_turned(&[4]);
        let poses = wrong.poses.into_iter().filter(|(scan, _)| *scan < ScanKey(5)).collect();
        let mut mapper = Mapper {
            components: vec![Component { gauge: ScanKey(1), poses, tracks: Tracks::default() }],
            waiting: [5, 6].map(|scan| (ScanKey(scan), None)).into(),
            ..Mapper::default()
        };
        let voxel = model.hall.resolution;
        let untouched = mapper.clone();
        let reclaimed = |mapper: &mut Mapper, options: &MappingOptions| {
            mapper.reclaim(&graph, voxel, options, control).expect("nobody cancels")
        };
        assert!(!reclaimed(&mut mapper, &options), "nothing says that there is no room");

        let refusal = Refusal::Violation { found: 0.3, allowed: 0.1 };
        for scan in [5, 6] {
            let refused = Refused { support: 4.0, needed: 4.0, refusal };
            mapper.refused.insert(Link::between(ScanKey(1), ScanKey(scan)), refused);
        }
        let now = mapper.components[0].poses[&ScanKey(1)].inverse() * mapper.components[0].poses[&ScanKey(4)];
        let now = between_own_frames(&graph, ScanKey(1), ScanKey(4), &now).expect("both are in the graph");
        let free = std::mem::replace(
            &mut options.decisions,
            Decisions::new(&[Decision::join(ScanKey(1), ScanKey(4), &now)]),
        );
        assert!(!reclaimed(&mut mapper, &options), "a client put it there");
        options.decisions = free;
        assert_eq!(mapper.components[0].poses, untouched.components[0].poses);
        let mut often = mapper.clone();
        often.filtered.insert(ScanKey(4), MAX_FILTERED);
        assert!(!reclaimed(&mut often, &options), "it was taken out often enough");

        assert!(reclaimed(&mut mapper, &options));
        let held: Vec<Vec<u128>> =
            mapper.components.iter().map(|c| c.poses.keys().map(|scan| scan.0).collect()).collect();
        assert_eq!(held[0], [1, 2, 3]);
        assert!(held[1].contains(&4) && held[1].len() == 2, "{held:?}");
        assert_eq!(mapper.waiting.len(), 1);
        assert!(!reclaimed(&mut mapper, &options), "nobody claims the others");
    }
}
