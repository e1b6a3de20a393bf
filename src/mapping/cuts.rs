//! Cuts through the support that holds a component together: the weakest, the weakest between some scans and others, and those where it hangs by little.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use super::candidates::LEAST_WORD;
use super::component::Component;
use crate::cloud::ScanKey;

/// Fewer scans are no piece: one that hangs on by a pair misplaces nothing but itself.
const PIECE: usize = 2;
/// Support of scans that are not to be separated.
const INSEPARABLE: f64 = 1e12;
/// Support below this is none.
const NO_SUPPORT: f64 = 1e-6;

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

/// The smaller of two pieces that one pair of less than `least` support alone holds together, the rest of what lies between them saying
/// nothing; of several, those of the weakest. `None` if there are none.
#[must_use]
pub fn bridge(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    least: f64,
) -> Option<BTreeSet<ScanKey>> {
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index = |scan: &ScanKey| keys.binary_search(scan).ok();
    let mut links: Vec<(usize, usize, f64)> = supports
        .iter()
        .filter(|(_, support)| **support >= LEAST_WORD)
        .filter_map(|((a, b), support)| Some((index(a)?, index(b)?, *support)))
        .collect();
    links.sort_by(|x, y| x.2.total_cmp(&y.2).then((x.0, x.1).cmp(&(y.0, y.1))));
    let weak = links.iter().take_while(|(_, _, support)| *support < least).enumerate();
    weak.into_iter().find_map(|(at, &(a, b, _))| {
        let others = links.iter().enumerate().filter(|(other, _)| *other != at);
        let groups = tied(keys.len(), others.map(|(_, link)| *link));
        let [side, other] = [a, b].map(|scan| groups.iter().find(|group| group.contains(&scan)));
        let (side, other) = (side?, other?);
        let parts = !side.contains(&b) && side.len() >= PIECE && other.len() >= PIECE;
        parts.then(|| smaller_side(component, side.iter().map(|scan| keys[*scan]).collect()))
    })
}

/// A piece of a component of which one scan outside alone sees anything, and that little.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Glimpse {
    /// The scan.
    pub scan: ScanKey,
    /// What the scan is of without that, itself included.
    pub own: BTreeSet<ScanKey>,
    /// The piece.
    pub piece: BTreeSet<ScanKey>,
}

