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
    let order = sorted_by_cell(points, size);
    order.chunk_by(|a, b| a.0 == b.0).map(|group| group.iter().map(|&(_, index)| index).collect()).collect()
}

/// The centroid of each occupied voxel, in lexicographic order of the cells. Metres.
#[must_use]
pub fn voxel_centroids(points: &[Point], size: f32) -> Vec<Point> {
    let order = sorted_by_cell(points, size);
    order
        .chunk_by(|a, b| a.0 == b.0)
        .map(|group| {
            let mut sum = [0.0_f64; 3];
            for &(_, index) in group {
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
    sorted_by_cell(points, size).chunk_by(|a, b| a.0 == b.0).count()
}

/// The points (by number) with their cells, sorted by both.
pub(super) fn sorted_by_cell(points: &[Point], size: f32) -> Vec<([i64; 3], u32)> {
    let cells: Vec<[i64; 3]> = points.iter().map(|point| cell_of(point, size)).collect();
    if let Some(numbers) = sorted_by_key(&cells) {
        return numbers.into_iter().map(|number| (cells[number as usize], number)).collect();
    }
    let mut order: Vec<_> = cells.into_iter().zip(0..).collect();
    order.sort_unstable();
    order
}

/// The numbers of the points sorted by cell and number, by one key each that holds both and compares without a branch. `None` if the points
/// spread over too many cells for that.
fn sorted_by_key(cells: &[[i64; 3]]) -> Option<Vec<u32>> {
    let mut low = *cells.first()?;
    let mut high = low;
    for cell in cells {
        for k in 0..3 {
            low[k] = low[k].min(cell[k]);
            high[k] = high[k].max(cell[k]);
        }
    }
    let bits = |most: u64| u64::BITS - most.leading_zeros();
    let number_bits = bits(cells.len() as u64);
    let mut axis_bits = [0; 3];
    for k in 0..3 {
        axis_bits[k] = bits(high[k].checked_sub(low[k])? as u64);
    }
    let key = |cell: &[i64; 3], number: u32| {
        let axes = (0..3).fold(0, |key: u128, k| (key << axis_bits[k]) | (cell[k] - low[k]) as u128);
        (axes << number_bits) | u128::from(number)
    };
    let keyed = cells.iter().zip(0_u32..);
    match axis_bits.iter().sum::<u32>() + number_bits {
        ..=64 => {
            let mut keys: Vec<u64> = keyed.map(|(cell, number)| key(cell, number) as u64).collect();
            keys.sort_unstable();
            Some(keys.into_iter().map(|key| (key & ((1 << number_bits) - 1)) as u32).collect())
        }
        65..=128 => {
            let mut keys: Vec<u128> = keyed.map(|(cell, number)| key(cell, number)).collect();
            keys.sort_unstable();
            Some(keys.into_iter().map(|key| (key & ((1 << number_bits) - 1)) as u32).collect())
        }
        _ => None,
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

        // Points so far away that the shorter keys do not reach them, nor any.
        for distance in [3e9, 9e17] {
            let far = [points[0], [distance; 3], points[1], points[2]];
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
