//! Fixed-radius neighbours of points.
//!
//! Points lie sorted by the cells of a regular grid about as wide as the radius asked for, one array a coordinate: the cells around a query
//! are then a few runs of points, whose distances are computed many at once. For neighbourhoods of tens of points this is
//! several times faster than a kd-tree, which takes a branch for every few points.

use multiversion::multiversion;

use super::Point;
use super::voxel_grid::{cell_of, sorted_by_cell};

/// Points of a run that are looked at together.
const BLOCK: usize = 64;

/// The points of one scan, sorted for lookups.
pub struct NeighborIndex {
    size: f32,
    /// The occupied cells, ascending, and where the points of each begin.
    cells: Vec<([i64; 3], usize)>,
    /// The points, cell after cell.
    position: [Vec<f32>; 3],
    /// Which point each is.
    item: Vec<u32>,
}

impl NeighborIndex {
    /// Indexes finite points for lookups of radii of about `reach` metres, which must be positive; neighbours are reported by their
    /// position in `points`.
    #[must_use]
    pub fn new(points: &[Point], reach: f32) -> Self {
        let order = sorted_by_cell(points, reach);
        let mut cells: Vec<([i64; 3], usize)> = Vec::new();
        for (at, (cell, _)) in order.iter().enumerate() {
            if cells.last().is_none_or(|(last, _)| last != cell) {
                cells.push((*cell, at));
            }
        }
        let coordinate =
            |k: usize| -> Vec<f32> { order.iter().map(|(_, item)| points[*item as usize][k]).collect() };
        Self {
            size: reach,
            cells,
            position: std::array::from_fn(coordinate),
            item: order.iter().map(|(_, item)| *item).collect(),
        }
    }

    /// Calls `visit(index, squared distance in m^2)` for every point nearer than `radius` metres, in an order that depends
    /// only on the indexed points and the query. The time grows with the square of `radius` over the index's reach.
    pub fn within(&self, point: &Point, radius: f32, mut visit: impl FnMut(usize, f32)) {
        let low = cell_of(&point.map(|x| x - radius), self.size);
        let high = cell_of(&point.map(|x| x + radius), self.size);
        let limit = radius * radius;
        let mut square = [0.0_f32; BLOCK];
        let mut near = [0_usize; BLOCK];
        for x in low[0]..=high[0] {
            for y in low[1]..=high[1] {
                // Cells that differ in z alone follow each other.
                let first = self.cells.partition_point(|(cell, _)| *cell < [x, y, low[2]]);
                let after = &self.cells[first..];
                let count = after.iter().take_while(|(cell, _)| *cell <= [x, y, high[2]]).count();
                if count == 0 {
                    continue;
                }
                let end = after.get(count).map_or(self.item.len(), |(_, begin)| *begin);
                for begin in (after[0].1..end).step_by(BLOCK) {
                    let run = begin..end.min(begin + BLOCK);
                    let [xs, ys, zs] = self.position.each_ref().map(|axis| &axis[run.clone()]);
                    squares(xs, ys, zs, point, &mut square);
                    let mut len = 0;
                    for i in 0..run.len() {
                        near[len] = i;
                        len += usize::from(square[i] < limit);
                    }
                    for &i in &near[..len] {
                        visit(self.item[begin + i] as usize, square[i]);
                    }
                }
            }
        }
    }
}

/// Squared distances of a run of points from one.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn squares(x: &[f32], y: &[f32], z: &[f32], point: &Point, square: &mut [f32; BLOCK]) {
    let n = x.len().min(BLOCK);
    let (x, y, z, square) = (&x[..n], &y[..n], &z[..n], &mut square[..n]);
    for i in 0..n {
        let (dx, dy, dz) = (x[i] - point[0], y[i] - point[1], z[i] - point[2]);
        square[i] = dx * dx + dy * dy + dz * dz;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_point_in_the_radius_is_found(
            // A coarse lattice puts many points on the same axis-aligned planes, and on the borders of cells.
            cells in prop::collection::vec(prop::array::uniform3(-3..3i32), 1..400),
            query in prop::array::uniform3(-4.0..4.0f32),
            radius in 0.1..4.0f32,
            reach in 0.5..4.0f32,
        ) {
            let points: Vec<Point> = cells.iter().map(|c| c.map(|x| x as f32)).collect();
            let square = |p: &Point| (0..3).map(|k| (p[k] - query[k]).powi(2)).sum::<f32>();
            let mut found = Vec::new();
            NeighborIndex::new(&points, reach).within(&query, radius, |i, _| found.push(i));
            found.sort_unstable();
            let clear = |i: &usize| (square(&points[*i]).sqrt() - radius).abs() > 1e-4;
            let expected: Vec<usize> =
                (0..points.len()).filter(|&i| square(&points[i]) < radius * radius).filter(clear).collect();
            found.retain(clear);
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn without_points_nothing_is_near() {
        NeighborIndex::new(&[], 1.0).within(&[0.0; 3], 1.0, |i, _| panic!("point {i} does not exist"));
    }
}
