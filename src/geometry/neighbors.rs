//! Fixed-radius neighbours of points, behind one adapter so that the library underneath can be exchanged.

use kiddo::{ImmutableKdTree, SquaredEuclidean};

use super::Point;

/// A kd-tree over the points of one scan.
pub struct NeighborIndex {
    tree: Option<ImmutableKdTree<f32, 3>>,
}

impl NeighborIndex {
    /// Indexes finite points; neighbours are reported by their position in `points`. A set that the tree cannot hold
    /// (empty, or more than 2^32 points) has no neighbours anywhere.
    #[must_use]
    pub fn new(points: &[Point]) -> Self {
        let tree = if points.is_empty() { None } else { ImmutableKdTree::new_from_slice(points).ok() };
        Self { tree }
    }

    /// Calls `visit(index, squared distance in m^2)` for every point within `radius` metres, in an order that depends
    /// only on the indexed points and the query.
    pub fn within(&self, point: &Point, radius: f32, mut visit: impl FnMut(usize, f32)) {
        if let Some(tree) = &self.tree {
            tree.query(point)
                .within::<SquaredEuclidean<f32>>(radius * radius)
                .unsorted()
                .visit(|found| visit(found.item as usize, found.distance));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_point_in_the_radius_is_found(
            // A coarse lattice puts many points on the same axis-aligned planes, where kd-trees go wrong first.
            cells in prop::collection::vec(prop::array::uniform3(0..6i32), 1..400),
            query in prop::array::uniform3(0.0..6.0f32),
            radius in 0.1..4.0f32,
        ) {
            let points: Vec<Point> = cells.iter().map(|c| c.map(|x| x as f32)).collect();
            let square = |p: &Point| (0..3).map(|k| (p[k] - query[k]).powi(2)).sum::<f32>();
            let mut found = Vec::new();
            NeighborIndex::new(&points).within(&query, radius, |i, _| found.push(i));
            found.sort_unstable();
            let clear = |i: &usize| (square(&points[*i]).sqrt() - radius).abs() > 1e-4;
            let expected: Vec<usize> =
                (0..points.len()).filter(|&i| square(&points[i]) < radius * radius).filter(clear).collect();
            found.retain(clear);
            prop_assert_eq!(found, expected);
        }
    }
}
