//! Points sorted into the cells of a regular grid.

use super::Point;

/// The cell of a point in a grid of `size` metres anchored at the frame's origin.
#[must_use]
pub fn cell_of(point: &Point, size: f32) -> [i64; 3] {
    point.map(|x| (f64::from(x) / f64::from(size)).floor() as i64)
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
    if let Some(keys) = short_keys(&cells) {
        // The point's number is in the low half of its key.
        return keys.into_iter().map(|key| (cells[key as u32 as usize], key as u32)).collect();
    }
    let mut order: Vec<_> = cells.into_iter().zip(0..).collect();
    order.sort_unstable();
    order
}

/// Cells and numbers of all points, sorted, as one number each, which compares without a branch. `None` if the points spread over
/// too many cells along an axis.
fn short_keys(cells: &[[i64; 3]]) -> Option<Vec<u128>> {
    const AXIS_BITS: u32 = 32;
    let mut low = *cells.first()?;
    let mut high = low;
    for cell in cells {
        for k in 0..3 {
            low[k] = low[k].min(cell[k]);
            high[k] = high[k].max(cell[k]);
        }
    }
    if (0..3).any(|k| high[k].checked_sub(low[k]).is_none_or(|span| span >> AXIS_BITS != 0)) {
        return None;
    }
    let mut keys: Vec<u128> = cells
        .iter()
        .zip(0_u32..)
        .map(|(cell, number)| {
            let axes = (0..3).fold(0, |key, k| (key << AXIS_BITS) | (cell[k] - low[k]) as u128);
            (axes << 32) | u128::from(number)
        })
        .collect();
    keys.sort_unstable();
    Some(keys)
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

        // A point so far away that the short way to sort does not reach it.
        let far = [points[0], [3e9, 0.0, 0.0], points[1], points[2]];
        assert_eq!(voxel_groups(&far, 0.5), vec![vec![3], vec![0, 2], vec![1]]);
    }
}
