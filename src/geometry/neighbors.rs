//! Fixed-radius neighbours of points.
//!
//! Points lie sorted by the cells of a regular grid about as wide as the radius asked for: the cells around a query are then a few runs of
//! points. For neighbourhoods of tens of points this is several times faster than a kd-tree, which takes a branch for every few points.
//! Queries of one cell have their surroundings in common: those points are copied side by side, one array a coordinate, and their distances
//! computed many at once.

use rayon::prelude::*;

use super::Point;
use super::surroundings::{LANES, NOWHERE, Surroundings};
use super::voxel_grid::{ByCell, cell_of};

/// Cells whose queries one thread answers in a row.
const TOGETHER: usize = 64;

/// The points of one scan, sorted for lookups.
pub struct NeighborIndex {
    pub(super) size: f32,
    /// The x and y of occupied cells, ascending, and where the cells of each begin.
    pub(super) columns: Vec<([i64; 2], usize)>,
    /// The z of the occupied cells, and where the points of each begin.
    pub(super) cells: Vec<(i64, usize)>,
    /// The points, cell after cell, and behind them [`LANES`] that are nowhere.
    pub(super) position: [Vec<f32>; 3],
    /// Which point each is.
    item: Vec<u32>,
}

/// Sums over the neighbours of a place: of their offsets from it (metres) and of the products of these (square metres).
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moments {
    /// How many there are.
    pub count: u32,
    /// Sums of x, y, z.
    pub sum: [f32; 3],
    /// Sums of xx, xy, xz, yy, yz, zz.
    pub products: [f32; 6],
}

/// Pairs of points of an index that are near each other, each of them once. Points go by their place in the order of the index.
#[derive(Debug, Clone, Default)]
pub struct Pairs {
    /// For points that follow each other.
    parts: Vec<Part>,
}

/// The pairs of some points.
#[derive(Debug, Clone, Default)]
struct Part {
    /// Where the partners of each point end.
    ends: Vec<usize>,
    /// Places after that of the point, ascending, with squared distances in square metres.
    partners: Vec<(u32, f32)>,
}

impl Pairs {
    /// For each point in the order of the index, its partners that come after it, with squared distances in square metres.
    pub fn by_point(&self) -> impl Iterator<Item = &[(u32, f32)]> {
        self.parts.iter().flat_map(|part| {
            let mut begin = 0;
            part.ends.iter().map(move |end| {
                let partners = begin..*end;
                begin = partners.end;
                &part.partners[partners]
            })
        })
    }
}

impl NeighborIndex {
    /// Indexes finite points for lookups of radii of about `reach` metres, which must be positive; neighbours are reported by their
    /// position in `points`.
    #[must_use]
    pub fn new(points: &[Point], reach: f32) -> Self {
        let sorted = ByCell::of(points, reach);
        let mut columns: Vec<([i64; 2], usize)> = Vec::new();
        let mut cells = Vec::new();
        let mut begin = 0;
        for group in sorted.groups() {
            let [x, y, z] = cell_of(&points[group[0] as usize], reach);
            if columns.last().is_none_or(|(last, _)| *last != [x, y]) {
                columns.push(([x, y], cells.len()));
            }
            cells.push((z, begin));
            begin += group.len();
        }
        let coordinate = |k: usize| -> Vec<f32> {
            let mut axis = Vec::with_capacity(points.len() + LANES);
            axis.extend(sorted.items.iter().map(|item| points[*item as usize][k]));
            axis.resize(points.len() + LANES, NOWHERE);
            axis
        };
        Self { size: reach, columns, cells, position: std::array::from_fn(coordinate), item: sorted.items }
    }

    /// Which point is at each place of the order that the index keeps points in: those of a cell side by side.
    #[must_use]
    pub fn order(&self) -> &[u32] {
        &self.item
    }

    /// Calls `visit(index, squared distance in m^2)` for every point nearer than `radius` metres, in an order that depends
    /// only on the indexed points and the query. The time grows with the square of `radius` over the index's reach.
    pub fn within(&self, point: &Point, radius: f32, mut visit: impl FnMut(usize, f32)) {
        let mut around = Surroundings::default();
        around.gather(self, [point], radius);
        let mut near = Vec::new();
        around.add_near(0, point, &mut near);
        for (place, square) in near {
            visit(self.item[place as usize] as usize, square);
        }
    }

    /// What `answer` says of the moments of the points nearer than `radius` metres to each of some places, given for many of them at a time. How
    /// moments round depends on the other places.
    pub fn map_moments<T: Copy + Default + Send>(
        &self,
        places: &[Point],
        radius: f32,
        answer: impl Fn(&[Moments]) -> Vec<T> + Sync,
    ) -> Vec<T> {
        let sorted = ByCell::of(places, self.size);
        let groups: Vec<&[u32]> = sorted.groups().collect();
        let answered: Vec<Vec<T>> = groups
            .par_chunks(TOGETHER)
            .map_init(<(Surroundings, Vec<Moments>)>::default, |(around, moments), groups| {
                moments.clear();
                for group in groups {
                    around.gather(self, group.iter().map(|place| &places[*place as usize]), radius);
                    moments.extend(group.iter().map(|place| around.moments(&places[*place as usize])));
                }
                answer(moments)
            })
            .collect();
        let mut answers = vec![T::default(); places.len()];
        for (place, answer) in sorted.items.iter().zip(answered.into_iter().flatten()) {
            answers[*place as usize] = answer;
        }
        answers
    }

