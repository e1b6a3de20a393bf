//! How firmly the scans of a component hold together: the support that edges give to the poses as they are, the weakest cut through
//! it, and which scans an adjustment threw off their edges.

use std::collections::{BTreeMap, BTreeSet};

use super::candidates::DECIDED;
use super::component::Component;
use super::options::MappingOptions;
use super::voice::{Voice, Word, one_voice};
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph, softplus};
use crate::pairwise::{PairKey, centred_difference};

/// An adjustment threw a scan when it keeps less than this share of its support …
const KEPT_SHARE: f64 = 0.5;
/// … and lost at least this much, or what the most lenient join asks for.
const LEAST_LOSS: f64 = 2.0;

/// The evidence of the best hypothesis of an edge that agrees with a pose of its scans.
#[must_use]
pub fn edge_support(graph: &ScanGraph, edge: &Edge, a_from_b: &Pose, options: &MappingOptions) -> f64 {
    let Some(b) = graph.scan(edge.pair.b) else { return 0.0 };
    let reach = options.cluster_voxels * b.prepared.resolution;
    edge.hypotheses
        .iter()
        .filter(|h| {
            let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, a_from_b, &b.centroid);
            angle < options.cluster_angle && distance < reach
        })
        .map(|h| softplus(h.score))
        .fold(0.0, f64::max)
}

/// Support between all pairs of a component's scans at its poses; pairs without any are left out. What a client joined is firm.
#[must_use]
pub fn supports(
    graph: &ScanGraph,
    component: &Component,
    options: &MappingOptions,
) -> BTreeMap<(ScanKey, ScanKey), f64> {
    let mut found = BTreeMap::new();
    for (a, model_from_a) in &component.poses {
        for b in graph.neighbors(*a).filter(|b| b > a) {
            let (Some(model_from_b), Some(edge)) = (component.poses.get(&b), graph.edge(*a, b)) else {
                continue;
            };
            let support = edge_support(graph, edge, &(model_from_a.inverse() * *model_from_b), options);
            if support > 0.0 {
                found.insert((*a, b), support);
            }
        }
    }
    for pair in options.decisions.joined_pairs() {
        if component.poses.contains_key(&pair.a) && component.poses.contains_key(&pair.b) {
            found.insert((pair.a, pair.b), DECIDED);
        }
    }
    found
}

/// Support of each scan: the sum over its pairs.
#[must_use]
pub fn support_by_scan(
    graph: &ScanGraph,
    component: &Component,
    options: &MappingOptions,
) -> BTreeMap<ScanKey, f64> {
    let mut sums: BTreeMap<ScanKey, f64> = component.poses.keys().map(|key| (*key, 0.0)).collect();
    for ((a, b), support) in supports(graph, component, options) {
        *sums.entry(a).or_default() += support;
        *sums.entry(b).or_default() += support;
    }
    sums
}

/// The scans that `after` holds much less firmly than `before`.
#[must_use]
pub fn thrown(
    graph: &ScanGraph,
    before: &Component,
    after: &Component,
    options: &MappingOptions,
) -> Vec<ScanKey> {
    let needed = options.levels.last().map_or(0.0, |level| level.support);
    let had = support_by_scan(graph, before, options);
    let has = support_by_scan(graph, after, options);
    had.into_iter()
        .filter(|(key, had)| {
            let has = has.get(key).copied().unwrap_or(0.0);
            has < KEPT_SHARE * had && (had - has > LEAST_LOSS || (*had >= needed && has < needed))
        })
        .map(|(key, _)| key)
        .collect()
}

