//! The engine of incremental mapping: one method a step of the method, no opinion on their order (that is `policy`).

use std::collections::{BTreeMap, BTreeSet};

use super::bent_join::{Joined, weigh_even_bent};
use super::candidates::{CLUSTERS, Candidate, candidates};
use super::component::Component;
use super::guarded::{guarded, refined};
use super::initial_pair::initial_pairs;
use super::join::{Refusal, weigh_join};
use super::next_scan::visible_landmarks;
use super::open_join::{OpenJoin, Undone, open_joins};
use super::options::{JoinLevel, MappingOptions};
use super::refine::{Reach, dense, local_bundle_adjustment, neighborhood};
use super::refusals::{Link, Refusals, Refused, more_telling};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// A waiting scan that could be registered.
struct NextScan {
    component: usize,
    scan: ScanKey,
    /// Its support by its best candidate.
    support: f64,
    candidates: Vec<Candidate>,
    /// Spread of the landmarks that it sees, then their number.
    visible: (usize, usize),
}

/// The state of mapping: components, and scans that wait.
#[derive(Debug, Clone, Default)]
pub struct Mapper {
    /// Pieces of at least two scans.
    pub components: Vec<Component>,
    /// Scans in no component, and why as far as known.
    pub waiting: BTreeMap<ScanKey, Option<Refusal>>,
    /// Joins that were refused on sight of the surfaces: not worth another look until the support or the surfaces change.
    pub(super) refused: Refusals,
    /// How often each scan was filtered out, so that filtering ends.
    pub(super) filtered: BTreeMap<ScanKey, usize>,
    /// Joins since the whole model was refined last.
    pub joins_since_refinement: usize,
    /// Scans of components that were taken apart because their pairs contradict each other.
    pub(super) doubted: BTreeSet<ScanKey>,
    /// Scans of which it is open where they belong: they wait until all is decided anew, or their own pairs settle it at the end, and say nothing of the
    /// rest.
    pub(super) set_aside: BTreeSet<ScanKey>,
    /// Placements taken back since the model was last decided anew.
    pub undone: Vec<Undone>,
    /// Joins not made although something speaks for them, as of the end of growing.
    pub open_joins: Vec<OpenJoin>,
}

/// Pieces of at least this many scans are only joined on more support than the most lenient level asks.
pub(super) const LARGE_PIECE: usize = 3;

impl Mapper {
    /// Number of registered scans.
    #[must_use]
    pub fn registered(&self) -> usize {
        self.components.iter().map(Component::len).sum()
    }

    /// Takes in a scan that waits.
    pub fn add_waiting(&mut self, scan: ScanKey) {
        self.waiting.insert(scan, None);
    }

    /// Takes a scan out of the model. A component left with one scan dissolves and that scan waits.
    pub fn remove(&mut self, scan: ScanKey, options: &MappingOptions) {
        self.waiting.remove(&scan);
        self.filtered.remove(&scan);
        self.doubted.remove(&scan);
        self.set_aside.remove(&scan);
        self.open_joins.retain(|open| open.a != scan && open.b != scan);
        self.undone.retain(|undone| !undone.scans.contains(&scan) && !undone.evidence.contains(&scan));
        self.refused.forget(scan);
        for component in &mut self.components {
            component.remove(scan, options);
        }
        self.dissolve_small();
    }

