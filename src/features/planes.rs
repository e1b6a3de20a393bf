//! Where a scan's planes lie, when its normals concentrate in three orthogonal directions, as in most of what people build: the
//! directions, and along each of them how much surface lies at which offset. Two such scans can be aligned by their
//! planes alone (`pairwise::planar`). Nothing says which direction is up.

use nalgebra::{Matrix3, Rotation3, Vector3};

use crate::geometry::Point;

/// Normals within 10 degrees of a direction belong to it.
const NEAR: f32 = 0.985;
/// Normals that count for the offsets lie within 20 degrees: those of small or noisy surfaces too.
const FACING: f32 = 0.94;
/// A direction is sought across the first one within 10 degrees of its plane.
const ACROSS: f32 = 0.17;
/// Normals looked at, and directions tried, at most: evenly spread over the scan.
const NORMALS: usize = 2000;
const CANDIDATES: usize = 200;
const ROUNDS: usize = 3;
/// Normals concentrate when at least this share belongs to one of the three directions (chance: 0.045) …
const LEAST_SHARE: f64 = 0.25;
/// … and this share to the second: with one direction alone, the other two are arbitrary.
const LEAST_SECOND: f64 = 0.05;
/// Offsets that are kept, in voxels, to both sides of their median.
const REACH: i32 = 192;

/// The planes of a scan.
#[derive(Debug, Clone)]
pub struct PlaneProfile {
    /// Maps coordinates along the three directions into the scan's local frame.
    pub local_from_axes: Rotation3<f64>,
    /// For each direction the surfaces that face along it, and those that face against it.
    pub offsets: [[Offsets; 2]; 3],
}

/// How much surface lies where along a direction.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Offsets {
    /// Offset of the first entry, in voxels from the origin of the local frame.
    pub first: i32,
    /// For each voxel of offset eight times the square root of the number of points there, blurred over its neighbours. The root
    /// makes two small surfaces that agree worth more than a part of a large one.
    pub amounts: Vec<u16>,
}

impl Offsets {
    /// One past the offset of the last entry.
    #[must_use]
    pub fn end(&self) -> i32 {
        self.first + self.amounts.len() as i32
    }

    /// The same seen along the opposite direction.
    #[must_use]
    pub fn reversed(&self) -> Self {
        Self { first: -self.end(), amounts: self.amounts.iter().rev().copied().collect() }
    }
}

impl PlaneProfile {
    /// The profile of a scan, or `None` where its normals do not concentrate in three orthogonal directions. Points in metres,
    /// unit normals that face the sensor, voxel size in metres.
    #[must_use]
    pub fn of(points: &[Point], normals: &[Point], voxel: f32) -> Option<Self> {
        let axes = directions(normals)?;
        let offsets = std::array::from_fn(|k| offsets(points, normals, &axes.column(k).into_owned(), voxel));
        Some(Self { local_from_axes: Rotation3::from_matrix_unchecked(axes.cast()), offsets })
    }
}

/// The three directions as columns of a rotation.
fn directions(normals: &[Point]) -> Option<Matrix3<f32>> {
    let step = normals.len().div_ceil(NORMALS).max(1);
    let some: Vec<Vector3<f32>> = normals.iter().step_by(step).map(|n| Vector3::from(*n)).collect();
    let first = strongest(&some)?;
    let across: Vec<Vector3<f32>> = some
        .iter()
        .filter(|n| n.dot(&first).abs() < ACROSS)
        .filter_map(|n| (n - first * n.dot(&first)).try_normalize(1e-6))
        .collect();
    let second = strongest(&across)?;
    let second = (second - first * second.dot(&first)).try_normalize(1e-6)?;
    let mut axes = Matrix3::from_columns(&[first, second, first.cross(&second)]);
    let mut shares = [0.0; 3];
    for _ in 0..ROUNDS {
        // The rotation nearest to the mean of what belongs to each direction.
        let mut means = Matrix3::zeros();
        for k in 0..3 {
            let (sum, count) = gather(&some, &axes.column(k).into_owned());
            means.set_column(k, &sum);
            shares[k] = count as f64 / some.len() as f64;
        }
        let svd = means.svd(true, true);
        let nearest = svd.u? * svd.v_t?;
        if nearest.determinant() < 0.5 {
            break;
        }
        axes = nearest;
    }
    shares.sort_by(f64::total_cmp);
    (shares.iter().sum::<f64>() >= LEAST_SHARE && shares[1] >= LEAST_SECOND).then_some(axes)
}

/// The direction that most normals belong to, either way round.
fn strongest(normals: &[Vector3<f32>]) -> Option<Vector3<f32>> {
    let step = normals.len().div_ceil(CANDIDATES).max(1);
    let mut best: Option<(usize, &Vector3<f32>)> = None;
    for candidate in normals.iter().step_by(step) {
        let count = normals.iter().filter(|n| n.dot(candidate).abs() > NEAR).count();
        if best.is_none_or(|(most, _)| count > most) {
            best = Some((count, candidate));
        }
    }
    let mut direction = *best?.1;
    for _ in 0..ROUNDS {
        direction = gather(normals, &direction).0.try_normalize(1e-6)?;
    }
    Some(direction)
}

