//! Taking back what later evidence contradicts. Where the pairs that speak against a component all speak against one join in it, or some of its
//! scans fit the rest clearly better elsewhere, or its sides turn out to stand in each other's free space, that join is undone and its pose is
//! not tried again; where they are too many for that, and say the same, or where pairs deny what all others make of them, alike places were folded
//! onto each other: nothing there can be told from its twin, so nothing is kept, and the scans wait until a new scan or a decision changes what
//! is known.

use std::collections::{BTreeMap, BTreeSet};

use super::candidates::best_candidate;
use super::component::Component;
use super::consistency::supports;
use super::cuts::{separating_cut, smaller_side};
use super::decision::{Decision, between_own_frames};
use super::denial::denied;
use super::hearing::{Verdict, hear};
use super::intrusion::{Intrusion, intrusion};
use super::join::Refusal;
use super::mapper::Mapper;
use super::open_join::Undone;
use super::options::MappingOptions;
use super::testimony::{Contradiction, Testimony, testimony};
use super::undecided::{Undecided, undecided};
use super::voice::{Word, loudest, one_voice};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// A join is undone when what pairs with one voice say against it comes to this share of its support …
const AGAINST_SHARE: f64 = 0.5;
/// … and without asking whether places are alike when it comes to this: of alike places, either has much for it. Where such were folded
/// onto each other it comes to 1.2 at most.
const OVERWHELMING_SHARE: f64 = 2.0;
/// … and at least this many pairs say the same.
const AGAINST_PAIRS: usize = 2;
/// Contradictions whose separation is tried, the strongest first.
const TRIED: usize = 8;

/// What is to be done about a component, given what speaks against it.
enum Finding {
    /// Nothing.
    Sound,
    /// Alike places were taken for one, or nothing tells which of two is right: nothing of it is kept.
    Folded { strongest: Contradiction },
    /// One join in it is wrong: that of this side.
    Torn { side: BTreeSet<ScanKey>, strongest: Contradiction },
    /// It is open where these few scans belong.
    Open { scans: BTreeSet<ScanKey>, strongest: Contradiction },
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
        // Components of which a part turned out to be folded, with what was said of it.
        let mut folded: BTreeMap<usize, Testimony> = BTreeMap::new();
        let mut bans = None;
        while let Some((origin, mut component)) = pending.pop() {
            control.check()?;
            // Where a client joined scans, the client has the last word.
            let holds = |scan| component.poses.contains_key(&scan);
            if options.decisions.joined_pairs().any(|pair| holds(pair.a) && holds(pair.b)) {
                self.components.push(component);
                continue;
            }
            let supports = supports(graph, &component, options);
            let asked = self.with_torn(graph, &component, voxel, options);
            let mut testimony = testimony(graph, &asked, options);
            let waits = asked.poses.keys().copied().filter(|scan| !holds(*scan)).collect();
            testimony.cross_examine(graph, &asked, &waits, options, control)?;
            match finding(graph, &component, &supports, &testimony, voxel, options, control)? {
                Finding::Sound => sound.push((origin, component)),
                Finding::Folded { strongest } => {
                    bans.get_or_insert_with(Vec::new);
                    let scans = component.poses.keys().copied().collect();
                    self.undone.push(record(&supports, scans, &strongest));
                    self.doubt(component, &testimony);
                    folded.insert(origin, testimony);
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
                    if let Some(few) = component.split_off(&scans, options) {
                        self.doubt(few, &testimony);
                    }
                    pending.push((origin, component));
                }
            }
        }
        // What a folded component came apart into is of the same alike places.
        for (origin, component) in sound {
            match folded.get(&origin) {
                Some(testimony) => self.doubt(component, testimony),
                None => self.components.push(component),
            }
        }
        graph.forget_fine();
        self.dissolve_small();
        self.sort_components();
        Ok(bans)
    }

    /// Lets the scans of a component wait, and not be joined before all is decided anew.
    fn doubt(&mut self, component: Component, testimony: &Testimony) {
        let refusal =
            Refusal::Contradicted { against: testimony.contradictions.len(), agreeing: testimony.agreeing };
        for scan in component.poses.into_keys() {
            self.doubted.insert(scan);
            self.waiting.insert(scan, Some(refusal));
        }
    }
}