/// The glimpses in a component, by scan: all pairs between the scan and the piece are `slight`. The pairs of one scan with a piece
/// are no independent witnesses, as they look at the same surfaces.
#[must_use]
pub fn glimpses(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    slight: &BTreeSet<(ScanKey, ScanKey)>,
) -> Vec<Glimpse> {
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index = |scan: &ScanKey| keys.binary_search(scan).ok();
    let links: Vec<(usize, usize, bool)> = supports
        .iter()
        .filter(|(_, support)| **support >= LEAST_WORD)
        .filter_map(|(pair, _)| Some((index(&pair.0)?, index(&pair.1)?, slight.contains(pair))))
        .collect();
    let looks = |scan: usize| {
        let of_scan = move |link: &&(usize, usize, bool)| link.2 && (link.0 == scan || link.1 == scan);
        links.iter().filter(of_scan).map(move |link| if link.0 == scan { link.1 } else { link.0 })
    };
    let of_scan = |scan: usize| {
        let others = links.iter().filter(|link| !(link.2 && (link.0 == scan || link.1 == scan)));
        let groups = tied(keys.len(), others.map(|&(a, b, _)| (a, b, 0.0)));
        let group_of = |scan: usize| groups.iter().position(|group| group.contains(&scan));
        let scans = |group: usize| groups[group].iter().map(|scan| keys[*scan]).collect::<BTreeSet<_>>();
        let is_piece = |group: &usize| groups[*group].len() >= PIECE;
        let own = group_of(scan).filter(is_piece);
        let seen: BTreeSet<usize> = looks(scan).filter_map(group_of).filter(is_piece).collect();
        let glimpses = own.map(|own| {
            let pieces = seen.into_iter().filter(|piece| *piece != own);
            pieces.map(|piece| Glimpse { scan: keys[scan], own: scans(own), piece: scans(piece) }).collect()
        });
        glimpses.unwrap_or_else(Vec::new)
    };
    (0..keys.len()).filter(|scan| looks(*scan).next().is_some()).flat_map(of_scan).collect()
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

/// The cut of least support that separates some scans of a component from others: the side of `from`, and the support across (Edmonds, Karp:
/// "Theoretical improvements in algorithmic efficiency for network flow problems", JACM 1972). `None` where either is empty or not of the component, or
/// they share a scan.
#[must_use]
pub fn separating_cut(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    from: &[ScanKey],
    to: &[ScanKey],
) -> Option<(BTreeSet<ScanKey>, f64)> {
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index: BTreeMap<ScanKey, usize> = keys.iter().enumerate().map(|(i, key)| (*key, i)).collect();
    let end =
        |scans: &[ScanKey]| scans.iter().map(|scan| index.get(scan).copied()).collect::<Option<Vec<_>>>();
    let (sources, sinks) = (end(from)?, end(to)?);
    let (source, sink) = (*sources.first()?, *sinks.first()?);
    if sources.iter().any(|source| sinks.contains(source)) {
        return None;
    }
    let n = keys.len();
    let mut spare = vec![0.0_f64; n * n];
    for (first, others) in [(source, &sources), (sink, &sinks)] {
        for other in others.iter().filter(|other| **other != first) {
            spare[first * n + other] = INSEPARABLE;
            spare[other * n + first] = INSEPARABLE;
        }
    }
    for ((a, b), support) in supports {
        if let (Some(&i), Some(&j)) = (index.get(a), index.get(b)) {
            spare[i * n + j] += support;
            spare[j * n + i] += support;
        }
    }
    let (side, flow) = least_cut(&mut spare, n, source, sink)?;
    Some((side.into_iter().map(|i| keys[i]).collect(), flow))
}

/// The same for `n` nodes with what can flow from i to j at `spare[i * n + j]`, which is used up: the side of the source, and what flows.
pub fn least_cut(spare: &mut [f64], n: usize, source: usize, sink: usize) -> Option<(Vec<usize>, f64)> {
    let mut flow = 0.0;
    loop {
        let mut before: Vec<Option<usize>> = vec![None; n];
        before[source] = Some(source);
        let mut queue = VecDeque::from([source]);
        while let Some(i) = queue.pop_front() {
            for j in 0..n {
                if before[j].is_none() && spare[i * n + j] > NO_SUPPORT {
                    before[j] = Some(i);
                    queue.push_back(j);
                }
            }
        }
        if before[sink].is_none() {
            let side = (0..n).filter(|i| before[*i].is_some()).collect();
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
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
        let (side, cut) = separating_cut(&six(), &supports, &[key(1)], &[key(5)]).unwrap();
        assert_eq!(side, BTreeSet::from([key(1), key(2), key(3)]));
        assert!((cut - 1.5).abs() < 1e-9);
        let (side, cut) = separating_cut(&six(), &supports, &[key(6)], &[key(1)]).unwrap();
        assert_eq!(side, BTreeSet::from([key(6)]));
        assert!((cut - 0.2).abs() < 1e-9);
        let (side, cut) = separating_cut(&six(), &supports, &[key(6), key(4)], &[key(1)]).unwrap();
        assert_eq!(
            side,
            BTreeSet::from([key(4), key(5), key(6)]),
            "scan 6 alone is not all that is on that side"
        );
        assert!((cut - 1.5).abs() < 1e-9);
        assert_eq!(separating_cut(&six(), &supports, &[], &[key(1)]), None);
        assert_eq!(separating_cut(&six(), &supports, &[key(1), key(2)], &[key(2)]), None);
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

    #[test]
    fn a_piece_of_which_one_scan_alone_sees_little_is_found() {
        let component = six();
        let pieces = [(1, 2), (2, 3), (1, 3), (4, 5), (5, 6)];
        let find = |more: &[(u128, u128)], slight: &[(u128, u128)]| {
            let pairs = |pairs: &[(u128, u128)]| -> BTreeSet<(ScanKey, ScanKey)> {
                pairs.iter().map(|(a, b)| (ScanKey(*a), ScanKey(*b))).collect()
            };
            let supports = pairs(&[&pieces[..], more].concat()).into_iter().map(|pair| (pair, 4.0)).collect();
            let found = glimpses(&component, &supports, &pairs(slight));
            found.into_iter().next().map(|found| (found.scan.0, smaller_side(&component, found.piece)))
        };
        let three = Some([4, 5, 6].map(ScanKey).into());
        assert_eq!(find(&[(3, 4), (3, 5)], &[(3, 4), (3, 5)]), three.map(|piece| (3, piece)));
        assert_eq!(find(&[(3, 4), (3, 5)], &[(3, 4)]), None, "one pair shares much");
        assert_eq!(find(&[(3, 4), (2, 5)], &[(3, 4), (2, 5)]), None, "two scans see something");
        // A lone scan that it sees little of is no piece, and hides none.
        let lone = glimpses(
            &component,
            &[(1, 2), (2, 3), (2, 4), (5, 6), (2, 5)].map(|(a, b)| ((ScanKey(a), ScanKey(b)), 4.0)).into(),
            &[(2, 4), (2, 5)].map(|(a, b)| (ScanKey(a), ScanKey(b))).into(),
        );
        let [own, piece] = [vec![1, 2, 3], vec![5, 6]].map(|scans| scans.into_iter().map(ScanKey).collect());
        assert_eq!(lone.first(), Some(&Glimpse { scan: ScanKey(2), own, piece }));
        let all = [(1, 4), (2, 4), (3, 4)];
        assert_eq!(find(&all, &all).map(|(scan, side)| (scan, side.len())), Some((4, 3)));
    }

    #[test]
    fn pieces_that_one_weak_pair_holds_together_are_parted_and_no_others() {
        let component = six();
        let find = |links: &[(u128, u128, f64)]| {
            let supports = links.iter().map(|&(a, b, w)| ((ScanKey(a), ScanKey(b)), w)).collect();
            bridge(&component, &supports, 4.0)
        };
        let pieces = [(1, 2, 4.0), (2, 3, 4.0), (1, 3, 2.0), (4, 5, 4.0), (5, 6, 4.0)];
        let with = |more: &[(u128, u128, f64)]| [&pieces[..], more].concat();
        let side = Some((1..=3).map(ScanKey).collect());
        assert_eq!(find(&with(&[(3, 4, 2.5)])), side);
        // What hardly says anything holds nothing together.
        assert_eq!(find(&with(&[(3, 4, 2.5), (2, 5, 0.4)])), side);
        assert_eq!(find(&with(&[(3, 4, 2.5), (2, 5, 1.2)])), None);
        assert_eq!(find(&with(&[(3, 4, 4.0)])), None);
        // A scan at the end of a weak pair is no piece.
        assert_eq!(find(&[(1, 2, 4.0), (2, 3, 4.0), (3, 4, 4.0), (4, 5, 4.0), (5, 6, 2.0)]), None);
    }
}
