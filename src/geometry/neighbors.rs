//! Fixed-radius neighbours of points.
//!
//! Points lie sorted by the cells of a regular grid about as wide as the radius asked for: the cells around a query are then a few runs of
//! points. For neighbourhoods of tens of points this is several times faster than a kd-tree, which takes a branch for every few points.
//! Queries of one cell have their surroundings in common: those points are copied side by side, one array a coordinate, and their distances
//! computed many at once.

use std::ops::Range;

use multiversion::multiversion;
use rayon::prelude::*;

use super::Point;
use super::voxel_grid::{cell_of, sorted_by_cell};

/// Points that are looked at together.
const BLOCK: usize = 64;
/// Points whose moments are summed side by side. A block is a multiple of it.
const LANES: usize = 16;
/// Nothing is near it.
const NOWHERE: f32 = f32::INFINITY;

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

/// Sums over the neighbours of a place: of their offsets from it (metres) and of the products of these (square metres).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moments {
    /// How many there are.
    pub count: usize,
    /// Sums of x, y, z.
    pub sum: [f64; 3],
    /// Sums of xx, xy, xz, yy, yz, zz.
    pub products: [f64; 6],
}

/// The points around the queries of one cell.
#[derive(Default)]
pub struct Surroundings {
    /// One array a coordinate, filled up with points that are nowhere.
    position: [Vec<f32>; 3],
    /// Which point each is, in the order of the index.
    item: Vec<u32>,
    /// Metres.
    radius: f32,
    /// Where the cells of each x began that were looked up last: those of the next query are near.
    columns: Vec<usize>,
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
    pub fn within(&self, point: &Point, radius: f32, visit: impl FnMut(usize, f32)) {
        Surroundings::default().gather(self, [point], radius).within(point, visit);
    }

    /// What `answer(number of the query, points around it, spare)` says of each query, in their order. Faster than one lookup for each, as
    /// those that lie near each other share one. `spare` is a thing of the caller's, to be used again from query to query: a buffer.
    pub fn map<T: Send, S: Default>(
        &self,
        queries: &[Point],
        radius: f32,
        answer: impl Fn(usize, &Surroundings, &mut S) -> T + Sync,
    ) -> Vec<T> {
        let order = sorted_by_cell(queries, self.size);
        let groups: Vec<&[([i64; 3], u32)]> = order.chunk_by(|a, b| a.0 == b.0).collect();
        let answered: Vec<Vec<T>> = groups
            .par_iter()
            .map_init(<(Surroundings, S)>::default, |(around, spare), group| {
                around.gather(self, group.iter().map(|(_, query)| &queries[*query as usize]), radius);
                group.iter().map(|(_, query)| answer(*query as usize, around, spare)).collect()
            })
            .collect();
        let mut answers: Vec<Option<T>> = queries.iter().map(|_| None).collect();
        for ((_, query), answer) in order.iter().zip(answered.into_iter().flatten()) {
            answers[*query as usize] = Some(answer);
        }
        // Each query is in one group.
        answers.into_iter().flatten().collect()
    }

    /// Where the points of a cell begin, or of the one after the last.
    fn begin(&self, cell: usize) -> usize {
        self.cells.get(cell).map_or(self.item.len(), |(_, begin)| *begin)
    }

    /// The number of the first cell that is not before `cell`, sought from a guess: close to it in few steps.
    fn first_cell(&self, cell: [i64; 3], guess: usize) -> usize {
        let is_before = |at: usize| self.cells[at].0 < cell;
        let guess = guess.min(self.cells.len());
        let (mut low, mut high, mut step) = (guess, guess, 1);
        // All before `low` come before the cell, none from `high` on does.
        while low > 0 && !is_before(low - 1) {
            high = low - 1;
            low = low.saturating_sub(step);
            step *= 2;
        }
        while high < self.cells.len() && is_before(high) {
            low = high + 1;
            high = (high + step).min(self.cells.len());
            step *= 2;
        }
        low + self.cells[low..high].partition_point(|(other, _)| *other < cell)
    }
}