/// A side that hangs on the rest of a component by less than `least` support, at its weakest cut: the side with fewer scans (Stoer, Wagner:
/// "A simple min-cut algorithm", JACM 1997). `None` if there is none. Scans that a single pair holds by as much are never parted, so they
/// count as one: of a component that holds together well nothing is left to be cut.
#[must_use]
pub fn loose_side(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    least: f64,
) -> Option<BTreeSet<ScanKey>> {
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index: BTreeMap<ScanKey, usize> = keys.iter().enumerate().map(|(i, key)| (*key, i)).collect();
    let links =
        || supports.iter().filter_map(|((a, b), support)| Some((*index.get(a)?, *index.get(b)?, *support)));
    let groups = tied(keys.len(), links().filter(|(_, _, support)| *support >= least));
    let mut group_of = vec![0; keys.len()];
    for (group, members) in groups.iter().enumerate() {
        for scan in members {
            group_of[*scan] = group;
        }
    }
    let n = groups.len();
    let mut weight = vec![vec![0.0_f64; n]; n];
    for (a, b, support) in links() {
        let (i, j) = (group_of[a], group_of[b]);
        if i != j {
            weight[i][j] += support;
            weight[j][i] += support;
        }
    }
    let (side, cut) = weakest_cut(weight, groups)?;
    let side: BTreeSet<ScanKey> = side.into_iter().map(|i| keys[i]).collect();
    (cut < least).then(|| smaller_side(component, side))
}

/// The same cut by the side with fewer scans.
#[must_use]
pub fn smaller_side(component: &Component, side: BTreeSet<ScanKey>) -> BTreeSet<ScanKey> {
    if 2 * side.len() > component.len() {
        component.poses.keys().filter(|key| !side.contains(key)).copied().collect()
    } else {
        side
    }
}

/// Groups of `n` scans that these links tie to each other.
fn tied(n: usize, links: impl Iterator<Item = (usize, usize, f64)>) -> Vec<Vec<usize>> {
    let mut neighbors: Vec<Vec<usize>> = vec![Vec::new(); n];
    for (a, b, _) in links {
        neighbors[a].push(b);
        neighbors[b].push(a);
    }
    let mut seen = vec![false; n];
    let mut groups = Vec::new();
    for first in 0..n {
        if std::mem::replace(&mut seen[first], true) {
            continue;
        }
        let mut group = vec![first];
        let mut at = 0;
        while let Some(scan) = group.get(at).copied() {
            at += 1;
            for other in &neighbors[scan] {
                if !std::mem::replace(&mut seen[*other], true) {
                    group.push(*other);
                }
            }
        }
        groups.push(group);
    }
    groups
}

/// The weakest cut through groups that hold together by `weight`: the members on one side, and the weight across. `None` for fewer than
/// two groups.
fn weakest_cut(mut weight: Vec<Vec<f64>>, mut groups: Vec<Vec<usize>>) -> Option<(Vec<usize>, f64)> {
    let n = groups.len();
    let mut alive: Vec<usize> = (0..n).collect();
    let mut best: Option<(Vec<usize>, f64)> = None;
    while alive.len() > 1 {
        let mut tied = vec![0.0_f64; n];
        let mut left = alive.clone();
        let mut last = (left[0], left[0]);
        let mut cut = 0.0;
        while !left.is_empty() {
            let at =
                (0..left.len()).max_by(|&x, &y| tied[left[x]].total_cmp(&tied[left[y]]).then(y.cmp(&x)))?;
            let next = left.remove(at);
            last = (last.1, next);
            cut = tied[next];
            for &other in &left {
                tied[other] += weight[next][other];
            }
        }
        let (kept, merged) = last;
        if best.as_ref().is_none_or(|(_, least)| cut < *least) {
            best = Some((groups[merged].clone(), cut));
        }
        let moved = std::mem::take(&mut groups[merged]);
        groups[kept].extend(moved);
        for other in 0..n {
            let extra = weight[merged][other];
            weight[kept][other] += extra;
            weight[other][kept] += extra;
        }
        weight[kept][kept] = 0.0;
        alive.retain(|i| *i != merged);
    }
    best
}

