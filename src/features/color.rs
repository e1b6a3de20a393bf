//! Colours of the points that a scan is thinned to.

use crate::geometry::{Point, cell_of};

/// The mean colour of all raw points in the voxel of each thinned one. `thinned` are centroids in a grid of `size` metres, in
/// lexicographic order of its cells. None where the raw points have no colours.
pub(super) fn thinned_colors(
    raw: &[Point],
    colors: &[[u8; 3]],
    thinned: &[Point],
    size: f32,
) -> Vec<[u8; 3]> {
    if raw.is_empty() || colors.len() != raw.len() {
        return Vec::new();
    }
    let cells: Vec<[i64; 3]> = thinned.iter().map(|point| cell_of(point, size)).collect();
    let mut sums = vec![[0_u64; 4]; cells.len()];
    let mut last = 0;
    for (point, color) in raw.iter().zip(colors) {
        let cell = cell_of(point, size);
        // Neighbours in a file are mostly neighbours in space.
        if cells.get(last) != Some(&cell) {
            // The centroid of points next to the border of a cell can be rounded over it.
            let Ok(found) = cells.binary_search(&cell) else { continue };
            last = found;
        }
        let sum = &mut sums[last];
        for (total, channel) in sum.iter_mut().zip(color) {
            *total += u64::from(*channel);
        }
        sum[3] += 1;
    }
    sums.into_iter()
        .map(|[r, g, b, count]| [r, g, b].map(|total| (total / count.max(1)).min(255) as u8))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::voxel_centroids;

    #[test]
    fn a_voxel_has_the_mean_colour_of_its_points_in_whatever_order_they_come() {
        let raw = [[0.1, 0.1, 0.1], [1.2, 0.0, 0.0], [0.3, 0.1, 0.1], [-0.1, 0.2, 0.2]];
        let colors = [[10, 0, 200], [1, 2, 3], [30, 0, 100], [255, 255, 255]];
        let thinned = voxel_centroids(&raw, 0.5);
        assert_eq!(thinned_colors(&raw, &colors, &thinned, 0.5), [[255, 255, 255], [20, 0, 150], [1, 2, 3]]);
        assert!(thinned_colors(&raw, &[], &thinned, 0.5).is_empty());
    }
}
