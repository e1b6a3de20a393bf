//! Which scans truly see the same surfaces, and how far an error of their relative pose moves those.
//!
//! For scenes whose truth is poses only. A point of one scan is shared when the other scan has a point within a radius at the true
//! poses, with a normal that faces the same way: what is seen from both sides of a thin wall is not shared.

use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::control::{Cancelled, Control};
use crate::geometry::{NearestGrid, Point, Pose};

/// Points of each scan that are asked for a share, about; more change it by less than a percent.
const SAMPLE: usize = 3000;

/// One scan at its true place.
#[derive(Debug, Clone, Copy)]
pub struct SurfaceAtTruth<'a> {
    /// Evenly spread points, metres, in the frame of `truth_from_points`.
    pub points: &'a [Point],
    /// Their unit normals, facing the sensor.
    pub normals: &'a [Point],
    /// Maps them into the frame of the truth.
    pub truth_from_points: Pose,
    /// Scans of different groups are of different places, and share nothing.
    pub group: usize,
}

/// A pair of scans that share surface.
#[derive(Debug, Clone, PartialEq)]
pub struct Overlap {
    /// A scan.
    pub i: usize,
    /// Another scan, after `i`.
    pub j: usize,
    /// Shared points of both scans among all points of both.
    pub share: f64,
    /// Mean of the shared points of scan j in the frame of its points, metres.
    pub mean_in_j: Vector3<f64>,
    /// Their mean outer product about that mean, square metres.
    pub covariance_in_j: Matrix3<f64>,
}

impl Overlap {
    /// The root mean square distance by which an error moves the shared points, metres:
    /// `E[|e(q) - q|^2] = |e(m) - m|^2 + tr((R - I) C (R - I)^T)`. The error maps the frame of j's points to itself.
    #[must_use]
    pub fn rms(&self, error: &Pose) -> f64 {
        let turn = error.rotation.matrix() - Matrix3::identity();
        let shift = turn * self.mean_in_j + error.translation;
        (shift.norm_squared() + (turn * self.covariance_in_j * turn.transpose()).trace()).max(0.0).sqrt()
    }
}