/// The cut of least support that separates two scans of a component: the side of `from`, and the support across (Edmonds, Karp:
/// "Theoretical improvements in algorithmic efficiency for network flow problems", JACM 1972).
#[must_use]
pub fn separating_cut(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    from: ScanKey,
    to: ScanKey,
) -> Option<(BTreeSet<ScanKey>, f64)> {
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index: BTreeMap<ScanKey, usize> = keys.iter().enumerate().map(|(i, key)| (*key, i)).collect();
    let (&source, &sink) = (index.get(&from)?, index.get(&to)?);
    let n = keys.len();
    let mut spare = vec![0.0_f64; n * n];
    for ((a, b), support) in supports {
        if let (Some(&i), Some(&j)) = (index.get(a), index.get(b)) {
            spare[i * n + j] += support;
            spare[j * n + i] += support;
        }
    }
    let mut flow = 0.0;
    loop {
        let mut before: Vec<Option<usize>> = vec![None; n];
        before[source] = Some(source);
        let mut queue = std::collections::VecDeque::from([source]);
        while let Some(i) = queue.pop_front() {
            for j in 0..n {
                if before[j].is_none() && spare[i * n + j] > NO_SUPPORT {
                    before[j] = Some(i);
                    queue.push_back(j);
                }
            }
        }
        if before[sink].is_none() {
            let side = (0..n).filter(|i| before[*i].is_some()).map(|i| keys[i]).collect();
            return Some((side, flow));
        }
        let mut path = Vec::new();
        let mut at = sink;
        while at != source {
            let previous = before[at]?;
            path.push((previous, at));
            at = previous;
        }
        let least = path.iter().map(|(i, j)| spare[i * n + j]).fold(f64::INFINITY, f64::min);
        for (i, j) in path {
            spare[i * n + j] -= least;
            spare[j * n + i] += least;
        }
        flow += least;
    }
}

/// Support below this is none.
const NO_SUPPORT: f64 = 1e-6;

/// A pair says that much by itself (softplus of its log-odds) when it counts as a witness: a likelihood of 0.86.
const WITNESS: f64 = 2.0;
/// A pair speaks against a component only if its pose differs by this many times what makes a rival.
pub const CLEARLY_DIFFERENT: f64 = 2.0;
/// A component is contradicted when what is said against it with one voice, beyond a witness's least, comes to this for each witness for
/// it …
const CONTRADICTED_WEIGHT: f64 = 0.03;
/// … and at least to this, …
const CONTRADICTED_LEAST: f64 = 3.0;
/// … by at least this many pairs.
const CONTRADICTED_PAIRS: usize = 2;

/// A pair of scans in one component whose own evidence is for another pose than the one they have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contradiction {
    /// Which pair.
    pub pair: PairKey,
    /// The other pose, between the local frames of the pair's scans.
    pub a_from_b: Pose,
    /// softplus of the log-odds of the other pose, by the pair alone.
    pub evidence: f64,
    /// Angle between the two poses, radians.
    pub angle: f64,
    /// How far apart they put the centroid of the pair's second scan, metres.
    pub distance: f64,
}

/// What pairs say by themselves of a component's poses. Third scans are not asked: where rooms are alike, they repeat what is wrong
/// until it drowns what is right.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Testimony {
    /// Pairs that are sure of the pose they have.
    pub agreeing: usize,
    /// Pairs that are sure of another, the surest first.
    pub contradictions: Vec<Contradiction>,
    /// Of these, what most say alike.
    pub voice: Voice,
}

impl Testimony {
    /// Whether too much is said against the component for it to be right. Where all is right, chance says a different thing each time, at
    /// most 0.012 for each witness; where alike rooms were folded onto each other, one voice says 0.04 and more, mostly far more.
    #[must_use]
    pub fn condemns(&self) -> bool {
        let weight = self.voice.evidence - WITNESS * self.voice.pairs as f64;
        self.voice.pairs >= CONTRADICTED_PAIRS
            && weight >= (CONTRADICTED_WEIGHT * self.agreeing as f64).max(CONTRADICTED_LEAST)
    }

    /// The contradictions between scans of a component, the surest first.
    pub fn inside<'t>(&'t self, component: &'t Component) -> impl Iterator<Item = &'t Contradiction> {
        let within = |scan: ScanKey| component.poses.contains_key(&scan);
        self.contradictions.iter().filter(move |c| within(c.pair.a) && within(c.pair.b))
    }
}

