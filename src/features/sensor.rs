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
/// Hidden shares that differ by less than this do not tell two viewpoints apart: a relief looks as complete from behind. Then the
/// first of [`FAR_SIDES`] is taken for every scan alike, so that the normals of scans from one sensor agree with each other.
const INDISTINCT: f64 = 0.03;
/// Axis and side of the distant viewpoints: first those along the axis that is depth in most sensors' frames.
const FAR_SIDES: [(usize, f32); 6] = [(2, -1.0), (2, 1.0), (0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0)];
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
    let far: Vec<Viewpoint> = FAR_SIDES
        .iter()
        .map(|&(axis, sign)| {
            let mut position = centroid;
            position[axis] += sign * FAR * extent;
            see(position)
        })
        .collect();
    let least = far.iter().map(|view| view.hidden_share).fold(f64::INFINITY, f64::min);
    let best = far.into_iter().find(|view| view.hidden_share <= least + INDISTINCT);
    match best {
        // A guessed direction orients normals, but is too vague to say what the sensor saw through.
        Some(best) if best.hidden_share < CLEARLY_BETTER * first.hidden_share => {
            Viewpoint { range_image: None, ..best }
        }
        _ => first,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A rippled plate of 0.2 m in the xy plane.
    fn relief() -> Vec<Point> {
        (0..40_000)
            .map(|i| {
                let (x, y) = ((i % 200) as f32 * 0.001, (i / 200) as f32 * 0.001);
                [x, y, 0.03 * (60.0 * x).sin()]
            })
            .collect()
    }

    #[test]
    fn reliefs_that_look_alike_from_both_sides_are_all_seen_from_the_same_side() {
        let mirrored: Vec<Point> = relief().iter().map(|p| [p[0], p[1], -p[2]]).collect();
        for points in [relief(), mirrored] {
            // From its edge each ripple hides the next, so the origin there is not believed.
            let view = viewpoint(&points, SensorPosition::Assumed, [1.0, 0.1, 0.0], 0.004, 0.28);
            assert!(view.position[2] < -1.0, "{:?}", view.position);
            assert!(view.range_image.is_none(), "a guessed direction says nothing of free space");
        }
    }

    #[test]
    fn a_known_position_is_taken_in_the_frame_of_the_file() {
        let view =
            viewpoint(&relief(), SensorPosition::Known([1000.1, 0.1, 2.0]), [-1000.0, 0.0, 0.0], 0.004, 0.28);
        assert!((view.position[0] - 0.1).abs() < 1e-4 && view.position[2] == 2.0);
        assert!(view.range_image.is_some());
    }
}
