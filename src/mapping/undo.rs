//! Taking back what later evidence contradicts: a component that too many pairs speak against is taken apart, and its scans wait until
//! a new scan or a decision changes what is known. Nothing in it can be told from its twin, so nothing of it is kept.

use std::collections::{BTreeMap, BTreeSet};

use super::candidates::best_candidate;
use super::component::Component;
use super::consistency::{Contradiction, supports, testimony};
use super::join::Refusal;
use super::mapper::Mapper;
use super::open_join::Undone;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::graph::ScanGraph;

impl Mapper {
    /// Takes apart every component that its own pairs condemn. Its scans wait, and no step joins them again before
    /// [`Mapper::loosen`] decides all anew. Returns how many components were taken apart.
    pub fn undo_contradicted(&mut self, graph: &ScanGraph, voxel: f64, options: &MappingOptions) -> usize {
        let mut kept = Vec::new();
        let mut undone = 0;
        for component in std::mem::take(&mut self.components) {
            // Where a client joined scans, the client has the last word.
            if options.decisions.joined_pairs().any(|pair| component.poses.contains_key(&pair.a)) {
                kept.push(component);
                continue;
            }
            let testimony = testimony(graph, &self.with_torn(graph, &component, voxel, options), options);
            let Some(strongest) = testimony.contradictions.first().filter(|_| testimony.condemns()) else {
                kept.push(component);
                continue;
            };
            self.undone.push(record(graph, &component, strongest, options));
            let refusal = Refusal::Contradicted {
                against: testimony.contradictions.len(),
                agreeing: testimony.agreeing,
            };
            for scan in component.poses.into_keys() {
                self.doubted.insert(scan);
                self.waiting.insert(scan, Some(refusal));
            }
            undone += 1;
        }
        self.components = kept;
        undone
    }
}

impl Mapper {
    /// The component with the waiting scans that fit it at more than one pose, at their best: they are witnesses too.
    fn with_torn(
        &self,
        graph: &ScanGraph,
        component: &Component,
        voxel: f64,
        options: &MappingOptions,
    ) -> Component {
        let mut more = component.clone();
        for (scan, refusal) in &self.waiting {
            if let Some(Refusal::Rival { .. }) = refusal
                && let Some(best) =
                    best_candidate(graph, component, &Component::single(*scan), voxel, options)
            {
                more.poses.insert(*scan, best.a_from_b);
            }
        }
        more
    }
}

fn record(
    graph: &ScanGraph,
    component: &Component,
    strongest: &Contradiction,
    options: &MappingOptions,
) -> Undone {
    let supports = supports(graph, component, options);
    let mut evidence = firmest_path(&supports, strongest.pair.a, strongest.pair.b);
    let support_before = evidence
        .windows(2)
        .filter_map(|step| supports.get(&(step[0].min(step[1]), step[0].max(step[1]))))
        .copied()
        .fold(f64::INFINITY, f64::min);
    evidence.push(strongest.pair.a);
    Undone {
        scans: component.poses.keys().copied().collect(),
        evidence,
        angle: strongest.angle,
        distance: strongest.distance,
        support_before: if support_before.is_finite() { support_before } else { 0.0 },
        support_elsewhere: strongest.evidence,
    }
}

/// The path between two scans whose weakest edge is strongest, both ends included; the two alone if nothing links them.
fn firmest_path(supports: &BTreeMap<(ScanKey, ScanKey), f64>, from: ScanKey, to: ScanKey) -> Vec<ScanKey> {
    let mut links: BTreeMap<ScanKey, Vec<(ScanKey, f64)>> = BTreeMap::new();
    for ((a, b), support) in supports {
        // The pair itself is what contradicts.
        if (*a, *b) != (from.min(to), from.max(to)) {
            links.entry(*a).or_default().push((*b, *support));
            links.entry(*b).or_default().push((*a, *support));
        }
    }
    let mut reached: BTreeMap<ScanKey, (f64, ScanKey)> = BTreeMap::from([(from, (f64::INFINITY, from))]);
    let mut open: BTreeSet<ScanKey> = BTreeSet::from([from]);
    while let Some(next) =
        open.iter().copied().max_by(|x, y| reached[x].0.total_cmp(&reached[y].0).then(y.cmp(x)))
    {
        open.remove(&next);
        let width = reached[&next].0;
        for (other, support) in links.get(&next).into_iter().flatten() {
            let through = width.min(*support);
            if reached.get(other).is_none_or(|(known, _)| through > *known) {
                reached.insert(*other, (through, next));
                open.insert(*other);
            }
        }
    }
    let mut path = vec![to];
    let mut at = to;
    while at != from {
        let Some((_, before)) = reached.get(&at) else { return vec![from, to] };
        at = *before;
        path.push(at);
    }
    path.reverse();
    path
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_proof_goes_around_by_the_firmest_edges() {
        let key = ScanKey;
        let supports = BTreeMap::from([
            ((key(1), key(2)), 5.0),
            ((key(2), key(3)), 4.0),
            ((key(1), key(4)), 9.0),
            ((key(3), key(4)), 1.0),
            ((key(1), key(3)), 20.0),
        ]);
        assert_eq!(firmest_path(&supports, key(1), key(3)), [key(1), key(2), key(3)]);
        assert_eq!(firmest_path(&supports, key(3), key(9)), [key(3), key(9)]);
    }
}