impl Surroundings {
    /// Becomes what lies within `radius` metres of any of some places, with the same buffers.
    pub fn gather<'p>(
        &mut self,
        index: &NeighborIndex,
        places: impl IntoIterator<Item = &'p Point>,
        radius: f32,
    ) -> &Self {
        let (mut low, mut high) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
        for place in places {
            for k in 0..3 {
                low[k] = low[k].min(place[k] - radius);
                high[k] = high[k].max(place[k] + radius);
            }
        }
        self.radius = radius;
        self.item.clear();
        self.position.iter_mut().for_each(Vec::clear);
        let (low, high) = (cell_of(&low, index.size), cell_of(&high, index.size));
        for (column, x) in (low[0]..=high[0]).enumerate() {
            if column == self.columns.len() {
                self.columns.push(0);
            }
            let mut at = self.columns[column];
            for y in low[1]..=high[1] {
                at = index.first_cell([x, y, low[2]], at);
                if y == low[1] {
                    self.columns[column] = at;
                }
                // Cells that differ in z alone follow each other.
                let begin = at;
                at += index.cells[at..].iter().take_while(|(cell, _)| *cell <= [x, y, high[2]]).count();
                self.take(index, index.begin(begin)..index.begin(at));
            }
        }
        let filled = self.item.len().next_multiple_of(LANES);
        self.position.iter_mut().for_each(|axis| axis.resize(filled, NOWHERE));
        self
    }

    /// Adds a run of points.
    fn take(&mut self, index: &NeighborIndex, run: Range<usize>) {
        self.item.extend_from_slice(&index.item[run.clone()]);
        for (mine, all) in self.position.iter_mut().zip(&index.position) {
            mine.extend_from_slice(&all[run.clone()]);
        }
    }

    /// Calls `visit(index, squared distance in m^2)` for every point in the radius of one of the queries that these surroundings are of.
    pub fn within(&self, point: &Point, mut visit: impl FnMut(usize, f32)) {
        let limit = self.radius * self.radius;
        let mut square = [0.0_f32; BLOCK];
        let mut near = [0_usize; BLOCK];
        let [xs, ys, zs] = self.position.each_ref().map(|axis| axis.chunks(BLOCK));
        for (block, ((x, y), z)) in xs.zip(ys).zip(zs).enumerate() {
            squares(x, y, z, point, &mut square);
            // Without a branch for each: the next place is written to, but only kept for what is near.
            let mut len = 0;
            for i in 0..x.len() {
                near[len] = i;
                len += usize::from(square[i] < limit);
            }
            for &i in &near[..len] {
                visit(self.item[block * BLOCK + i] as usize, square[i]);
            }
        }
    }

    /// The moments of the points in the radius of one of the queries that these surroundings are of. How they round depends on the other queries.
    #[must_use]
    pub fn moments(&self, point: &Point) -> Moments {
        let mut lanes = [[0.0_f32; LANES]; 10];
        let [xs, ys, zs] = self.position.each_ref().map(Vec::as_slice);
        add_moments(xs, ys, zs, point, self.radius * self.radius, &mut lanes);
        let total = |k: usize| lanes[k].iter().map(|x| f64::from(*x)).sum::<f64>();
        Moments {
            count: total(0) as usize,
            sum: std::array::from_fn(|k| total(1 + k)),
            products: std::array::from_fn(|k| total(4 + k)),
        }
    }
}

/// Adds the points whose squared distance is below `limit` to the count, the three sums and the six products, lane by lane.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn add_moments(x: &[f32], y: &[f32], z: &[f32], point: &Point, limit: f32, lanes: &mut [[f32; LANES]; 10]) {
    let mut sums = *lanes;
    let [x, y, z] = [x, y, z].map(|axis| axis.as_chunks::<LANES>().0);
    for ((x, y), z) in x.iter().zip(y).zip(z) {
        for k in 0..LANES {
            let [dx, dy, dz] = [x[k] - point[0], y[k] - point[1], z[k] - point[2]];
            let near = dx * dx + dy * dy + dz * dz < limit;
            let [dx, dy, dz, one] = [dx, dy, dz, 1.0].map(|v| if near { v } else { 0.0 });
            let terms = [one, dx, dy, dz, dx * dx, dx * dy, dx * dz, dy * dy, dy * dz, dz * dz];
            for (sum, term) in sums.iter_mut().zip(terms) {
                sum[k] += term;
            }
        }
    }
    *lanes = sums;
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
            let index = NeighborIndex::new(&points, reach);
            let mut found = Vec::new();
            index.within(&query, radius, |i, _| found.push(i));
            let moments = Surroundings::default().gather(&index, [&query], radius).moments(&query);
            prop_assert_eq!(moments.count, found.len());
            let offset = |i: usize, k: usize| f64::from(points[i][k]) - f64::from(query[k]);
            for (at, (k, l)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].into_iter().enumerate() {
                let sum: f64 = found.iter().map(|i| offset(*i, k)).sum();
                let product: f64 = found.iter().map(|i| offset(*i, k) * offset(*i, l)).sum();
                prop_assert!((moments.sum[k] - sum).abs() < 1e-3);
                prop_assert!((moments.products[at] - product).abs() < 2e-3, "{} of {product}", moments.products[at]);
            }
            found.sort_unstable();
            let clear = |i: &usize| (square(&points[*i]).sqrt() - radius).abs() > 1e-4;
            let expected: Vec<usize> =
                (0..points.len()).filter(|&i| square(&points[i]) < radius * radius).filter(clear).collect();
            found.retain(clear);
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn queries_are_answered_together_as_one_by_one() {
        let point =
            |i: usize| [(i * 37 % 101) as f32 * 0.1, (i * 53 % 97) as f32 * 0.1, (i * 71 % 13) as f32];
        let points: Vec<Point> = (0..600).map(point).collect();
        let queries: Vec<Point> = (600..900).map(point).map(|p| p.map(|x| x - 0.3)).collect();
        let index = NeighborIndex::new(&points, 1.0);
        let together = index.map(&queries, 1.2, |query, around, found: &mut Vec<(usize, u32)>| {
            found.clear();
            around.within(&queries[query], |i, square| found.push((i, square.to_bits())));
            (query, around.moments(&queries[query]), found.clone())
        });
        assert_eq!(together.len(), queries.len());
        let mut around = Surroundings::default();
        for (query, (number, moments, found)) in together.into_iter().enumerate() {
            let mut alone = Vec::new();
            index.within(&queries[query], 1.2, |i, square| alone.push((i, square.to_bits())));
            assert_eq!((number, found), (query, alone));
            let single = around.gather(&index, [&queries[query]], 1.2).moments(&queries[query]);
            assert_eq!(moments.count, single.count);
            let sums = moments.sum.iter().zip(&single.sum);
            for (x, y) in sums.chain(moments.products.iter().zip(&single.products)) {
                assert!((x - y).abs() < 1e-3, "{x} is not {y}");
            }
        }
    }

    #[test]
    fn without_points_nothing_is_near() {
        NeighborIndex::new(&[], 1.0).within(&[0.0; 3], 1.0, |i, _| panic!("point {i} does not exist"));
    }
}
