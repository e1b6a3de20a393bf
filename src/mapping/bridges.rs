//! Bridges: pairs that alone hold two pieces of several scans together. Such pieces are not joined on one weak pair; but scan by scan, each on
//! a pair of its own, a component can grow across one all the same, and if that pair is wrong, so is all behind it. Used by `policy`.

use std::collections::{BTreeMap, BTreeSet};

use super::candidates::LEAST_WORD;
use super::component::Component;
use super::consistency::supports;
use super::cuts::smaller_side;
use super::mapper::Mapper;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;

/// Fewer scans are no piece: one that hangs on by a pair misplaces nothing but itself.
const PIECE: usize = 2;

impl Mapper {
    /// Parts components at their bridges that are not firm. Returns how many were parted.
    pub fn part_at_bridges(
        &mut self,
        graph: &ScanGraph,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<usize, Cancelled> {
        let mut parted = 0;
        let mut pending = std::mem::take(&mut self.components);
        while let Some(mut component) = pending.pop() {
            control.check()?;
            match bridge(&component, &supports(graph, &component, options), options.firm_support) {
                Some(side) => {
                    parted += 1;
                    pending.extend(component.split_off(&side, options));
                    pending.push(component);
                }
                None => self.components.push(component),
            }
        }
        self.sort_components();
        Ok(parted)
    }
}

/// The smaller of the two pieces that one pair of less than `least` support holds together; of several, those of the weakest.
fn bridge(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    least: f64,
) -> Option<BTreeSet<ScanKey>> {
    let mut weak: Vec<(f64, ScanKey, ScanKey)> = supports
        .iter()
        .filter(|(_, support)| (LEAST_WORD..least).contains(*support))
        .map(|((a, b), support)| (*support, *a, *b))
        .collect();
    weak.sort_by(|x, y| x.0.total_cmp(&y.0).then((x.1, x.2).cmp(&(y.1, y.2))));
    weak.into_iter().find_map(|(_, a, b)| {
        let side = reached_without(component, supports, a, b);
        let piece = |scans: usize| scans >= PIECE;
        if side.contains(&b) || !piece(side.len()) {
            return None;
        }
        let other = reached_without(component, supports, b, a);
        piece(other.len()).then(|| smaller_side(component, side))
    })
}

/// The scans that pairs which say something tie to `a`, without the pair of `a` and `b`.
fn reached_without(
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    a: ScanKey,
    b: ScanKey,
) -> BTreeSet<ScanKey> {
    let mut links: BTreeMap<ScanKey, Vec<ScanKey>> = BTreeMap::new();
    for ((x, y), support) in supports {
        if *support >= LEAST_WORD && (*x, *y) != (a.min(b), a.max(b)) {
            links.entry(*x).or_default().push(*y);
            links.entry(*y).or_default().push(*x);
        }
    }
    let mut reached = BTreeSet::from([a]);
    let mut open = vec![a];
    while let Some(scan) = open.pop() {
        for other in links.get(&scan).into_iter().flatten() {
            if component.poses.contains_key(other) && reached.insert(*other) {
                open.push(*other);
            }
        }
    }
    reached
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::mapping::tracks::Tracks;

    #[test]
    fn pieces_that_one_weak_pair_holds_together_are_parted_and_no_others() {
        let component = Component {
            gauge: ScanKey(1),
            poses: (1..=6).map(|k| (ScanKey(k), Pose::identity())).collect(),
            tracks: Tracks::default(),
        };
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
