//! "Which point is nearest to here, if any is near?" in constant time: a grid of cells of one voxel, each holding the
//! nearest point within three cells. Cells live in bricks of 8 x 8 x 8, and only bricks near points exist: all others, and the
//! whole outside, are one brick without points, so that a lookup is two loads and no branch.

use multiversion::multiversion;

use super::Point;
use super::voxel_grid::cell_of;

/// Cells along the edge of a brick, as a power of two.
const BRICK_BITS: u32 = 3;
const BRICK: i64 = 1 << BRICK_BITS;
const BRICK_CELLS: usize = (BRICK * BRICK * BRICK) as usize;
/// What a cell without a near point holds.
const EMPTY: u32 = u32::MAX;
/// A cell knows the nearest point up to this many cells away.
const REACH: i64 = 3;
/// Cells along an axis that know a point.
const WIDTH: usize = 2 * REACH as usize + 1;
/// Top-level bricks at most, so that a stray point far away cannot make the table huge (16 MiB of it), and that the number of a
/// brick and that of a cell in it fit into one word.
const MAX_BRICKS: usize = 1 << 22;

/// Constant-time lookup of a near point. Built once per scan.
#[derive(Debug, Clone)]
pub struct NearestGrid {
    size: f32,
    /// Cell of the first brick's first corner.
    low: [i64; 3],
    /// Bricks along each axis.
    bricks: [i64; 3],
    /// Where the cells of each brick are, in bricks of `cells`; one more entry than bricks, for the outside. 0 is the empty brick.
    table: Vec<u32>,
    /// The near point of each cell, brick after brick, or EMPTY.
    cells: Vec<u32>,
}

impl NearestGrid {
    /// Indexes `points` in cells of `size` metres. Points so far from the others that the table would not fit are left out;
    /// [`crate::geometry::NearestGrid::nearest`] does not find them.
    #[must_use]
    pub fn new(points: &[Point], size: f32) -> Self {
        let cells: Vec<[i64; 3]> = points.iter().map(|p| cell_of(p, size)).collect();
        let Some((low, high)) = bounds(&cells) else {
            return Self {
                size,
                low: [0; 3],
                bricks: [0; 3],
                table: vec![0],
                cells: vec![EMPTY; BRICK_CELLS],
            };
        };
        let bricks: [i64; 3] = std::array::from_fn(|k| (high[k] - low[k]) / BRICK + 1);
        let mut grid = Self {
            size,
            low,
            bricks,
            table: vec![0; bricks.iter().product::<i64>() as usize + 1],
            cells: vec![EMPTY; BRICK_CELLS],
        };
        let mut distances: Vec<f32> = vec![f32::INFINITY; BRICK_CELLS];
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
        let index = self.lookup(place(&self.frame(), point[0], point[1], point[2]));
        (index != EMPTY).then_some(index as usize)
    }

    /// [`NearestGrid::nearest`] for many points, given and answered as one array a coordinate, all of one length. Where no point is
    /// near, `found` gets a number that no point has.
    pub fn nearest_of_all(&self, [x, y, z]: [&[f32]; 3], found: &mut [u32]) {
        places(&self.frame(), x, y, z, found);
        for place in found {
            *place = self.lookup(*place);
        }
    }

    #[inline]
    fn lookup(&self, place: u32) -> u32 {
        let brick = self.table[place as usize / BRICK_CELLS] as usize;
        self.cells[brick * BRICK_CELLS + place as usize % BRICK_CELLS]
    }

    #[inline]
    fn frame(&self) -> Frame {
        Frame {
            inverse: 1.0 / self.size,
            low: self.low.map(|x| x as f32),
            cells: self.bricks.map(|x| (x * BRICK) as f32),
            bricks: self.bricks.map(|x| x as u32),
        }
    }

    /// Offers a point to all cells in reach of its own: rows of them along z, as they lie in the bricks, without a branch for each.
    fn spread(&mut self, index: u32, cell: [i64; 3], point: &Point, distances: &mut Vec<f32>) {
        let [_, ny, nz] = self.bricks;
        let along_x = self.steps(0, ny * nz, 2 * BRICK_BITS, cell, point);
        let along_y = self.steps(1, nz, BRICK_BITS, cell, point);
        let along_z = self.steps(2, 1, 0, cell, point);
        // The reach is less than a brick, so it is in one brick along z or in two.
        let bricks = [along_z[0].brick, along_z[WIDTH - 1].brick];
        let mut rows = [[f32::INFINITY; BRICK as usize]; 2];
        for step in &along_z {
            rows[usize::from(step.brick != bricks[0])][step.inner] = step.square;
        }
        let rows = &rows[..if bricks[0] == bricks[1] { 1 } else { 2 }];
        for x in &along_x {
            for y in &along_y {
                let square = x.square + y.square;
                for (row, brick) in rows.iter().zip(bricks) {
                    let first = self.first_cell(x.brick + y.brick + brick, distances) + (x.inner | y.inner);
                    let cells = &mut self.cells[first..first + row.len()];
                    let distances = &mut distances[first..first + row.len()];
                    for ((along, cell), distance) in row.iter().zip(cells).zip(distances) {
                        let nearer = square + along < *distance;
                        *cell = if nearer { index } else { *cell };
                        *distance = if nearer { square + along } else { *distance };
                    }
                }
            }
        }
    }