/// All pairs that share more than `least_share` of their points, ascending. `radius` is in metres.
pub fn overlaps(
    surfaces: &[SurfaceAtTruth<'_>],
    radius: f64,
    least_share: f64,
    control: Control<'_>,
) -> Result<Vec<Overlap>, Cancelled> {
    let grids: Vec<NearestGrid> =
        surfaces.par_iter().map(|s| NearestGrid::new(s.points, (radius / 1.5) as f32)).collect();
    let pairs: Vec<(usize, usize)> = (0..surfaces.len())
        .flat_map(|i| (i + 1..surfaces.len()).map(move |j| (i, j)))
        .filter(|&(i, j)| surfaces[i].group == surfaces[j].group)
        .collect();
    let found: Vec<Option<Overlap>> = pairs
        .into_par_iter()
        .map(|(i, j)| {
            control.check()?;
            let j_on_i = shared(&surfaces[i], &grids[i], &surfaces[j], radius);
            let i_on_j = shared(&surfaces[j], &grids[j], &surfaces[i], radius);
            let share = (j_on_i.points.len() + i_on_j.points.len()) as f64
                / (j_on_i.asked + i_on_j.asked).max(1) as f64;
            Ok((share > least_share && !j_on_i.points.is_empty()).then(|| j_on_i.overlap(i, j, share)))
        })
        .collect::<Result<_, Cancelled>>()?;
    Ok(found.into_iter().flatten().collect())
}

struct Shared {
    asked: usize,
    points: Vec<Vector3<f64>>,
}

impl Shared {
    fn overlap(&self, i: usize, j: usize, share: f64) -> Overlap {
        let n = self.points.len() as f64;
        let mean_in_j = self.points.iter().sum::<Vector3<f64>>() / n;
        let outer = |p: &Vector3<f64>| (p - mean_in_j) * (p - mean_in_j).transpose();
        let covariance_in_j = self.points.iter().map(outer).sum::<Matrix3<f64>>() / n;
        Overlap { i, j, share, mean_in_j, covariance_in_j }
    }
}

/// The points of `other`, in its own frame, that lie on `on`.
fn shared(on: &SurfaceAtTruth<'_>, grid: &NearestGrid, other: &SurfaceAtTruth<'_>, radius: f64) -> Shared {
    let on_from_other = on.truth_from_points.inverse() * other.truth_from_points;
    let mut shared = Shared { asked: 0, points: Vec::new() };
    let step = other.points.len().div_ceil(SAMPLE).max(1);
    for (point, normal) in other.points.iter().zip(other.normals).step_by(step) {
        shared.asked += 1;
        let moved = on_from_other.transform_point(*point);
        let Some(near) = grid.nearest(&moved) else { continue };
        let distance = (Vector3::from(moved) - Vector3::from(on.points[near])).norm();
        let facing = on_from_other.rotation * Vector3::from(*normal).cast::<f64>();
        if f64::from(distance) < radius && facing.dot(&Vector3::from(on.normals[near]).cast::<f64>()) > 0.0 {
            shared.points.push(Vector3::from(*point).cast());
        }
    }
    shared
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use nalgebra::Rotation3;

    /// A floor of 4 x 2 m in voxels of 0.1 m.
    fn floor() -> (Vec<Point>, Vec<Point>) {
        let points: Vec<Point> =
            (0..800).map(|k| [0.1 * (k % 40) as f32, 0.1 * (k / 40) as f32, 0.0]).collect();
        let normals = vec![[0.0, 0.0, 1.0]; points.len()];
        (points, normals)
    }

    fn found(surfaces: &[SurfaceAtTruth<'_>]) -> Vec<Overlap> {
        let cancel = CancelToken::new();
        overlaps(surfaces, 0.15, 0.1, Control { cancel: &cancel, observer: &Silent }).unwrap()
    }

    #[test]
    fn the_share_is_of_the_points_seen_from_the_same_side_in_the_same_group() {
        let (points, up) = floor();
        let down = vec![[0.0, 0.0, -1.0]; points.len()];
        let at = |x: f64, normals, group| SurfaceAtTruth {
            points: &points,
            normals,
            truth_from_points: Pose::from_translation(Vector3::new(x, 0.0, 0.02)),
            group,
        };
        let pairs =
            found(&[at(0.0, &up, 0), at(3.0, &up, 0), at(5.0, &up, 0), at(0.0, &down, 0), at(0.0, &up, 1)]);
        let ends: Vec<(usize, usize)> = pairs.iter().map(|o| (o.i, o.j)).collect();
        assert_eq!(ends, [(0, 1), (1, 2)]);
        assert!((pairs[0].share - 0.25).abs() < 0.06 && (pairs[1].share - 0.5).abs() < 0.06, "{pairs:?}");
    }

    #[test]
    fn the_distance_is_that_of_the_shared_points() {
        let (points, up) = floor();
        let turned = Pose::new(Rotation3::new(Vector3::new(0.2, 0.5, -2.0)), Vector3::new(3.0, 1.0, 0.0));
        let surface = SurfaceAtTruth { points: &points, normals: &up, truth_from_points: turned, group: 0 };
        let pairs = found(&[surface, surface]);
        let error = Pose::new(Rotation3::new(Vector3::new(0.4, -1.0, 0.7)), Vector3::new(0.1, 0.0, -0.3));
        let squares = points
            .iter()
            .map(|p| Vector3::from(*p).cast::<f64>())
            .map(|q| (error.transform(&q) - q).norm_squared());
        let direct = (squares.sum::<f64>() / points.len() as f64).sqrt();
        assert!((pairs[0].rms(&error) - direct).abs() < 1e-6, "{} is not {direct}", pairs[0].rms(&error));
        assert_eq!(pairs[0].rms(&Pose::identity()), 0.0);
    }
}
