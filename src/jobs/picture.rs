//! The picture of a model.

use nalgebra::Vector3;

use super::ExportError;
use super::merge::Merge;
use super::originals::read_original;
use crate::cloud::{PartColor, PreviewOptions, PreviewPart, render, scan_color};
use crate::control::CancelToken;
use crate::features::SensorPosition;
use crate::geometry::{Point, Pose};

/// Points that are kept for the picture, over all scans: it has fewer pixels.
const KEPT: u64 = 4_000_000;

/// What is kept of one scan.
struct Part {
    points: Vec<Point>,
    colors: Vec<[u8; 3]>,
    model_from_points: Pose,
    sensor: Option<Point>,
}

/// Draws the scans as PNG: in their own colours where the files have them, otherwise one colour a scan.
pub(super) fn draw(merge: &Merge) -> Result<Vec<u8>, ExportError> {
    let total: u64 = merge.placed.iter().filter_map(|(scan, _)| scan.points).sum();
    let stride = usize::try_from(total / KEPT).unwrap_or(usize::MAX).saturating_add(1);
    let mut parts = Vec::with_capacity(merge.placed.len());
    for (scan, place) in &merge.placed {
        let original = read_original(&merge.blobs, scan, merge.max_points, &CancelToken::new())?;
        let (cloud, sensor) = (original.decoded.cloud, original.stance.position);
        let origin = Vector3::from(cloud.origin);
        let relative = |p: [f64; 3]| Point::from((Vector3::from(p) - origin).cast::<f32>());
        parts.push(Part {
            points: cloud.points.into_iter().step_by(stride).collect(),
            colors: cloud.colors.into_iter().step_by(stride).collect(),
            model_from_points: place.model_from_scan * Pose::from_translation(origin),
            sensor: match sensor {
                SensorPosition::Known(position) => Some(relative(position)),
                SensorPosition::Assumed => None,
            },
        });
    }
    let parts: Vec<PreviewPart<'_>> = parts.iter().enumerate().map(|(i, part)| part.preview(i)).collect();
    Ok(render(&parts, PreviewOptions::default()).to_png()?)
}

impl Part {
    fn preview(&self, index: usize) -> PreviewPart<'_> {
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