    /// The cells in reach of `cell` along axis `k`, where a step of a brick is `stride` bricks and cells lie `1 << shift` apart.
    fn steps(&self, k: usize, stride: i64, shift: u32, cell: [i64; 3], point: &Point) -> [Step; WIDTH] {
        std::array::from_fn(|i| {
            let cell = cell[k] - REACH + i as i64;
            let offset = cell - self.low[k];
            let d = (cell as f32 + 0.5) * self.size - point[k];
            let (brick, inner) = (offset / BRICK * stride, (offset % BRICK) << shift);
            Step { brick: brick as usize, inner: inner as usize, square: d * d }
        })
    }

    /// Where the cells of a brick start, which is made if need be.
    #[inline]
    fn first_cell(&mut self, brick: usize, distances: &mut Vec<f32>) -> usize {
        if self.table[brick] == 0 {
            self.table[brick] = (self.cells.len() / BRICK_CELLS) as u32;
            self.cells.resize(self.cells.len() + BRICK_CELLS, EMPTY);
            distances.resize(self.cells.len(), f32::INFINITY);
        }
        self.table[brick] as usize * BRICK_CELLS
    }
}

/// What one axis contributes to the place of a cell, and to its squared distance from a point.
struct Step {
    brick: usize,
    inner: usize,
    square: f32,
}

/// What it takes to find the cell of a point.
struct Frame {
    inverse: f32,
    low: [f32; 3],
    /// Cells along each axis.
    cells: [f32; 3],
    /// Bricks along each axis.
    bricks: [u32; 3],
}

/// The number of a point's brick and of its cell therein, as one number; for a point outside, the brick after the last.
#[expect(
    clippy::inline_always,
    reason = "apart from `places` it is compiled for the least processor, one point at a time"
)]
#[inline(always)]
fn place(frame: &Frame, x: f32, y: f32, z: f32) -> u32 {
    let offset = |k: usize, x: f32| (x * frame.inverse).floor() - frame.low[k];
    let (x, y, z) = (offset(0, x), offset(1, y), offset(2, z));
    let within = |k: usize, x: f32| (x >= 0.0) && (x < frame.cells[k]);
    let inside = within(0, x) && within(1, y) && within(2, z);
    let cell = |x: f32| if inside { x as i32 as u32 } else { 0 };
    let (x, y, z) = (cell(x), cell(y), cell(z));
    let [nx, ny, nz] = frame.bricks;
    let brick = ((x >> BRICK_BITS) * ny + (y >> BRICK_BITS)) * nz + (z >> BRICK_BITS);
    let low = |x: u32| x & ((1 << BRICK_BITS) - 1);
    let inner = (low(x) << (2 * BRICK_BITS)) | (low(y) << BRICK_BITS) | low(z);
    let outside = nx * ny * nz;
    if inside { (brick << (3 * BRICK_BITS)) | inner } else { outside << (3 * BRICK_BITS) }
}

#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn places(frame: &Frame, x: &[f32], y: &[f32], z: &[f32], found: &mut [u32]) {
    let n = found.len();
    let (x, y, z) = (&x[..n], &y[..n], &z[..n]);
    for i in 0..n {
        found[i] = place(frame, x[i], y[i], z[i]);
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

        let queries: Vec<Point> =
            (0..300).map(|i| [i as f32 * 0.01, i as f32 * 0.007, (i % 9) as f32 - 4.0]).collect();
        let axis = |k: usize| -> Vec<f32> { queries.iter().map(|q| q[k]).collect() };
        let mut found = vec![0; queries.len()];
        grid.nearest_of_all([&axis(0), &axis(1), &axis(2)], &mut found);
        for (query, found) in queries.iter().zip(found) {
            let found = Some(found as usize).filter(|i| *i < points.len());
            assert_eq!(found, grid.nearest(query));
        }
    }

    #[test]
    fn each_cell_knows_the_nearest_of_the_points_in_reach() {
        let points: Vec<Point> = (0..300)
            .map(|i| {
                [(37, 101, -1.5), (53, 97, 0.2), (71, 89, -1.4)]
                    .map(|(a, b, from)| (i * a % b) as f32 * 0.031 + from)
            })
            .collect();
        let grid = NearestGrid::new(&points, 0.1);
        for i in 0..2000 {
            let cell =
                [(17, 41, -20), (23, 43, -5), (29, 47, -20)].map(|(a, b, from)| i64::from(i * a % b + from));
            let centre = cell.map(|c| (c as f32 + 0.5) * 0.1);
            let in_reach = |p: &Point| {
                let other = cell_of(p, 0.1);
                (0..3).all(|k| (other[k] - cell[k]).abs() <= REACH)
            };
            let nearest =
                points.iter().filter(|p| in_reach(p)).map(|p| distance(p, &centre)).min_by(f32::total_cmp);
            let found = grid.nearest(&centre).map(|index| distance(&points[index], &centre));
            assert_eq!(found, nearest);
        }
    }

    #[test]
    fn a_stray_point_far_away_costs_no_memory() {
        let mut points: Vec<Point> = (0..100).map(|i| [i as f32 * 0.05, 0.0, 0.0]).collect();
        points.push([1e9, -1e9, 1e9]);
        let grid = NearestGrid::new(&points, 0.05);
        assert!(grid.table.len() <= MAX_BRICKS + 1);
        assert_eq!(grid.nearest(&[2.5, 0.0, 0.0]).map(|i| i.abs_diff(50) <= 1), Some(true));
    }
}
