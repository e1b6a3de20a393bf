//! How much two scans share under the truth. Used by the survey, and so by tests and calibration.

use std::collections::HashMap;

use nalgebra::Vector3;

use crate::cloud::PointCloud;
use crate::geometry::Pose;

/// At most about this many points are asked for a share; more change it by less than a percent.
const SAMPLE: usize = 3000;

/// The points of one scan in the world, sorted into cells as wide as the tolerance.
pub(super) struct Neighbourhood {
    cells: HashMap<[i32; 3], Vec<Vector3<f32>>>,
    tolerance: f32,
}

impl Neighbourhood {
    pub(super) fn new(cloud: &PointCloud, world_from_scan: &Pose, tolerance: f32) -> Self {
        let mut cells: HashMap<_, Vec<_>> = HashMap::new();
        for point in &cloud.points {
            let point = Vector3::from(world_from_scan.transform_point(*point));
            cells.entry(cell(&point, tolerance)).or_default().push(point);
        }
        Self { cells, tolerance }
    }

    /// Share of a scan's points with a neighbour within the tolerance; zero for an empty scan.
    pub(super) fn share_of(&self, cloud: &PointCloud, world_from_scan: &Pose) -> f64 {
        let sample = cloud.points.iter().step_by(cloud.len().div_ceil(SAMPLE).max(1));
        let (near, all) = sample.fold((0usize, 0usize), |(near, all), point| {
            let point = Vector3::from(world_from_scan.transform_point(*point));
            (near + usize::from(self.around(&point).next().is_some()), all + 1)
        });
        near as f64 / all.max(1) as f64
    }

    /// The points within the tolerance of a place.
    pub(super) fn around(&self, place: &Vector3<f32>) -> impl Iterator<Item = &Vector3<f32>> {
        let [x, y, z] = cell(place, self.tolerance);
        let cells = (0..27).map(move |i| [x + i % 3 - 1, y + i / 3 % 3 - 1, z + i / 9 - 1]);
        let (place, tolerance) = (*place, self.tolerance);
        cells
            .filter_map(|cell| self.cells.get(&cell))
            .flatten()
            .filter(move |point| (*point - place).norm() <= tolerance)
    }
}

fn cell(point: &Vector3<f32>, size: f32) -> [i32; 3] {
    [point.x, point.y, point.z].map(|x| (x / size).floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_share_counts_the_points_within_the_tolerance_in_the_world() {
        let line = PointCloud::from_points((0..100).map(|i| [i as f32 * 0.1, 0.0, 0.0]).collect());
        let index = Neighbourhood::new(&line, &Pose::identity(), 0.05);
        let moved = Pose::from_translation(Vector3::new(5.0, 0.03, 0.0));
        assert!((index.share_of(&line, &moved) - 0.5).abs() < 0.02);
        assert!(index.share_of(&line, &Pose::from_translation(Vector3::new(0.0, 0.06, 0.0))) < 1e-9);
        assert_eq!(index.around(&Vector3::new(0.2, 0.0, 0.04)).count(), 1);
    }
}