fn finding(
    graph: &ScanGraph,
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    testimony: &Testimony,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Finding, Cancelled> {
    let tear = |share: f64| tear(graph, component, supports, testimony, share, options, control);
    let condemned = testimony.contradictions.first().copied().filter(|_| testimony.condemns());
    // Who waits already need not be taken out.
    let moved = match &testimony.verdict {
        Some(Verdict::Moves { scans, motion, clearly }) => condemned
            .zip(part_of(component, scans))
            .map(|(strongest, side)| Moved { side, motion: *motion, clearly: *clearly, strongest }),
        _ => None,
    };
    if let Some(moved) = &moved
        && moved.clearly
    {
        return Ok(moved.torn(component));
    }
    if let Some(strongest) = denied(graph, component, options) {
        return Ok(Finding::Folded { strongest });
    }
    if let Some(moved) = moved {
        let settled = moved.settles(graph, component, options, control)?;
        let strongest = moved.strongest;
        return Ok(if settled { moved.torn(component) } else { Finding::Folded { strongest } });
    }
    if let Some((side, strongest)) = tear(OVERWHELMING_SHARE)? {
        return Ok(Finding::Torn { side, strongest });
    }
    match (condemned, &testimony.verdict) {
        (Some(strongest), Some(Verdict::Open(scans))) => {
            if let Some(scans) = part_of(component, scans) {
                return Ok(Finding::Open { scans, strongest });
            }
        }
        (None, _) | (_, Some(Verdict::Moves { .. })) => {}
        (Some(strongest), _) => return Ok(Finding::Folded { strongest }),
    }
    if let Some((side, strongest)) = tear(AGAINST_SHARE)? {
        return Ok(Finding::Torn { side, strongest });
    }
    match undecided(graph, component, testimony, voxel, options, control)? {
        Some(Undecided { strongest, rivals: true, .. }) => return Ok(Finding::Folded { strongest }),
        Some(Undecided { side, strongest, .. }) => return Ok(Finding::Torn { side, strongest }),
        None => {}
    }
    Ok(match intrusion(graph, component, supports, options, control)? {
        Some(Intrusion { side, shown_by }) => {
            Finding::Torn { side: smaller_side(component, side), strongest: shown_by }
        }
        None => Finding::Sound,
    })
}

/// Scans of a component that fit the rest better elsewhere.
struct Moved {
    side: BTreeSet<ScanKey>,
    /// In the frame of the component.
    motion: Pose,
    clearly: bool,
    strongest: Contradiction,
}

impl Moved {
    fn torn(&self, component: &Component) -> Finding {
        Finding::Torn { side: smaller_side(component, self.side.clone()), strongest: self.strongest }
    }

    /// Whether nothing that a hearing does not refute would be said against the component any more if they were there. Where there are more
    /// alike places than two, one move does not put them right.
    fn settles(
        &self,
        graph: &ScanGraph,
        component: &Component,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<bool, Cancelled> {
        let mut there = component.clone();
        for (scan, pose) in &mut there.poses {
            if self.side.contains(scan) {
                *pose = self.motion * *pose;
            }
        }
        let mut testimony = testimony(graph, &there, options);
        testimony.cross_examine(graph, &there, &BTreeSet::new(), options, control)?;
        Ok(!testimony.condemns())
    }
}

/// Those of the scans that the component holds, if they are some and not all of its.
fn part_of(component: &Component, scans: &BTreeSet<ScanKey>) -> Option<BTreeSet<ScanKey>> {
    let held: BTreeSet<ScanKey> =
        scans.iter().filter(|scan| component.poses.contains_key(scan)).copied().collect();
    (!held.is_empty() && held.len() < component.len()).then_some(held)
}

/// Where a component comes apart: a cut between two contradicting scans that what speaks against it with one voice outweighs by this share
/// of its support, unless a hearing refutes that voice; by its smaller side, and the pair that shows it.
fn tear(
    graph: &ScanGraph,
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    testimony: &Testimony,
    share: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<(BTreeSet<ScanKey>, Contradiction)>, Cancelled> {
    let inside: Vec<&Contradiction> = testimony.inside(component).collect();
    let mut refuted: BTreeSet<BTreeSet<ScanKey>> = BTreeSet::new();
    for strongest in inside.iter().take(TRIED) {
        let Some((side, support)) = separating_cut(component, supports, strongest.pair.a, strongest.pair.b)
        else {
            break;
        };
        if refuted.contains(&side) {
            continue;
        }
        let words = Word::on_side(graph, component, &side, &inside, options);
        let against = one_voice(&words, options.rival_angle);
        if against.pairs >= AGAINST_PAIRS && against.evidence >= share * support {
            let voice = loudest(&words, options.rival_angle);
            if hear(graph, component, &voice, &BTreeSet::new(), options, control)? != Verdict::Refuted {
                return Ok(Some((smaller_side(component, side), **strongest)));
            }
            refuted.insert(side);
        }
    }
    Ok(None)
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
