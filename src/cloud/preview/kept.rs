//! What is kept of a scan for a picture after its full cloud was dropped.

use nalgebra::Vector3;

use super::{PartColor, PreviewPart, scan_color};
use crate::cloud::PointCloud;
use crate::geometry::{Point, Pose};

/// Points worth keeping for a picture over all its scans: it has fewer pixels.
const KEPT: u64 = 4_000_000;

/// A thinned scan with its place in the model.
#[derive(Debug, Clone)]
pub struct PreviewScan {
    points: Vec<Point>,
    colors: Vec<[u8; 3]>,
    model_from_points: Pose,
    sensor: Option<Point>,
}

impl PreviewScan {
    /// Keeps every `stride`-th point. `sensor_in_scan` is where the sensor stood, in the scan's own frame, metres, if that is to
    /// be marked.
    #[must_use]
    pub fn new(
        cloud: &PointCloud,
        stride: usize,
        model_from_scan: &Pose,
        sensor_in_scan: Option<[f64; 3]>,
    ) -> Self {
        let origin = Vector3::from(cloud.origin);
        let stride = stride.max(1);
        Self {
            points: cloud.points.iter().step_by(stride).copied().collect(),
            colors: cloud.colors.iter().step_by(stride).copied().collect(),
            model_from_points: *model_from_scan * Pose::from_translation(origin),
            sensor: sensor_in_scan.map(|p| (Vector3::from(p) - origin).cast::<f32>().into()),
        }
    }

    /// The stride at which scans of so many points in all are kept.
    #[must_use]
    pub fn stride(points: u64) -> usize {
        usize::try_from(points / KEPT).unwrap_or(usize::MAX - 1) + 1
    }

    /// To be drawn: in its own colours, or else in the colour of the scan with this index.
    #[must_use]
    pub fn part(&self, index: usize) -> PreviewPart<'_> {
        let color = if self.colors.is_empty() {
            PartColor::Uniform(scan_color(index))
        } else {
            PartColor::PerPoint(&self.colors)
        };
        PreviewPart {
            points: &self.points,
            model_from_scan: self.model_from_points,
            color,
            sensor_in_scan: self.sensor,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_points_with_their_colours_and_the_sensor_relative_to_them() {
        let cloud = PointCloud {
            points: (0..10u8).map(|i| [f32::from(i), 0.0, 0.0]).collect(),
            colors: (0..10).map(|i| [i, 0, 0]).collect(),
            origin: [1e6, 0.0, 0.0],
        };
        let kept = PreviewScan::new(&cloud, 4, &Pose::identity(), Some([1e6, 2.0, 0.0]));
        let part = kept.part(0);
        assert_eq!(part.points, [[0.0; 3], [4.0, 0.0, 0.0], [8.0, 0.0, 0.0]]);
        assert!(matches!(part.color, PartColor::PerPoint([_, [4, 0, 0], _])));
        assert_eq!(part.sensor_in_scan, Some([0.0, 2.0, 0.0]));
        assert_eq!(PreviewScan::stride(KEPT - 1), 1);
        assert_eq!(PreviewScan::stride(u64::MAX / 2) as u64, u64::MAX / 2 / KEPT + 1);
    }
}
