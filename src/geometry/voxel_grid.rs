//! Points sorted into the cells of a regular grid.

use super::Point;

/// The cell of a point in a grid of `size` metres anchored at the frame's origin.
#[must_use]
pub fn cell_of(point: &Point, size: f32) -> [i64; 3] {
    point.map(|x| {
        let cells = f64::from(x) / f64::from(size);
        // The floor; what stands for it in the least processor's instructions is a call.
        let toward_zero = cells as i64;
        toward_zero.saturating_sub(i64::from(toward_zero as f64 > cells))
    })
}

/// Groups points by voxel: the indices of each occupied voxel's points, voxels in lexicographic order of their cells, points in
/// ascending order. The result does not depend on the order of `points` beyond the indices themselves.
#[must_use]
pub fn voxel_groups(points: &[Point], size: f32) -> Vec<Vec<u32>> {
    ByCell::of(points, size).groups().map(<[u32]>::to_vec).collect()
}

/// The centroid of each occupied voxel, in lexicographic order of the cells. Metres.
#[must_use]
pub fn voxel_centroids(points: &[Point], size: f32) -> Vec<Point> {
    ByCell::of(points, size)
        .groups()
        .map(|group| {
            let mut sum = [0.0_f64; 3];
            for &index in group {
                for (total, x) in sum.iter_mut().zip(points[index as usize]) {
                    *total += f64::from(x);
                }
            }
            sum.map(|total| (total / group.len() as f64) as f32)
        })
        .collect()
}

/// Number of occupied voxels.
#[must_use]
pub fn occupied_voxels(points: &[Point], size: f32) -> usize {
    ByCell::of(points, size).groups().len()
}

/// Points sorted by their cells, these in lexicographic order, and by number within a cell.
pub(super) struct ByCell {
    /// The points, by number.
    pub items: Vec<u32>,
    /// Where the points of each cell end.
    ends: Vec<u32>,
}

impl ByCell {
    /// Sorts points into cells of `size` metres.
    pub fn of(points: &[Point], size: f32) -> Self {
        let cells: Vec<[i64; 3]> = points.iter().map(|point| cell_of(point, size)).collect();
        match Axes::of(&cells) {
            // One number for each cell sorts without comparing.
            Some(axes) if axes.bits() <= u32::BITS => Self::radix(&cells, |cell| axes.number(cell) as u32),
            Some(axes) if axes.bits() <= u64::BITS => Self::radix(&cells, |cell| axes.number(cell)),
            _ => {
                let mut items: Vec<u32> = (0..).take(cells.len()).collect();
                items.sort_by_key(|item| cells[*item as usize]);
                let ends = ends(items.iter().map(|item| cells[*item as usize]));
                Self { items, ends }
            }
        }
    }

    fn radix<K: Copy + PartialEq + radsort::Key>(
        cells: &[[i64; 3]],
        number: impl Fn(&[i64; 3]) -> K,
    ) -> Self {
        let mut keys: Vec<(K, u32)> = cells.iter().map(number).zip(0..).collect();
        radsort::sort_by_key(&mut keys, |(key, _)| *key);
        let ends = ends(keys.iter().map(|(key, _)| *key));
        Self { items: keys.into_iter().map(|(_, item)| item).collect(), ends }
    }

    /// The points of each cell that has any.
    pub fn groups(&self) -> impl ExactSizeIterator<Item = &[u32]> {
        let mut begin = 0;
        self.ends.iter().map(move |end| {
            let group = begin..*end as usize;
            begin = group.end;
            &self.items[group]
        })
    }
}

/// Where each run of equal things ends.
fn ends<T: PartialEq>(sorted: impl Iterator<Item = T>) -> Vec<u32> {
    let mut ends = Vec::new();
    let mut last = None;
    for (at, one) in (1..).zip(sorted) {
        match ends.last_mut() {
            Some(end) if last.as_ref() == Some(&one) => *end = at,
            _ => ends.push(at),
        }
        last = Some(one);
    }
    ends
}

/// The least and the greatest number along each axis of some cells; `None` without any.
pub(super) fn box_of(cells: &[[i64; 3]]) -> Option<([i64; 3], [i64; 3])> {
    let first = *cells.first()?;
    let (mut low, mut high) = (first, first);
    for cell in cells {
        for k in 0..3 {
            low[k] = low[k].min(cell[k]);
            high[k] = high[k].max(cell[k]);
        }
    }
    Some((low, high))
}

/// How far cells reach along each axis, so that one number can stand for each of them, in their order.
struct Axes {
    low: [i64; 3],
    bits: [u32; 3],
}

impl Axes {
    /// Of cells, of which there must be some; `None` if they lie so far apart that the distance is no number.
    fn of(cells: &[[i64; 3]]) -> Option<Self> {
        let (low, high) = box_of(cells)?;
        let mut bits = [0; 3];
        for k in 0..3 {
            bits[k] = u64::BITS - (high[k].checked_sub(low[k])? as u64).leading_zeros();
        }
        Some(Self { low, bits })
    }

    fn bits(&self) -> u32 {
        self.bits.iter().sum()
    }

    /// The number of a cell, of as many bits as all axes together, which must be 64 at most.
    fn number(&self, cell: &[i64; 3]) -> u64 {
        (0..3).fold(0, |number, k| (number << self.bits[k]) | (cell[k] - self.low[k]) as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_keeps_the_centroid_of_its_points() {
        let points = [[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [-0.1, 0.2, 0.2]];
        let centroids = voxel_centroids(&points, 0.5);
        assert_eq!(centroids.len(), 2);
        assert_eq!(centroids[0], [-0.1, 0.2, 0.2]);
        assert!((centroids[1][0] - 0.2).abs() < 1e-6);
        assert_eq!(occupied_voxels(&points, 0.5), 2);
        assert_eq!(voxel_groups(&points, 0.5), vec![vec![2], vec![0, 1]]);

        // Points so far away that the shorter numbers of cells do not reach them, nor any.
        for far in [[3e9, 0.0, 0.0], [3e5; 3], [3e9; 3], [9e17; 3]] {
            let far = [points[0], far, points[1], points[2]];
            assert_eq!(voxel_groups(&far, 0.5), vec![vec![3], vec![0, 2], vec![1]]);
        }
        let everywhere = [points[0], [f32::MAX; 3], points[1], points[2], [f32::MIN; 3]];
        assert_eq!(voxel_groups(&everywhere, 0.5), vec![vec![4], vec![3], vec![0, 2], vec![1]]);
    }

    #[test]
    fn a_cell_reaches_from_its_floor_to_the_next() {
        assert_eq!(cell_of(&[-0.5, 0.0, 0.5], 0.5), [-1, 0, 1]);
        assert_eq!(cell_of(&[-0.51, -0.01, 0.49], 0.5), [-2, -1, 0]);
        assert_eq!(cell_of(&[f32::NEG_INFINITY, f32::INFINITY, f32::NAN], 0.5), [i64::MIN, i64::MAX, 0]);
    }
}