    /// All pairs of points that are nearer to each other than `radius` metres.
    #[must_use]
    pub fn pairs(&self, radius: f32) -> Pairs {
        let numbers: Vec<usize> = (0..self.cells.len()).collect();
        let parts = numbers
            .par_chunks(TOGETHER)
            .map_init(Surroundings::default, |around, cells| {
                let mut part = Part::default();
                for cell in cells {
                    self.pairs_from(*cell, radius, around, &mut part);
                }
                part
            })
            .collect();
        Pairs { parts }
    }

    /// Adds the pairs whose first point is in a cell.
    fn pairs_from(&self, cell: usize, radius: f32, around: &mut Surroundings, found: &mut Part) {
        let own = self.begin(cell)..self.begin(cell + 1);
        let points: Vec<Point> =
            own.clone().map(|at| self.position.each_ref().map(|axis| axis[at])).collect();
        around.gather_from(self, &points, radius, own.start);
        for (at, point) in points.iter().enumerate() {
            // What was gathered begins with the points of the cell.
            around.add_near(at + 1, point, &mut found.partners);
            found.ends.push(found.partners.len());
        }
    }

    /// Where the points of a cell begin, or of the one after the last.
    pub(super) fn begin(&self, cell: usize) -> usize {
        self.cells.get(cell).map_or(self.item.len(), |(_, begin)| *begin)
    }

    /// Where the cells of a column begin, or of the one after the last.
    pub(super) fn column(&self, column: usize) -> usize {
        self.columns.get(column).map_or(self.cells.len(), |(_, begin)| *begin)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn square(a: &Point, b: &Point) -> f32 {
        (0..3).map(|k| (a[k] - b[k]).powi(2)).sum()
    }

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
            let index = NeighborIndex::new(&points, reach);
            let mut found = Vec::new();
            index.within(&query, radius, |i, _| found.push(i));
            let moments = index.map_moments(&[query], radius, <[_]>::to_vec)[0];
            prop_assert_eq!(moments.count as usize, found.len());
            let offset = |i: usize, k: usize| f64::from(points[i][k]) - f64::from(query[k]);
            for (at, (k, l)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].into_iter().enumerate() {
                let sum: f64 = found.iter().map(|i| offset(*i, k)).sum();
                let product: f64 = found.iter().map(|i| offset(*i, k) * offset(*i, l)).sum();
                prop_assert!((f64::from(moments.sum[k]) - sum).abs() < 1e-3);
                prop_assert!((f64::from(moments.products[at]) - product).abs() < 2e-3, "{} of {product}", moments.products[at]);
            }
            found.sort_unstable();
            let clear = |i: &usize| (square(&points[*i], &query).sqrt() - radius).abs() > 1e-4;
            let expected: Vec<usize> =
                (0..points.len()).filter(|&i| square(&points[i], &query) < radius * radius).filter(clear).collect();
            found.retain(clear);
            prop_assert_eq!(found, expected);
        }

        #[test]
        fn every_pair_is_found_once(
            cells in prop::collection::vec(prop::array::uniform3(-3..3i32), 0..200),
            radius in 0.1..4.0f32,
            reach in 0.5..4.0f32,
        ) {
            let points: Vec<Point> = cells.iter().map(|c| c.map(|x| x as f32)).collect();
            let index = NeighborIndex::new(&points, reach);
            let pairs = index.pairs(radius);
            prop_assert_eq!(pairs.by_point().count(), points.len());
            let mut found = Vec::new();
            for (place, partners) in (0_u32..).zip(pairs.by_point()) {
                let me = index.order()[place as usize];
                let mut last = place;
                for (other, distance) in partners {
                    prop_assert!(*other > last, "{other} follows {last}");
                    last = *other;
                    let other = index.order()[*other as usize];
                    prop_assert_eq!(*distance, square(&points[me as usize], &points[other as usize]));
                    found.push((me.min(other), me.max(other)));
                }
            }
            found.sort_unstable();
            let near = |a: u32, b: u32| {
                let square = square(&points[a as usize], &points[b as usize]);
                square < radius * radius
            };
            let n = points.len() as u32;
            let expected: Vec<(u32, u32)> =
                (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b))).filter(|(a, b)| near(*a, *b)).collect();
            prop_assert_eq!(found, expected);
        }
    }

    #[test]
    fn places_are_answered_together_as_one_by_one() {
        let point =
            |i: usize| [(i * 37 % 101) as f32 * 0.1, (i * 53 % 97) as f32 * 0.1, (i * 71 % 13) as f32];
        let points: Vec<Point> = (0..600).map(point).collect();
        let places: Vec<Point> = (600..900).map(point).map(|p| p.map(|x| x - 0.3)).collect();
        let index = NeighborIndex::new(&points, 1.0);
        let together = index.map_moments(&places, 1.2, <[_]>::to_vec);
        assert_eq!(together.len(), places.len());
        for (place, moments) in places.iter().zip(together) {
            let single = index.map_moments(std::slice::from_ref(place), 1.2, <[_]>::to_vec)[0];
            assert_eq!(moments.count, single.count);
            let sums = moments.sum.iter().zip(&single.sum);
            for (x, y) in sums.chain(moments.products.iter().zip(&single.products)) {
                assert!((x - y).abs() < 1e-3, "{x} is not {y}");
            }
        }
    }

    #[test]
    fn without_points_nothing_is_near() {
        let nothing = NeighborIndex::new(&[], 1.0);
        nothing.within(&[0.0; 3], 1.0, |i, _| panic!("point {i} does not exist"));
        assert_eq!(nothing.pairs(1.0).by_point().count(), 0);
        assert_eq!(nothing.map_moments(&[[0.0; 3]], 1.0, <[_]>::to_vec), [Moments::default()]);
    }
}