/// The sum, turned to its side, and the number of the normals that belong to a direction.
fn gather(normals: &[Vector3<f32>], direction: &Vector3<f32>) -> (Vector3<f32>, usize) {
    normals.iter().fold((Vector3::zeros(), 0), |(sum, count), n| {
        let along = n.dot(direction);
        if along.abs() > NEAR { (sum + n * along.signum(), count + 1) } else { (sum, count) }
    })
}

/// The offsets along a direction: of surfaces that face along it, and against it.
fn offsets(points: &[Point], normals: &[Point], direction: &Vector3<f32>, voxel: f32) -> [Offsets; 2] {
    let mut found: Vec<(i32, bool)> = points
        .iter()
        .zip(normals)
        .filter_map(|(point, normal)| {
            let along = Vector3::from(*normal).dot(direction);
            let at = (Vector3::from(*point).dot(direction) / voxel).floor() as i32;
            (along.abs() > FACING).then_some((at, along > 0.0))
        })
        .collect();
    found.sort_unstable();
    let Some(&(median, _)) = found.get(found.len() / 2) else { return Default::default() };
    found.retain(|(at, _)| at.saturating_sub(median).unsigned_abs() < REACH as u32);
    // One entry more on both sides for the blur.
    let (low, high) = (found[0].0 - 1, found[found.len() - 1].0 + 1);
    [true, false].map(|side| {
        let mut counts = vec![0.0_f32; (high - low + 1) as usize];
        for (at, along) in &found {
            if *along == side {
                counts[(at - low) as usize] += 1.0;
            }
        }
        let at = |i: usize| counts.get(i).copied().unwrap_or(0.0);
        let amount = |i: usize| {
            (8.0 * (0.5 * at(i) + 0.25 * (at(i.wrapping_sub(1)) + at(i + 1))).sqrt()).round() as u16
        };
        Offsets { first: low, amounts: (0..counts.len()).map(amount).collect() }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The inner surface of a box from the origin to `size`, in voxels of 1, seen from within, turned by `rotation`.
    fn room(size: [i32; 3], rotation: &Rotation3<f32>) -> (Vec<Point>, Vec<Point>) {
        let mut surface = Vec::new();
        for k in 0..3 {
            let (u, v) = ((k + 1) % 3, (k + 2) % 3);
            for i in 0..size[u] {
                for j in 0..size[v] {
                    for (at, side) in [(0.0, 1.0), (size[k] as f32, -1.0)] {
                        let (mut p, mut n) = (Vector3::zeros(), Vector3::zeros());
                        (p[k], p[u], p[v]) = (at, i as f32 + 0.5, j as f32 + 0.5);
                        n[k] = side;
                        let (p, n) = (rotation * p, rotation * n);
                        surface.push(([p.x, p.y, p.z], [n.x, n.y, n.z]));
                    }
                }
            }
        }
        surface.into_iter().unzip()
    }

    #[test]
    fn the_walls_of_a_turned_room_are_found_where_they_are() {
        let rotation = Rotation3::new(Vector3::new(0.4, -0.9, 0.3));
        let (points, normals) = room([40, 30, 20], &rotation);
        let profile = PlaneProfile::of(&points, &normals, 1.0).expect("a room has three directions");
        for k in 0..3 {
            let axis = (profile.local_from_axes * Vector3::ith(k, 1.0)).cast::<f32>();
            let room_axis = rotation.inverse() * axis;
            let along = room_axis.iamax();
            assert!(room_axis[along].abs() > 0.9999, "{room_axis}");
            // The two walls across this direction are as far apart as the room is wide.
            let most =
                |o: &Offsets| o.first + (0..o.amounts.len()).max_by_key(|i| o.amounts[*i]).unwrap() as i32;
            let [with, against] = &profile.offsets[k];
            assert!((most(against) - most(with) - [40, 30, 20][along]).abs() <= 1);
            let flipped = against.reversed();
            assert!((most(&flipped) + most(against) + 1).abs() <= 1);
        }
    }

    #[test]
    fn a_ball_a_lone_plane_and_nothing_have_no_three_directions() {
        let ball: Vec<Point> = (0..3000)
            .map(|i| {
                let z = 1.0 - (i as f32 + 0.5) / 1500.0;
                let (r, angle) = ((1.0 - z * z).sqrt(), i as f32 * 2.4);
                [r * angle.cos(), r * angle.sin(), z]
            })
            .collect();
        let floor = vec![[0.0, 0.0, 1.0]; 3000];
        assert!(PlaneProfile::of(&ball, &ball, 0.1).is_none());
        assert!(PlaneProfile::of(&ball, &floor, 0.1).is_none());
        assert!(PlaneProfile::of(&[], &[], 0.1).is_none());
    }
}
