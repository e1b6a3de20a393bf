//! Where the sensor stood. Free space and the side that normals face both depend on it, so an assumed position is
//! tested: a sensor sees what it scans, so few of its points may be hidden behind others.

use serde::{Deserialize, Serialize};

use super::range_image::RangeImage;
use crate::cloud::face;
use crate::geometry::Point;

/// Largest hidden share at which a position is believed. A single view measures at most 0.05 from the right position, fragments
/// fused from a moving camera up to 0.15, wrong positions 0.05 to 0.5.
const MAX_HIDDEN: f64 = 0.15;
/// Above this the assumed position is doubted, and other viewpoints are tried …
const DOUBTED: f64 = 0.05;
/// … of which one is taken only if it hides less than this share of what the assumed one hides …
const CLEARLY_BETTER: f64 = 0.1;
/// … and if it sees at least this share of the surfaces from their other side. A statue whose frame begins elsewhere than at its scanner
/// shows the two viewpoints different sides of 0.1 to 0.33 of its surface; a wall that a moving camera saw, of 0.06 at most.
const OTHER_SIDE: f64 = 0.08;
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

/// How the sensor stood while it took the scan, as far as somebody said.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Stance {
    /// Where.
    pub position: SensorPosition,
    /// Against gravity, in the scan's own frame, of any length but zero.
    pub up: Option<[f64; 3]>,
}

impl From<SensorPosition> for Stance {
    fn from(position: SensorPosition) -> Self {
        Self { position, up: None }
    }
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

/// What a scan shows, in metres, all in one frame.
#[derive(Debug, Clone, Copy)]
pub struct Surfaces<'a> {
    /// The points, dense enough for a range image.
    pub points: &'a [Point],
    /// Fewer points …
    pub samples: &'a [Point],
    /// … and a unit normal of either sign for each of them that has one.
    pub normals: &'a [Option<Point>],
    /// Voxel size.
    pub resolution: f32,
    /// Size of the whole.
    pub extent: f32,
}

impl Surfaces<'_> {
    /// Share of the samples that two places see from different sides.
    fn seen_from_other_side(&self, a: &Point, b: &Point) -> f64 {
        let (mut differ, mut all) = (0_usize, 0_usize);
        for (at, normal) in self.samples.iter().zip(self.normals) {
            if let Some(normal) = normal {
                all += 1;
                differ += usize::from(face(*normal, at, a) != face(*normal, at, b));
            }
        }
        differ as f64 / all.max(1) as f64
    }
}

/// Finds the viewpoint of a scan. `origin` is where the origin of the scan's frame lies in the frame of its points.
#[must_use]
pub fn viewpoint(surfaces: &Surfaces<'_>, sensor: SensorPosition, origin: Point) -> Viewpoint {
    let Surfaces { points, resolution, extent, .. } = *surfaces;
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
        Some(best)
            if best.hidden_share < CLEARLY_BETTER * first.hidden_share
                && surfaces.seen_from_other_side(&first.position, &best.position) >= OTHER_SIDE =>
        {
            Viewpoint { range_image: None, ..best }
        }
        _ => first,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::normals;
    use crate::geometry::{NeighborIndex, voxel_centroids};

    /// A rippled plate of 0.2 m in the xy plane.
    fn relief() -> Vec<Point> {
        (0..40_000)
            .map(|i| {
                let (x, y) = ((i % 200) as f32 * 0.001, (i / 200) as f32 * 0.001);
                [x, y, 0.03 * (60.0 * x).sin()]
            })
            .collect()
    }

    fn seen(points: &[Point], sensor: SensorPosition, origin: Point) -> Viewpoint {
        let samples = voxel_centroids(points, 0.004);
        let normals = normals(&samples, &NeighborIndex::new(points, 0.008), 0.008);
        let surfaces =
            Surfaces { points, samples: &samples, normals: &normals, resolution: 0.004, extent: 0.28 };
        viewpoint(&surfaces, sensor, origin)
    }

    #[test]
    fn reliefs_that_look_alike_from_both_sides_are_all_seen_from_the_same_side() {
        let mirrored: Vec<Point> = relief().iter().map(|p| [p[0], p[1], -p[2]]).collect();
        for points in [relief(), mirrored] {
            // From its edge each ripple hides the next, so the origin there is not believed.
            let view = seen(&points, SensorPosition::Assumed, [1.0, 0.1, 0.0]);
            assert!(view.position[2] < -1.0, "{:?}", view.position);
            assert!(view.range_image.is_none(), "a guessed direction says nothing of free space");
        }
    }

    #[test]
    fn a_known_position_is_taken_in_the_frame_of_the_file() {
        let view = seen(&relief(), SensorPosition::Known([1000.1, 0.1, 2.0]), [-1000.0, 0.0, 0.0]);
        assert!((view.position[0] - 0.1).abs() < 1e-4 && view.position[2] == 2.0);
        assert!(view.range_image.is_some());
    }
}
