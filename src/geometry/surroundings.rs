//! What lies around the queries of one cell of a neighbour index: found, copied side by side, and asked. Used by `neighbors`.

use std::ops::Range;

use multiversion::multiversion;

use super::Point;
use super::neighbors::{Moments, NeighborIndex};
use super::voxel_grid::cell_of;

/// Points that are looked at together.
const BLOCK: usize = 64;
/// Points that are copied, and whose moments are summed, side by side.
pub(super) const LANES: usize = 16;
/// Nothing is near it.
pub(super) const NOWHERE: f32 = f32::INFINITY;

/// The points around the queries of one cell, in the order of the index.
#[derive(Default)]
pub(super) struct Surroundings {
    len: usize,
    /// One array a coordinate, filled up to a multiple of [`LANES`] with points that are nowhere. There may be more behind that.
    position: [Vec<f32>; 3],
    /// The place of each point in the index.
    place: Vec<u32>,
    /// Metres.
    radius: f32,
    /// The least and the greatest x and y of the columns of cells that were looked up last: mostly the next query has the same.
    span: [[i64; 2]; 2],
    /// Those columns, as far as there is anything.
    columns: Vec<Column>,
}

/// Cells that differ in z alone.
struct Column {
    cells: Range<usize>,
    /// The first of them that was near when they were looked up last.
    at: usize,
}

impl Column {
    /// The cells from one z to another.
    fn cells_between(&mut self, index: &NeighborIndex, low: i64, high: i64) -> Range<usize> {
        let cells = &index.cells[self.cells.clone()];
        let mut at = self.at - self.cells.start;
        if at > 0 && cells[at - 1].0 >= low {
            at = cells.partition_point(|(z, _)| *z < low);
        }
        // Queries come sorted, so that these are few steps.
        at += cells[at..].iter().take_while(|(z, _)| *z < low).count();
        let many = cells[at..].iter().take_while(|(z, _)| *z <= high).count();
        self.at = self.cells.start + at;
        self.at..self.at + many
    }
}