/// Asks every pair of a component's scans. Pairs that a client decided about are not asked.
#[must_use]
pub fn testimony(graph: &ScanGraph, component: &Component, options: &MappingOptions) -> Testimony {
    let mut found = Testimony::default();
    for (a, model_from_a) in &component.poses {
        for b in graph.neighbors(*a).filter(|b| b > a) {
            let (Some(model_from_b), Some(edge), Some(scan)) =
                (component.poses.get(&b), graph.edge(*a, b), graph.scan(b))
            else {
                continue;
            };
            if options.decisions.concern(edge.pair) {
                continue;
            }
            let now = model_from_a.inverse() * *model_from_b;
            let reach = options.rival_voxels * scan.prepared.resolution;
            let mut agreeing = 0.0_f64;
            let mut other: Option<Contradiction> = None;
            for h in &edge.hypotheses {
                let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &now, &scan.centroid);
                let evidence = softplus(h.hypothesis.logit);
                if angle < options.rival_angle && distance < reach {
                    agreeing = agreeing.max(evidence).max(softplus(h.score));
                } else if (angle > CLEARLY_DIFFERENT * options.rival_angle
                    || distance > CLEARLY_DIFFERENT * reach)
                    && other.is_none_or(|known| evidence > known.evidence)
                {
                    let a_from_b = h.hypothesis.a_from_b;
                    other = Some(Contradiction { pair: edge.pair, a_from_b, evidence, angle, distance });
                }
            }
            match other {
                Some(other) if other.evidence > WITNESS && other.evidence > agreeing => {
                    found.contradictions.push(other);
                }
                _ => found.agreeing += usize::from(agreeing > WITNESS),
            }
        }
    }
    found.contradictions.sort_by(|x, y| y.evidence.total_cmp(&x.evidence).then(x.pair.cmp(&y.pair)));
    let words = Word::both_ways(graph, component, &found.contradictions, options);
    found.voice = one_voice(&words, options.rival_angle);
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::tracks::Tracks;

    fn six() -> Component {
        Component {
            gauge: ScanKey(1),
            poses: (1..=6).map(|k| (ScanKey(k), Pose::identity())).collect(),
            tracks: Tracks::default(),
        }
    }

    #[test]
    fn two_scans_are_separated_where_least_holds_them_together() {
        let key = ScanKey;
        let links =
            [(1, 2, 5.0), (2, 3, 5.0), (1, 3, 5.0), (4, 5, 6.0), (5, 6, 0.1), (4, 6, 0.1), (3, 4, 1.5)];
        let supports = links.iter().map(|&(a, b, w)| ((key(a), key(b)), w)).collect();
        let (side, cut) = separating_cut(&six(), &supports, key(1), key(5)).unwrap();
        assert_eq!(side, BTreeSet::from([key(1), key(2), key(3)]));
        assert!((cut - 1.5).abs() < 1e-9);
        let (side, cut) = separating_cut(&six(), &supports, key(6), key(1)).unwrap();
        assert_eq!(side, BTreeSet::from([key(6)]));
        assert!((cut - 0.2).abs() < 1e-9);
    }

    #[test]
    fn what_pairs_say_by_chance_does_not_add_up_but_one_voice_condemns() {
        let said = |evidence: f64| Contradiction {
            pair: PairKey::of(ScanKey(1), ScanKey(2)),
            a_from_b: Pose::identity(),
            evidence,
            angle: 3.0,
            distance: 4.0,
        };
        let contradictions: Vec<Contradiction> = [8.0, 6.0, 5.0, 4.0].map(said).to_vec();
        let voiced = |pairs: usize, evidence: f64| Testimony {
            agreeing: 100,
            contradictions: contradictions.clone(),
            voice: Voice { pairs, evidence },
        };
        assert!(!voiced(1, 8.0).condemns());
        assert!(voiced(3, 15.0).condemns());
        // Two that hardly believe it themselves are still chance.
        assert!(!voiced(2, 4.5).condemns());
    }

    #[test]
    fn what_hangs_on_the_rest_by_little_is_found() {
        let key = ScanKey;
        let component = six();
        // Two triangles joined by a light edge and a lighter one.
        let links =
            [(1, 2, 5.0), (2, 3, 5.0), (1, 3, 5.0), (4, 5, 6.0), (5, 6, 6.0), (3, 4, 1.5), (2, 5, 0.5)];
        let supports = links.iter().map(|&(a, b, w)| ((key(a), key(b)), w)).collect();
        // Both at once are more than 1.9 and less than 2.1; no scan of a triangle hangs on by so little.
        assert_eq!(loose_side(&component, &supports, 1.9), None);
        let side = loose_side(&component, &supports, 2.1).expect("the triangles hang on each other by 2");
        assert!(
            side == BTreeSet::from([key(1), key(2), key(3)])
                || side == BTreeSet::from([key(4), key(5), key(6)])
        );
    }
}
