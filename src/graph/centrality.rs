//! Which scans lie in the middle of the graph.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BinaryHeap};

use crate::cloud::ScanKey;

/// Harmonic centrality: the sum of 1 / distance to every other node over weighted shortest paths (Marchiori, Latora 2000). Unlike
/// closeness it is defined on graphs that fall apart. `edges` are (x, y, length > 0).
#[must_use]
pub fn harmonic_centrality(edges: &[(ScanKey, ScanKey, f64)]) -> BTreeMap<ScanKey, f64> {
    let mut around: BTreeMap<ScanKey, Vec<(ScanKey, f64)>> = BTreeMap::new();
    for &(x, y, length) in edges {
        around.entry(x).or_default().push((y, length));
        around.entry(y).or_default().push((x, length));
    }
    around
        .keys()
        .map(|start| {
            let mut distance: BTreeMap<ScanKey, f64> = BTreeMap::new();
            let mut heap = BinaryHeap::from([Nearest(0.0, *start)]);
            while let Some(Nearest(d, node)) = heap.pop() {
                if distance.contains_key(&node) {
                    continue;
                }
                distance.insert(node, d);
                for (next, length) in around.get(&node).into_iter().flatten() {
                    if !distance.contains_key(next) {
                        heap.push(Nearest(d + length, *next));
                    }
                }
            }
            let sum = distance.values().filter(|d| **d > 0.0).map(|d| 1.0 / d).sum();
            (*start, sum)
        })
        .collect()
}

/// Orders a heap by least distance first, ties by key.
struct Nearest(f64, ScanKey);

impl Ord for Nearest {
    fn cmp(&self, other: &Self) -> Ordering {
        other.0.total_cmp(&self.0).then(other.1.cmp(&self.1))
    }
}

impl PartialOrd for Nearest {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Nearest {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Eq for Nearest {}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_of_a_chain_is_most_central_and_islands_count_less() {
        let k = |n| ScanKey(n);
        let chain =
            [(k(1), k(2), 1.0), (k(2), k(3), 1.0), (k(3), k(4), 1.0), (k(4), k(5), 1.0), (k(8), k(9), 1.0)];
        let centrality = harmonic_centrality(&chain);
        assert!((centrality[&k(3)] - 3.0).abs() < 1e-12);
        assert!(centrality[&k(3)] > centrality[&k(1)]);
        assert!((centrality[&k(8)] - 1.0).abs() < 1e-12);
    }
}
