//! Taking back what later evidence contradicts. Where the pairs that speak against a component all speak against one join in it, or some of its
//! scans fit the rest clearly better elsewhere, or its sides turn out to stand in each other's free space, that join is undone and its pose is
//! not tried again; where they are too many for that, and say the same, or where pairs deny what all others make of them, alike places were folded
//! onto each other: nothing there can be told from its twin, so nothing is kept, and the scans wait until a new scan or a decision changes what
//! is known. What one pair alone holds together, and looks like it, waits along.

use std::collections::{BTreeMap, BTreeSet};

use super::candidates::best_candidate;
use super::component::Component;
use super::consistency::supports;
use super::decision::{Decision, between_own_frames};
use super::finding::{Case, Finding};
use super::join::Refusal;
use super::mapper::Mapper;
use super::open_join::Undone;
use super::options::MappingOptions;
use super::testimony::{Contradiction, Testimony, testimony};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;

/// Scans of a component that one pair holds together. Where places are alike, they may be of two of them.
const PAIR: usize = 2;
/// Where scans are found open one after the other, they may come to one in so many. If they are more, the places are alike, and those that are left are
/// only quiet because the scans that contradict them are gone. Warehouses that were assembled right had one such scan of twenty at most; a row
/// of identical rooms, three of thirteen.
const OPEN_OF: usize = 10;

/// A component in which alike places were taken for one.
struct Fold {
    scans: Vec<ScanKey>,
    supports: BTreeMap<(ScanKey, ScanKey), f64>,
    testimony: Testimony,
    strongest: Contradiction,
}

impl Fold {
    /// Whether some pair would have scans of a component beside those that were folded.
    fn looks_like(&self, graph: &ScanGraph, component: &Component) -> bool {
        let pairs = component.poses.keys().flat_map(|x| self.scans.iter().map(move |y| (*x, *y)));
        let mut edges = pairs.filter_map(|(x, y)| graph.edge(x, y));
        edges.any(|edge| edge.hypotheses.iter().any(|h| h.score.max(h.hypothesis.logit) > 0.0))
    }
}

