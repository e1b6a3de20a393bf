//! "Which point is nearest to here, if any is near?" in constant time: a grid of cells of one voxel, each holding the
//! nearest point within three cells. Cells live in bricks of 8 x 8 x 8, and only bricks near points exist: all others, and the
//! whole outside, are one brick without points, so that a lookup is two loads and no branch.

use multiversion::multiversion;

use super::Point;
use super::voxel_grid::{box_of, cell_of};
use super::whole::whole;

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
/// Bricks that meet at a corner.
const CORNERS: usize = 8;
/// Top-level bricks at most, so that a stray point far away cannot make the table huge (16 MiB of it), and that the number of a
/// brick and that of a cell in it fit into one word.
const MAX_BRICKS: usize = 1 << 22;
/// Of these along one axis at most, so that the number of a cell along it is one that [`whole`] answers for.
const MAX_ALONG: usize = 1 << 20;
const _: () = assert!(MAX_ALONG * BRICK as usize <= 1 << 23);

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
        let table = vec![0; bricks.iter().product::<i64>() as usize + 1];
        let mut grid = Self { size, low, bricks, table, cells: Vec::new() };
        let is_inside = |k: usize, cell: i64| {
            cell.checked_sub(REACH).is_some_and(|lower| lower >= low[k])
                && cell.checked_add(REACH).is_some_and(|upper| upper <= high[k])
        };
        let inside: Vec<(u32, [i64; 3])> =
            (0..).zip(cells).filter(|(_, cell)| (0..3).all(|k| is_inside(k, cell[k]))).collect();
        let made = grid.make_bricks(inside.iter().map(|(_, cell)| cell));
        let mut offers = vec![NONE_OFFERED; made * BRICK_CELLS];
        for (index, cell) in inside {
            offer(index, &grid.near(cell, &points[index as usize]), &mut offers);
        }
        grid.cells = offers.iter().map(|offer| unpacked(*offer)).collect();
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

    /// Gives numbers to the bricks that cells with points reach, and to no others. How many there are with the empty one.
    fn make_bricks<'c>(&mut self, occupied: impl Iterator<Item = &'c [i64; 3]>) -> usize {
        let mut last = None;
        for cell in occupied {
            let reached = self.reached(*cell);
            // Cells in a row mostly reach the same.
            if last != Some(reached) {
                for brick in reached {
                    self.table[brick] = 1;
                }
                last = Some(reached);
            }
        }
        let mut made = 0;
        for place in self.table.iter_mut().filter(|place| **place > 0) {
            made += 1;
            *place = made;
        }
        made as usize + 1
    }

    /// The bricks that a cell reaches: by its lower or its upper end along x, y and z. The reach is less than a brick, so there are no
    /// others; the same may be there several times.
    fn reached(&self, cell: [i64; 3]) -> [usize; CORNERS] {
        let [_, ny, nz] = self.bricks;
        let end =
            |k: usize, upper: bool| (cell[k] + if upper { REACH } else { -REACH } - self.low[k]) / BRICK;
        std::array::from_fn(|corner| {
            let [x, y, z] = [4, 2, 1].map(|bit| corner & bit != 0);
            ((end(0, x) * ny + end(1, y)) * nz + end(2, z)) as usize
        })
    }

    /// What is in reach of a point in `cell`.
    fn near(&self, cell: [i64; 3], point: &Point) -> Near {
        let bricks = self.reached(cell).map(|brick| self.table[brick] as usize * BRICK_CELLS);
        let along: [[Step; WIDTH]; 3] = std::array::from_fn(|k| {
            let first = cell[k] - REACH - self.low[k];
            std::array::from_fn(|i| {
                let offset = first + i as i64;
                let d = ((offset + self.low[k]) as f32 + 0.5) * self.size - point[k];
                let is_upper = offset / BRICK != first / BRICK;
                Step { inner: (offset % BRICK) as usize, is_upper, square: d * d }
            })
        });
        let mut rows = [[f32::INFINITY; BRICK as usize]; 2];
        for step in &along[2] {
            rows[usize::from(step.is_upper)][step.inner] = step.square;
        }
        let [x, y, z] = along;
        Near { bricks, x, y, rows, split: z[WIDTH - 1].is_upper }
    }
}

/// The cells in reach of a point, and its squared distances from their centres, each the sum of what three axes contribute, square metres.
struct Near {
    /// Where the cells of the bricks start: the lower and the upper one along z, of each of two along y, of each of two along x.
    bricks: [usize; CORNERS],
    x: [Step; WIDTH],
    y: [Step; WIDTH],
    /// What z contributes, for all cells of a brick that differ in z alone, in the lower and in the upper brick; infinite out of reach.
    rows: [[f32; BRICK as usize]; 2],
    /// Whether the reach along z is in two bricks.
    split: bool,
}

