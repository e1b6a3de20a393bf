//! "Which point is nearest to here, if any is near?" in constant time: a grid of cells of one voxel, each holding the
//! nearest point within three cells. Cells live in bricks of 8 x 8 x 8, and only bricks near points exist.

use super::Point;
use super::voxel_grid::cell_of;

const BRICK: i64 = 8;
const BRICK_CELLS: usize = (BRICK * BRICK * BRICK) as usize;
const EMPTY: u32 = u32::MAX;
/// A cell knows the nearest point up to this many cells away.
const REACH: i64 = 3;
/// Top-level bricks at most, so that a stray point far away cannot make the table huge (64 MiB of it).
const MAX_BRICKS: usize = 1 << 24;

/// Constant-time lookup of a near point. Built once per scan.
#[derive(Debug, Clone)]
pub struct NearestGrid {
    size: f32,
    /// Cell of the first brick's first corner.
    low: [i64; 3],
    /// Bricks along each axis.
    bricks: [i64; 3],
    /// Index of each brick in `cells`, or EMPTY.
    table: Vec<u32>,
    cells: Vec<u32>,
}

impl NearestGrid {
    /// Indexes `points` in cells of `size` metres. Points so far from the others that the table would not fit are left out;
    /// [`crate::geometry::NearestGrid::nearest`] does not find them.
    #[must_use]
    pub fn new(points: &[Point], size: f32) -> Self {
        let cells: Vec<[i64; 3]> = points.iter().map(|p| cell_of(p, size)).collect();
        let Some((low, high)) = bounds(&cells) else {
            return Self { size, low: [0; 3], bricks: [0; 3], table: Vec::new(), cells: Vec::new() };
        };
        let bricks: [i64; 3] = std::array::from_fn(|k| (high[k] - low[k]) / BRICK + 1);
        let mut grid = Self {
            size,
            low,
            bricks,
            table: vec![EMPTY; bricks.iter().product::<i64>() as usize],
            cells: Vec::new(),
        };
        let mut distances: Vec<f32> = Vec::new();
        for (index, (cell, point)) in cells.iter().zip(points).enumerate() {
            if (0..3).all(|k| cell[k] - REACH >= low[k] && cell[k] + REACH <= high[k]) {
                grid.spread(index as u32, *cell, point, &mut distances);
            }
        }
        grid
    }

    /// The index of a point that is near `point`: the nearest one to the centre of `point`'s cell, if within about three
    /// cells. Callers check the true distance.
    #[inline]
    #[must_use]
    pub fn nearest(&self, point: &Point) -> Option<usize> {
        let inverse = 1.0 / self.size;
        let mut brick_index = 0_usize;
        let mut inner = 0_usize;
        for k in 0..3 {
            let offset = ((point[k] * inverse).floor() as i64).saturating_sub(self.low[k]);
            if offset < 0 || offset >= self.bricks[k] * BRICK {
                return None;
            }
            brick_index = brick_index * self.bricks[k] as usize + (offset / BRICK) as usize;
            inner = inner * BRICK as usize + (offset % BRICK) as usize;
        }
        let brick = self.table[brick_index];
        if brick == EMPTY {
            return None;
        }
        let index = self.cells[brick as usize * BRICK_CELLS + inner];
        (index != EMPTY).then_some(index as usize)
    }

    fn spread(&mut self, index: u32, cell: [i64; 3], point: &Point, distances: &mut Vec<f32>) {
        for x in cell[0] - REACH..=cell[0] + REACH {
            let dx = (x as f32 + 0.5) * self.size - point[0];
            for y in cell[1] - REACH..=cell[1] + REACH {
                let dy = (y as f32 + 0.5) * self.size - point[1];
                for z in cell[2] - REACH..=cell[2] + REACH {
                    let dz = (z as f32 + 0.5) * self.size - point[2];
                    let slot = self.slot([x, y, z], distances);
                    let square = dx * dx + dy * dy + dz * dz;
                    if square < distances[slot] {
                        distances[slot] = square;
                        self.cells[slot] = index;
                    }
                }
            }
        }
    }

    fn slot(&mut self, cell: [i64; 3], distances: &mut Vec<f32>) -> usize {
        let mut brick_index = 0_usize;
        let mut inner = 0_usize;
        for k in 0..3 {
            let offset = cell[k] - self.low[k];
            brick_index = brick_index * self.bricks[k] as usize + (offset / BRICK) as usize;
            inner = inner * BRICK as usize + (offset % BRICK) as usize;
        }
        if self.table[brick_index] == EMPTY {
            self.table[brick_index] = (self.cells.len() / BRICK_CELLS) as u32;
            self.cells.resize(self.cells.len() + BRICK_CELLS, EMPTY);
            distances.resize(self.cells.len(), f32::INFINITY);
        }
        self.table[brick_index] as usize * BRICK_CELLS + inner
    }
}

/// Cells that the grid covers: all points with their reach, or as large a middle part as the table may have.
fn bounds(cells: &[[i64; 3]]) -> Option<([i64; 3], [i64; 3])> {
    let mut trim = 0;
    loop {
        let mut low = [0; 3];
        let mut high = [0; 3];
        for k in 0..3 {
            let mut axis: Vec<i64> = cells.iter().map(|c| c[k]).collect();
            axis.sort_unstable();
            low[k] = axis.get(trim)?.saturating_sub(REACH);
            high[k] = axis.get(axis.len().checked_sub(1 + trim)?)?.saturating_add(REACH);
            if high[k] < low[k] {
                return None;
            }
        }
        let fits = (0..3)
            .try_fold(1_usize, |product, k| {
                let bricks = high[k].checked_sub(low[k])?.checked_div(BRICK)?.checked_add(1)?;
                product.checked_mul(usize::try_from(bricks).ok()?)
            })
            .is_some_and(|bricks| bricks <= MAX_BRICKS);
        if fits {
            return Some((low, high));
        }
        trim = trim * 2 + 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn distance(a: &Point, b: &Point) -> f32 {
        (0..3).map(|k| (a[k] - b[k]).powi(2)).sum::<f32>().sqrt()
    }

    #[test]
    fn the_point_found_is_about_as_near_as_the_nearest() {
        let points: Vec<Point> = (0..400)
            .map(|i| [(i % 20) as f32 * 0.11, (i / 20) as f32 * 0.09, (i % 7) as f32 * 0.01])
            .collect();
        let grid = NearestGrid::new(&points, 0.05);
        for i in 0..200 {
            let query = [i as f32 * 0.01, i as f32 * 0.007, 0.02];
            let nearest = points.iter().map(|p| distance(p, &query)).fold(f32::INFINITY, f32::min);
            if nearest < 0.1 {
                let found = grid.nearest(&query).expect("a point is near");
                assert!(distance(&points[found], &query) <= nearest + 0.09);
            }
        }
        assert_eq!(grid.nearest(&[9.0, 9.0, 9.0]), None);
        assert_eq!(grid.nearest(&[f32::NAN, 0.0, f32::INFINITY]), None);
    }

    #[test]
    fn a_stray_point_far_away_costs_no_memory() {
        let mut points: Vec<Point> = (0..100).map(|i| [i as f32 * 0.05, 0.0, 0.0]).collect();
        points.push([1e9, -1e9, 1e9]);
        let grid = NearestGrid::new(&points, 0.05);
        assert!(grid.table.len() <= MAX_BRICKS);
        assert_eq!(grid.nearest(&[2.5, 0.0, 0.0]).map(|i| i.abs_diff(50) <= 1), Some(true));
    }
}