impl Mapper {
    /// Undoes what pairs contradict. Returns the poses that are not to be tried again while the model grows, or `None` if nothing
    /// was undone.
    pub fn undo_contradicted(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Option<Vec<Decision>>, Cancelled> {
        let mut pending: Vec<(usize, Component)> =
            std::mem::take(&mut self.components).into_iter().enumerate().collect();
        let mut sound: Vec<(usize, Component)> = Vec::new();
        // Components of which a part turned out to be folded, with what was said of it: what else they came apart into is of the same alike
        // places.
        let mut folded: BTreeMap<usize, Fold> = BTreeMap::new();
        let sizes: Vec<usize> = pending.iter().map(|(_, component)| component.len()).collect();
        // How many of their scans were found open, or torn off after such.
        let mut opened: BTreeMap<usize, usize> = BTreeMap::new();
        let mut bans = None;
        while let Some((origin, mut component)) = pending.pop() {
            control.check()?;
            // Where a client joined scans, the client has the last word.
            let holds = |scan| component.poses.contains_key(&scan);
            if options.decisions.joined_pairs().any(|pair| holds(pair.a) && holds(pair.b)) {
                self.components.push(component);
                continue;
            }
            if folded.contains_key(&origin) {
                sound.push((origin, component));
                continue;
            }
            let supports = supports(graph, &component, options);
            let asked = self.with_torn(graph, &component, voxel, options);
            let mut testimony = testimony(graph, &asked, options);
            let waits = asked.poses.keys().copied().filter(|scan| !holds(*scan)).collect();
            testimony.cross_examine(graph, &asked, &waits, options, control)?;
            let case =
                Case { graph, component: &component, supports: &supports, testimony: &testimony, options };
            let mut finding = case.finding(&asked, &waits, voxel, control)?;
            let before = opened.get(&origin).copied().unwrap_or_default();
            let leaving = match &finding {
                Finding::Open { scans, strongest } => Some((scans.len(), *strongest)),
                // Of alike places, what is torn off after scans were found open is as likely what shows that the rest is folded.
                Finding::Torn { side, strongest } if before > 0 => Some((side.len(), *strongest)),
                _ => None,
            };
            if let Some((count, strongest)) = leaving {
                opened.insert(origin, before + count);
                if are_alike(before, count, sizes[origin]) {
                    finding = Finding::Folded { strongest };
                }
            }
            match finding {
                Finding::Sound => sound.push((origin, component)),
                Finding::Folded { strongest } => {
                    bans.get_or_insert_with(Vec::new);
                    let scans = scans_of(&component);
                    self.undone.push(record(&supports, scans.clone(), &strongest));
                    self.doubt(component, &testimony);
                    folded.insert(origin, Fold { scans, supports, testimony, strongest });
                }
                Finding::Torn { side, strongest } => {
                    bans.get_or_insert_with(Vec::new).extend(ban(graph, &component, &supports, &side));
                    self.undone.push(record(&supports, side.iter().copied().collect(), &strongest));
                    pending.extend(component.split_off(&side, options).map(|part| (origin, part)));
                    pending.push((origin, component));
                }
                Finding::Open { scans, strongest } => {
                    bans.get_or_insert_with(Vec::new);
                    self.undone.push(record(&supports, scans.iter().copied().collect(), &strongest));
                    let few = component.split_off(&scans, options);
                    for scan in few.into_iter().flat_map(|few| few.poses.into_keys()) {
                        self.set_aside.insert(scan);
                        self.waiting.insert(scan, Some(refusal(&testimony)));
                    }
                    pending.push((origin, component));
                }
            }
        }
        for (origin, component) in sound {
            let alike =
                || folded.values().find(|fold| component.len() == PAIR && fold.looks_like(graph, &component));
            match folded.get(&origin).or_else(alike) {
                Some(fold) => {
                    self.undone.push(record(&fold.supports, scans_of(&component), &fold.strongest));
                    self.doubt(component, &fold.testimony);
                }
                None => self.components.push(component),
            }
        }
        graph.forget_fine_of_many();
        self.dissolve_small();
        self.sort_components();
        Ok(bans)
    }

    /// Lets the scans of a component wait, and not be joined before all is decided anew.
    fn doubt(&mut self, component: Component, testimony: &Testimony) {
        for scan in component.poses.into_keys() {
            self.doubted.insert(scan);
            self.waiting.insert(scan, Some(refusal(testimony)));
        }
    }
}

/// Whether places are alike of which it is open where more and more scans belong: those found open before, and those that leave now, of so many
/// at first.
const fn are_alike(before: usize, now: usize, of: usize) -> bool {
    before > 0 && OPEN_OF * (before + now) > of
}

fn refusal(testimony: &Testimony) -> Refusal {
    Refusal::Contradicted { against: testimony.contradictions.len(), agreeing: testimony.agreeing }
}

fn scans_of(component: &Component) -> Vec<ScanKey> {
    component.poses.keys().copied().collect()
}

/// Forbids the pose that a join had, by its strongest edge.
fn ban(
    graph: &ScanGraph,
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    side: &BTreeSet<ScanKey>,
) -> Option<Decision> {
    let across = supports.iter().filter(|((a, b), _)| side.contains(a) != side.contains(b));
    let ((a, b), _) = across.max_by(|x, y| x.1.total_cmp(y.1).then(y.0.cmp(x.0)))?;
    let local = component.poses.get(a)?.inverse() * *component.poses.get(b)?;
    Some(Decision::forbid(*a, *b, Some(&between_own_frames(graph, *a, *b, &local)?)))
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
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    scans: Vec<ScanKey>,
    strongest: &Contradiction,
) -> Undone {
    let mut evidence = firmest_path(supports, strongest.pair.a, strongest.pair.b);
    let support_before = evidence
        .windows(2)
        .filter_map(|step| supports.get(&(step[0].min(step[1]), step[0].max(step[1]))))
        .copied()
        .fold(f64::INFINITY, f64::min);
    evidence.push(strongest.pair.a);
    Undone {
        scans,
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
    use crate::control::{CancelToken, Silent};
    use crate::mapping::test_hall::Model;

    #[test]
    fn a_scan_at_the_wrong_end_of_a_hall_is_taken_out_and_the_others_stay() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let voxel = model.hall.resolution;
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let undo = |component: Component| {
            let mut mapper = Mapper { components: vec![component], ..Mapper::default() };
            let bans = mapper.undo_contradicted(&model.graph, voxel, &options, control);
            (mapper, bans.expect("nobody cancels"))
        };
        let (mapper, bans) = undo(model.with_turned(&[5]));
        // Nothing speaks for the pose that it had, so there is none to forbid.
        assert!(bans.is_some_and(|bans| bans.is_empty()));
        assert_eq!(mapper.components.len(), 1);
        let left: Vec<ScanKey> = mapper.components[0].poses.keys().copied().collect();
        assert_eq!(left, [1, 2, 3, 4, 6].map(ScanKey));
        assert!(mapper.waiting.contains_key(&ScanKey(5)) && mapper.doubted.is_empty());
        assert_eq!(mapper.undone.len(), 1);
        let (mapper, bans) = undo(model.component.clone());
        assert!(bans.is_none() && mapper.components[0].len() == 6 && mapper.undone.is_empty());
    }

    #[test]
    fn where_rooms_are_alike_what_one_pair_holds_together_waits_too() {
        let model = Model::new(9);
        let options = MappingOptions::default();
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let waiting = |graph: &ScanGraph, others: BTreeSet<ScanKey>| {
            let mut large = model.component.clone();
            let small = large.split_off(&others, &options);
            let components = small.into_iter().chain([large]).collect();
            let mut mapper = Mapper { components, ..Mapper::default() };
            mapper
                .undo_contradicted(graph, model.hall.resolution, &options, control)
                .expect("nobody cancels");
            assert_eq!(mapper.waiting.keys().copied().collect::<BTreeSet<_>>(), mapper.doubted);
            mapper.waiting.len()
        };
        let (pair, three) = (BTreeSet::from([8, 9].map(ScanKey)), BTreeSet::from([7, 8, 9].map(ScanKey)));
        let no = |a, b| ((a, b), -3.0, 40);
        let denied = model.graph_where(&[no(1, 2), no(3, 4), no(5, 6)], 600, 0.1);
        assert_eq!(waiting(&denied, pair.clone()), 9);
        assert_eq!(waiting(&denied, three), 6);
        assert_eq!(waiting(&model.graph_where(&[], 600, 0.1), pair), 0);
    }

    #[test]
    fn one_open_scan_is_an_exception_and_one_after_the_other_are_none() {
        assert!(!are_alike(0, 1, 13) && !are_alike(0, 2, 13));
        assert!(are_alike(1, 1, 13));
        assert!(!are_alike(1, 1, 20) && are_alike(2, 1, 20));
    }

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
