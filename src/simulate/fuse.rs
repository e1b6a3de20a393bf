//! Many frames made one cloud: the mean of the points of each small voxel, as volumetric fusion gives it. Points that one frame alone
//! saw are mostly flying pixels and are left out. Used by [`super::acquire`].

use crate::cloud::PointCloud;
use crate::geometry::{Point, voxel_groups};

/// Fewest points that make a voxel of the fused cloud.
const LEAST: usize = 2;

/// Fuses points, and their colours if there are any, in voxels of `size` metres.
pub(super) fn fuse(points: &[Point], colors: &[[u8; 3]], size: f32) -> PointCloud {
    let groups: Vec<Vec<u32>> =
        voxel_groups(points, size).into_iter().filter(|group| group.len() >= LEAST).collect();
    let mean = |group: &[u32], value: &dyn Fn(usize) -> [f32; 3]| -> [f32; 3] {
        let sum = group
            .iter()
            .map(|&i| value(i as usize))
            .fold([0.0; 3], |sum: [f32; 3], x| [sum[0] + x[0], sum[1] + x[1], sum[2] + x[2]]);
        sum.map(|total| total / group.len() as f32)
    };
    let mut cloud = PointCloud::from_points(groups.iter().map(|group| mean(group, &|i| points[i])).collect());
    if !colors.is_empty() {
        cloud.colors = groups
            .iter()
            .map(|group| mean(group, &|i| colors[i].map(f32::from)).map(|channel| channel.round() as u8))
            .collect();
    }
    cloud
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn voxels_get_the_mean_of_their_points_and_lonely_points_go() {
        let points = [[0.01, 0.0, 0.0], [0.03, 0.02, 0.0], [0.9, 0.9, 0.9]];
        let colors = [[10, 20, 30], [30, 20, 10], [1, 1, 1]];
        let cloud = fuse(&points, &colors, 0.1);
        assert_eq!(cloud.colors, [[20, 20, 20]]);
        assert_eq!(cloud.len(), 1);
        assert!((cloud.points[0][0] - 0.02).abs() < 1e-6 && (cloud.points[0][1] - 0.01).abs() < 1e-6);
    }
}