/// What one axis contributes to the place of a cell, and to its squared distance from a point.
struct Step {
    /// Cells from the start of the brick.
    inner: usize,
    /// Whether that is the upper of two bricks.
    is_upper: bool,
    /// Square metres.
    square: f32,
}

/// Offers a point to all cells in reach: rows of them along z, as they lie in the bricks, without a branch for each.
#[multiversion(targets("x86_64+avx512f+avx512dq+avx512vl", "x86_64+avx2", "aarch64+neon"))]
fn offer(index: u32, near: &Near, offers: &mut [Offer]) {
    let along_z = if near.split { 2 } else { 1 };
    for x in &near.x {
        for y in &near.y {
            let square = x.square + y.square;
            let corner = 4 * usize::from(x.is_upper) + 2 * usize::from(y.is_upper);
            let inner = (x.inner << (2 * BRICK_BITS)) | (y.inner << BRICK_BITS);
            for (row, brick) in near.rows[..along_z].iter().zip(&near.bricks[corner..]) {
                if let Some(best) = offers[brick + inner..].first_chunk_mut::<{ BRICK as usize }>() {
                    for (best, along) in best.iter_mut().zip(row) {
                        *best = (*best).min(packed(square + along, index));
                    }
                }
            }
        }
    }
}

/// A point offered to a cell, its squared distance (square metres) in the upper half and its number in the lower, so that the least is the
/// nearest, and of points as near as each other the first. A signed number, as not every processor compares unsigned ones side by side.
type Offer = i64;

/// What is not nearer than any.
const NONE_OFFERED: Offer = (f32::INFINITY.to_bits() as i64) << 32;

#[inline]
fn packed(square: f32, index: u32) -> Offer {
    // Bits of numbers that are not negative are in the order of the numbers, and what is none comes last.
    (i64::from(square.abs().to_bits()) << 32) | i64::from(index)
}

/// The point that was offered, or EMPTY.
fn unpacked(offer: Offer) -> u32 {
    if offer < NONE_OFFERED { offer as u32 } else { EMPTY }
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
    let cell = |x: f32| if inside { whole(x) } else { 0 };
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
    let (mut low, mut high) = box_of(cells)?;
    let mut trim = 1;
    loop {
        low = low.map(|cell| cell.saturating_sub(REACH));
        high = high.map(|cell| cell.saturating_add(REACH));
        let fits = (0..3)
            .try_fold(1_usize, |product, k| {
                let bricks = high[k].checked_sub(low[k])?.checked_div(BRICK)?.checked_add(1)?;
                let bricks = usize::try_from(bricks).ok().filter(|bricks| *bricks <= MAX_ALONG)?;
                product.checked_mul(bricks)
            })
            .is_some_and(|bricks| bricks <= MAX_BRICKS);
        if fits {
            return Some((low, high));
        }
        // Without the outermost on every side.
        for k in 0..3 {
            let mut axis: Vec<i64> = cells.iter().map(|c| c[k]).collect();
            let upper = axis.len().checked_sub(1 + trim).filter(|upper| *upper >= trim)?;
            low[k] = *axis.select_nth_unstable(trim).1;
            high[k] = *axis.select_nth_unstable(upper).1;
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
    fn of_points_as_near_as_each_other_the_first_is_found_and_what_is_no_place_never() {
        let points = [[0.5, 0.5, 0.5], [0.5, 0.5, 0.5], [-f32::NAN, 0.5, 0.5], [0.7, 0.5, 0.5]];
        let grid = NearestGrid::new(&points, 0.1);
        assert_eq!(grid.nearest(&[0.5, 0.5, 0.5]), Some(0));
        assert_eq!(grid.nearest(&[0.7, 0.5, 0.5]), Some(3));
        assert!((0..40).all(|i| grid.nearest(&[i as f32 * 0.05, 0.5, 0.5]) != Some(2)));
    }

    #[test]
    fn a_stray_point_far_away_costs_no_memory() {
        let mut points: Vec<Point> = (0..100).map(|i| [i as f32 * 0.05, 0.0, 0.0]).collect();
        points.push([1e9, -1e9, 1e9]);
        let grid = NearestGrid::new(&points, 0.05);
        assert!(grid.table.len() <= MAX_BRICKS + 1);
        assert_eq!(grid.nearest(&[2.5, 0.0, 0.0]).map(|i| i.abs_diff(50) <= 1), Some(true));

        // In a row so long that there is room for its bricks, but that not all numbers of its cells are told apart: 2^23 cells from the points.
        points[100] = [5e5, 0.0, 0.0];
        let row = NearestGrid::new(&points, 0.05);
        assert_eq!(row.nearest(&[2.5, 0.0, 0.0]), grid.nearest(&[2.5, 0.0, 0.0]));
        assert_eq!(row.nearest(&[419_433.0, 0.0, 0.0]), None);
    }
}