    /// Next-scan registration: the first of the ranked waiting scans whose join passes the level. Returns the scan.
    pub fn register_next_scan(
        &mut self,
        graph: &ScanGraph,
        level: &JoinLevel,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Option<ScanKey>, Cancelled> {
        for next in self.rank_next_scans(graph, level, voxel, options, control)? {
            control.check()?;
            let component = &self.components[next.component];
            let single = Component::single(next.scan);
            let link = Link::between(component.gauge, next.scan);
            if self.refused.still_holds(link, next.support, level) {
                continue;
            }
            match weigh_even_bent(
                graph,
                (component, &single),
                &next.candidates,
                level,
                voxel,
                options,
                control,
            )? {
                Ok(Joined::Rigid(a_from_b)) => {
                    self.take_in((next.component, single), &a_from_b, graph, voxel, options, control)?;
                    return Ok(Some(next.scan));
                }
                Ok(Joined::Bent(joined)) => {
                    self.components[next.component] = joined;
                    self.waiting.remove(&next.scan);
                    self.joins_since_refinement += 1;
                    return Ok(Some(next.scan));
                }
                Err(refusal) => {
                    let (support, needed) = (next.support, level.support);
                    self.refused.insert(link, Refused { support, needed, refusal });
                    self.waiting.insert(next.scan, Some(refusal));
                }
            }
        }
        Ok(None)
    }

    /// Joins a waiting scan to a component, and adjusts it and what is around it.
    pub(super) fn take_in(
        &mut self,
        (index, single): (usize, Component),
        component_from_scan: &Pose,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        let scan = single.gauge;
        self.waiting.remove(&scan);
        let component = &mut self.components[index];
        component.absorb(single, component_from_scan, graph, options);
        let free = neighborhood(component, scan, options);
        guarded(graph, component, options, |component| {
            local_bundle_adjustment(component, scan, voxel, options, control)
        })?;
        guarded(graph, component, options, |component| {
            dense(graph, component, Some(&free), Reach::NEAR, voxel, control).map(drop)
        })?;
        self.joins_since_refinement += 1;
        Ok(())
    }

    /// Waiting scans that pass a level's support against some component; those that see most landmarks first.
    fn rank_next_scans(
        &mut self,
        graph: &ScanGraph,
        level: &JoinLevel,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Vec<NextScan>, Cancelled> {
        let mut ranked = Vec::new();
        for scan in self.free() {
            control.check()?;
            let single = Component::single(scan);
            for (index, component) in self.components.iter().enumerate() {
                let candidates = candidates(graph, component, &single, voxel, options, CLUSTERS);
                let Some(best) = candidates.first() else { continue };
                let support = best.support;
                if support < level.support {
                    let refusal = Refusal::Support { found: support, needed: level.support };
                    self.waiting.entry(scan).and_modify(|known| *known = more_telling(*known, refusal));
                } else {
                    let visible = visible_landmarks(graph, component, scan, best);
                    let visible = (visible.score, visible.keypoints.len());
                    ranked.push(NextScan { component: index, scan, support, candidates, visible });
                }
            }
        }
        ranked.sort_by(|x, y| {
            y.visible
                .cmp(&x.visible)
                .then(y.support.total_cmp(&x.support))
                .then(x.scan.cmp(&y.scan))
                .then(x.component.cmp(&y.component))
        });
        Ok(ranked)
    }

    /// Initial pair: starts a component from two waiting scans. Returns whether one was started.
    pub fn start_component(
        &mut self,
        graph: &ScanGraph,
        level: &JoinLevel,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<bool, Cancelled> {
        let free = self.free();
        for (first, second) in initial_pairs(graph, &free, level, options) {
            control.check()?;
            let (mut a, b) = (Component::single(first), Component::single(second));
            let candidates = candidates(graph, &a, &b, voxel, options, CLUSTERS);
            let Some(support) = candidates.first().map(|best| best.support) else { continue };
            let link = Link::between(first, second);
            if self.refused.still_holds(link, support, level) {
                continue;
            }
            match weigh_join(graph, (&a, &b), &candidates, level, voxel, options, control)? {
                Ok(a_from_b) => {
                    a.absorb(b, &a_from_b, graph, options);
                    self.waiting.remove(&first);
                    self.waiting.remove(&second);
                    self.components.push(a);
                    self.joins_since_refinement += 1;
                    return Ok(true);
                }
                Err(refusal) => {
                    self.refused.insert(link, Refused { support, needed: level.support, refusal });
                    for scan in [first, second] {
                        self.waiting.entry(scan).and_modify(|known| *known = more_telling(*known, refusal));
                    }
                }
            }
        }
        Ok(false)
    }

    /// Merges the two components whose join is best supported. Returns whether two were merged.
    pub fn merge_components(
        &mut self,
        graph: &ScanGraph,
        level: &JoinLevel,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<bool, Cancelled> {
        let mut ranked: Vec<(f64, usize, usize, Vec<Candidate>)> = Vec::new();
        for i in 0..self.components.len() {
            control.check()?;
            for j in i + 1..self.components.len() {
                let (a, b) = self.larger_first(i, j);
                // A wrong join of two large pieces misplaces many scans, and pieces that large have more to say for each other.
                if self.components[b].len() >= LARGE_PIECE && level.support < options.least_large_support {
                    continue;
                }
                let found =
                    candidates(graph, &self.components[a], &self.components[b], voxel, options, CLUSTERS);
                match found.first() {
                    Some(best)
                        if !best.rests_on_several()
                            && options.asks_for_several(
                                self.components[a].len(),
                                self.components[b].len(),
                                level,
                            ) => {}
                    Some(best) if best.support >= level.support => {
                        ranked.push((best.margin(options), a, b, found));
                    }
                    _ => {}
                }
            }
        }
        ranked.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        for (_, a, b, candidates) in ranked {
            control.check()?;
            let link = Link::between(self.components[a].gauge, self.components[b].gauge);
            let Some(candidate) = candidates.first() else { continue };
            if self.refused.still_holds(link, candidate.support, level) {
                continue;
            }
            let (first, second) = (&self.components[a], &self.components[b]);
            match weigh_even_bent(graph, (first, second), &candidates, level, voxel, options, control)? {
                Ok(joined) => {
                    match joined {
                        Joined::Rigid(a_from_b) => {
                            let other = self.components[b].clone();
                            self.components[a].absorb(other, &a_from_b, graph, options);
                        }
                        Joined::Bent(joined) => self.components[a] = joined,
                    }
                    self.components.remove(b);
                    self.joins_since_refinement += 1;
                    return Ok(true);
                }
                Err(refusal) => {
                    let (support, needed) = (candidate.support, level.support);
                    self.refused.insert(link, Refused { support, needed, refusal });
                }
            }
        }
        Ok(false)
    }

    /// Completes the tracks of every component, refines it, and filters its tracks at the new poses.
    pub fn refine(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        for component in &mut self.components {
            // What was too far from its landmark when it was seen first may be near now.
            component.complete_tracks(graph, options);
            *component = refined(graph, component, voxel, options, control)?;
            component.tracks.filter(&component.poses, options.track_voxels * voxel, options.track_length);
        }
        self.joins_since_refinement = 0;
        // Surfaces lie elsewhere now, and what was bent may be straight.
        self.refused.clear();
        Ok(())
    }

    /// Waiting scans that may be joined.
    pub(super) fn free(&self) -> BTreeSet<ScanKey> {
        let free = |scan: &&ScanKey| !self.doubted.contains(scan) && !self.set_aside.contains(scan);
        self.waiting.keys().filter(free).copied().collect()
    }

    /// Takes apart the components that hold any of these scans: what was decided about them decides all of it anew.
    pub fn reopen(&mut self, scans: &BTreeSet<ScanKey>) {
        let (touched, kept): (Vec<Component>, Vec<Component>) = std::mem::take(&mut self.components)
            .into_iter()
            .partition(|c| c.poses.keys().any(|scan| scans.contains(scan)));
        self.components = kept;
        for scan in touched.into_iter().flat_map(|c| c.poses.into_keys()) {
            self.add_waiting(scan);
        }
    }

    /// Lists the joins that are left open.
    pub fn list_open_joins(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        self.open_joins = open_joins(graph, self, voxel, options, control)?;
        Ok(())
    }

    /// Whether the model has grown enough since the last refinement to deserve another.
    #[must_use]
    pub fn refinement_is_due(&self, options: &MappingOptions) -> bool {
        let grown = (self.registered() as f64 * options.refine_growth) as usize;
        self.joins_since_refinement >= options.refine_joins.max(grown)
    }

    /// Largest components first, ties by gauge.
    pub fn sort_components(&mut self) {
        self.components.sort_by(|x, y| y.len().cmp(&x.len()).then(x.gauge.cmp(&y.gauge)));
    }

    fn larger_first(&self, i: usize, j: usize) -> (usize, usize) {
        if self.components[j].len() > self.components[i].len() { (j, i) } else { (i, j) }
    }

    /// Why two pieces were not joined when they were weighed last, if they were.
    pub(super) fn refusal_between(&self, a: &Component, b: &Component) -> Option<Refusal> {
        self.refused.get(Link::between(a.gauge, b.gauge))
    }

    pub(super) fn dissolve_small(&mut self) {
        let (kept, small): (Vec<Component>, Vec<Component>) =
            std::mem::take(&mut self.components).into_iter().partition(|c| c.len() >= 2);
        self.components = kept;
        for scan in small.into_iter().flat_map(|c| c.poses.into_keys()) {
            self.add_waiting(scan);
        }
    }
}