impl Surroundings {
    /// Becomes what lies within `radius` metres of any of some places, with the same buffers.
    pub fn gather<'p>(
        &mut self,
        index: &NeighborIndex,
        places: impl IntoIterator<Item = &'p Point>,
        radius: f32,
    ) {
        self.gather_from(index, places, radius, 0);
    }

    /// The same without the points before a place of the index.
    pub fn gather_from<'p>(
        &mut self,
        index: &NeighborIndex,
        places: impl IntoIterator<Item = &'p Point>,
        radius: f32,
        first: usize,
    ) {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for place in places {
            for k in 0..3 {
                low[k] = low[k].min(place[k] - radius);
                high[k] = high[k].max(place[k] + radius);
            }
        }
        self.radius = radius;
        self.len = 0;
        let ([x, y, low], [far_x, far_y, high]) = (cell_of(&low, index.size), cell_of(&high, index.size));
        self.look_up(index, [[x, y], [far_x, far_y]]);
        let mut columns = std::mem::take(&mut self.columns);
        for column in &mut columns {
            let run = column.cells_between(index, low, high);
            let run = index.begin(run.start).max(first)..index.begin(run.end);
            if !run.is_empty() {
                self.take(index, run);
            }
        }
        self.columns = columns;
        self.make_room(LANES);
        for axis in &mut self.position {
            axis[self.len..self.len + LANES].fill(NOWHERE);
        }
    }

    /// Finds the columns of cells from one x and y to another.
    fn look_up(&mut self, index: &NeighborIndex, span: [[i64; 2]; 2]) {
        if self.span == span && !self.columns.is_empty() {
            return;
        }
        self.span = span;
        self.columns.clear();
        let [[x, y], [far_x, far_y]] = span;
        let next = |at: usize, from: [i64; 2]| {
            at + index.columns[at..].partition_point(|(column, _)| *column < from)
        };
        let mut at = next(0, [x, y]);
        while let Some(&([column_x, column_y], begin)) =
            index.columns.get(at).filter(|(at, _)| at[0] <= far_x)
        {
            if column_y < y {
                at = next(at, [column_x, y]);
            } else if column_y <= far_y {
                self.columns.push(Column { cells: begin..index.column(at + 1), at: begin });
                at += 1;
            } else if column_x < far_x {
                at = next(at, [column_x + 1, y]);
            } else {
                break;
            }
        }
    }

    /// Adds a run of points.
    fn take(&mut self, index: &NeighborIndex, run: Range<usize>) {
        self.make_room(run.len());
        for (mine, all) in self.position.iter_mut().zip(&index.position) {
            // A few too many are copied, at once: what follows is written over them.
            let mine = mine[self.len..].as_chunks_mut::<LANES>().0;
            let all = all[run.start..].as_chunks::<LANES>().0;
            for (mine, all) in mine.iter_mut().zip(all).take(run.len().div_ceil(LANES)) {
                *mine = *all;
            }
        }
        for (mine, place) in self.place[self.len..].iter_mut().zip(run.start..run.end) {
            *mine = place as u32;
        }
        self.len += run.len();
    }

    /// Makes the arrays reach this far behind the last point, and [`LANES`] more.
    fn make_room(&mut self, more: usize) {
        let needed = self.len + more + LANES;
        if self.place.len() < needed {
            let filled = 2 * needed;
            self.position.iter_mut().for_each(|axis| axis.resize(filled, NOWHERE));
            self.place.resize(filled, 0);
        }
    }

    /// Adds the points in the radius of one of the queries that these surroundings are of, with squared distances in square metres, without the
    /// first few that were gathered. They go by their places in the index.
    pub fn add_near(&self, skipped: usize, point: &Point, found: &mut Vec<(u32, f32)>) {
        let limit = self.radius * self.radius;
        let mut square = [0.0_f32; BLOCK];
        for first in (skipped..self.len).step_by(BLOCK) {
            let block = first..(first + BLOCK).min(self.len);
            let [x, y, z] = self.position.each_ref().map(|axis| &axis[block.clone()]);
            squares(x, y, z, point, &mut square);
            // Without a branch for each: the next entry is written to, but only kept for what is near.
            let mut len = found.len();
            found.resize(len + block.len(), (0, 0.0));
            for (place, square) in self.place[block].iter().zip(&square) {
                found[len] = (*place, *square);
                len += usize::from(*square < limit);
            }
            found.truncate(len);
        }
    }

    /// The moments of the points in the radius of one of the queries that these surroundings are of.
    pub fn moments(&self, point: &Point) -> Moments {
        let filled = self.len.next_multiple_of(LANES);
        let [x, y, z] = self.position.each_ref().map(|axis| &axis[..filled]);
        let [count, sum_x, sum_y, sum_z, products @ ..] = sums(x, y, z, point, self.radius * self.radius);
        Moments { count: count as u32, sum: [sum_x, sum_y, sum_z], products }
    }
}

/// Of the points whose squared distance is below `limit`: the count, the three sums and the six products.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn sums(x: &[f32], y: &[f32], z: &[f32], point: &Point, limit: f32) -> [f32; 10] {
    let mut lanes = [[0.0_f32; LANES]; 10];
    let [x, y, z] = [x, y, z].map(|axis| axis.as_chunks::<LANES>().0);
    for ((x, y), z) in x.iter().zip(y).zip(z) {
        for k in 0..LANES {
            let [dx, dy, dz] = [x[k] - point[0], y[k] - point[1], z[k] - point[2]];
            let near = dx * dx + dy * dy + dz * dz < limit;
            let [dx, dy, dz, one] = [dx, dy, dz, 1.0].map(|v| if near { v } else { 0.0 });
            let terms = [one, dx, dy, dz, dx * dx, dx * dy, dx * dz, dy * dy, dy * dz, dz * dz];
            for (sum, term) in lanes.iter_mut().zip(terms) {
                sum[k] += term;
            }
        }
    }
    lanes.map(|lanes| {
        let eight: [f32; 8] = std::array::from_fn(|k| lanes[k] + lanes[k + 8]);
        let four: [f32; 4] = std::array::from_fn(|k| eight[k] + eight[k + 4]);
        (four[0] + four[2]) + (four[1] + four[3])
    })
}

/// Squared distances of points from one.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn squares(x: &[f32], y: &[f32], z: &[f32], point: &Point, square: &mut [f32; BLOCK]) {
    let n = x.len().min(BLOCK);
    let (x, y, z, square) = (&x[..n], &y[..n], &z[..n], &mut square[..n]);
    for i in 0..n {
        let (dx, dy, dz) = (x[i] - point[0], y[i] - point[1], z[i] - point[2]);
        square[i] = dx * dx + dy * dy + dz * dz;
    }
}
