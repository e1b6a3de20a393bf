//! Where the sensor stood. Free space and the side that normals face both depend on it, so an assumed position is
//! tested: a sensor sees what it scans, so few of its points may be hidden behind others.

use serde::{Deserialize, Serialize};

use super::range_image::RangeImage;
use crate::geometry::Point;

/// Largest hidden share at which a position is believed. A single view measures at most 0.05 from the right position, fragments
/// fused from a moving camera up to 0.12, wrong positions 0.13 to 0.5.
const MAX_HIDDEN: f64 = 0.15;
/// Above this the assumed position is doubted, and other viewpoints are tried …
const DOUBTED: f64 = 0.1;
/// … of which one is taken only if it hides less than this share of what the assumed one hides.
const CLEARLY_BETTER: f64 = 0.25;
/// Distant viewpoints are tried this many extents away.
const FAR: f32 = 6.0;

/// Where the sensor stood while it took the scan, in the scan's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub enum SensorPosition {
    /// Nobody said: the origin of the scan's frame is assumed, tested, and given up when the points speak against it.
    #[default]
    Assumed,
    /// The file or the request said where. Metres.
    Known([f64; 3]),
}

/// A viewpoint and what was seen from it.
#[derive(Debug, Clone)]
pub struct Viewpoint {
    /// Normals face this point. Metres, in the frame of the points given.
    pub position: Point,
    /// The range image, when the position can be believed; without one nothing is said about free space.
    pub range_image: Option<RangeImage>,
    /// The share of the scan's points that are hidden from the position.
    pub hidden_share: f64,
}

/// Finds the viewpoint of a scan. `origin` is where the origin of the scan's frame lies in the frame of `points`.
#[must_use]
pub fn viewpoint(
    points: &[Point],
    sensor: SensorPosition,
    origin: Point,
    resolution: f32,
    extent: f32,
) -> Viewpoint {
    let see = |position: Point| {
        let (image, hidden_share) = RangeImage::render(points, position, resolution);
        Viewpoint { position, range_image: (hidden_share <= MAX_HIDDEN).then_some(image), hidden_share }
    };
    let first = match sensor {
        SensorPosition::Known(p) => {
            return see(std::array::from_fn(|k| (p[k] + f64::from(origin[k])) as f32));
        }
        SensorPosition::Assumed => see(origin),
    };
    if first.hidden_share <= DOUBTED {
        return first;
    }
    let centroid: Point = std::array::from_fn(|k| {
        (points.iter().map(|p| f64::from(p[k])).sum::<f64>() / points.len().max(1) as f64) as f32
    });
    let mut best: Option<Viewpoint> = None;
    for axis in 0..3 {
        for sign in [1.0, -1.0] {
            let mut position = centroid;
            position[axis] += sign * FAR * extent;
            let seen = see(position);
            if best.as_ref().is_none_or(|best| seen.hidden_share < best.hidden_share) {
                best = Some(seen);
            }
        }
    }
    match best {
        // A guessed direction orients normals, but is too vague to say what the sensor saw through.
        Some(best) if best.hidden_share < CLEARLY_BETTER * first.hidden_share => {
            Viewpoint { range_image: None, ..best }
        }
        _ => first,
    }
}
