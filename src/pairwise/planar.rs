//! Hypotheses from planes alone: where two scans each see three orthogonal directions (`features::PlaneProfile`), the directions
//! leave 24 rotations, and for each rotation the offsets of walls and floors, correlated one axis at a time, leave few
//! shifts. This finds what descriptors cannot: rooms seen through a door share little but flat walls, whose
//! descriptors match anywhere.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::gravity::is_upright;
use crate::features::{Offsets, PlaneProfile, Scan};
use crate::geometry::Pose;

/// Shifts kept an axis.
const PEAKS: usize = 10;

/// The most promising motions by how much surface of like orientation they bring to like offsets: at most `keep`, best first, as
/// a from b in the local frames. None where either scan has no plane profile, and none that would tip a scan over.
#[must_use]
pub fn planar_poses(a: &Scan, b: &Scan, keep: usize) -> Vec<Pose> {
    let (Some(in_a), Some(in_b)) = (a.planes(), b.planes()) else { return Vec::new() };
    let shifts = Shifts::between(in_a, in_b);
    let mut combined: Vec<(u32, usize, [i32; 3])> = Vec::new();
    let turns = quarter_turns();
    for (index, turn) in turns.iter().enumerate() {
        if !is_upright(a, b, &Pose::new(rotation(in_a, in_b, turn), Vector3::zeros())) {
            continue;
        }
        let [x, y, z] = std::array::from_fn(|k| shifts.of(k, turn[k]));
        for &(amount_x, at_x) in x {
            for &(amount_y, at_y) in y {
                for &(amount_z, at_z) in z {
                    combined.push((amount_x + amount_y + amount_z, index, [at_x, at_y, at_z]));
                }
            }
        }
    }
    let better = |x: &(u32, usize, [i32; 3]), y: &(u32, usize, [i32; 3])| y.cmp(x);
    if combined.len() > keep {
        combined.select_nth_unstable_by(keep, better);
        combined.truncate(keep);
    }
    combined.sort_unstable_by(better);
    let voxel = a.prepared.resolution;
    combined
        .into_iter()
        .map(|(_, turn, shift)| {
            let shift = Vector3::from(shift.map(f64::from)) * voxel;
            Pose::new(rotation(in_a, in_b, &turns[turn]), in_a.local_from_axes * shift)
        })
        .collect()
}

/// The rotation that lays the axes of b along those of a as a turn says.
fn rotation(in_a: &PlaneProfile, in_b: &PlaneProfile, turn: &[Side; 3]) -> Rotation3<f64> {
    let mut turned = Matrix3::zeros();
    for (k, Side { axis, opposite }) in turn.iter().enumerate() {
        turned[(k, *axis)] = if *opposite { -1.0 } else { 1.0 };
    }
    in_a.local_from_axes * Rotation3::from_matrix_unchecked(turned) * in_b.local_from_axes.inverse()
}

/// An axis of scan b, in its direction or against it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Side {
    axis: usize,
    opposite: bool,
}

/// The 24 rotations that map three orthogonal directions onto each other: for each axis of a, which side of b comes to lie on it.
fn quarter_turns() -> Vec<[Side; 3]> {
    let mut turns = Vec::with_capacity(24);
    for (axes, odd) in [
        ([0, 1, 2], false),
        ([1, 2, 0], false),
        ([2, 0, 1], false),
        ([0, 2, 1], true),
        ([2, 1, 0], true),
        ([1, 0, 2], true),
    ] {
        for signs in 0..8_u32 {
            if (signs.count_ones() % 2 == 1) == odd {
                turns.push(std::array::from_fn(|k| Side { axis: axes[k], opposite: signs >> k & 1 == 1 }));
            }
        }
    }
    turns
}

/// For each axis of a and each side of b the shifts at which most surface meets: (amount, voxels), best first.
struct Shifts([[Vec<(u32, i32)>; 6]; 3]);

impl Shifts {
    fn between(a: &PlaneProfile, b: &PlaneProfile) -> Self {
        let sides: [[Offsets; 2]; 6] = std::array::from_fn(|index| {
            let [along, against] = &b.offsets[index / 2];
            if index % 2 == 0 {
                [along.clone(), against.clone()]
            } else {
                [against.reversed(), along.reversed()]
            }
        });
        Self(std::array::from_fn(|k| std::array::from_fn(|side| peaks(&a.offsets[k], &sides[side]))))
    }

    fn of(&self, axis_of_a: usize, side: Side) -> &[(u32, i32)] {
        &self.0[axis_of_a][2 * side.axis + usize::from(side.opposite)]
    }
}

/// The best local maxima of the correlation of two axes: of the surfaces that face along both, and of those that face against both.
fn peaks(a: &[Offsets; 2], b: &[Offsets; 2]) -> Vec<(u32, i32)> {
    let first = a[0].first - b[0].end();
    let count = (a[0].end() - b[0].first - first).max(0) as usize + 1;
    let amounts: Vec<u32> = (0..count)
        .map(|i| common(&a[0], &b[0], first + i as i32) + common(&a[1], &b[1], first + i as i32))
        .collect();
    let mut peaks: Vec<(u32, i32)> = (0..count)
        .filter(|&i| {
            let before = if i == 0 { 0 } else { amounts[i - 1] };
            let after = amounts.get(i + 1).copied().unwrap_or(0);
            amounts[i] > 0 && before <= amounts[i] && after < amounts[i]
        })
        .map(|i| (amounts[i], first + i as i32))
        .collect();
    peaks.sort_unstable_by(|x, y| y.cmp(x));
    peaks.truncate(PEAKS);
    peaks
}

/// How much surface coincides when that of b is shifted by so many voxels: the sum of the smaller of both amounts.
fn common(a: &Offsets, b: &Offsets, shift: i32) -> u32 {
    let start = b.first + shift - a.first;
    let (in_a, in_b) = (start.max(0) as usize, (-start).max(0) as usize);
    let (Some(a), Some(b)) = (a.amounts.get(in_a..), b.amounts.get(in_b..)) else { return 0 };
    // Short sums of u16 in u32 vectorise.
    a.iter().zip(b).map(|(x, y)| u32::from(*x.min(y))).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_24_different_quarter_turns_and_all_are_rotations() {
        let turns = quarter_turns();
        assert_eq!(turns.len(), 24);
        for (i, turn) in turns.iter().enumerate() {
            assert!(!turns[..i].contains(turn));
            let mut matrix = Matrix3::<f64>::zeros();
            for (k, side) in turn.iter().enumerate() {
                matrix[(k, side.axis)] = if side.opposite { -1.0 } else { 1.0 };
            }
            assert!((matrix.determinant() - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn offsets_coincide_where_they_are_shifted_onto_each_other() {
        let a = Offsets { first: -3, amounts: vec![0, 0, 9, 0, 0, 0, 4] };
        let b = Offsets { first: 10, amounts: vec![7, 0, 0, 0, 4, 0] };
        assert_eq!(common(&a, &b, -11), 11);
        assert_eq!(common(&a, &b, 100), 0);
        assert_eq!(common(&a, &b, -100), 0);
        let best = peaks(
            &[a.clone(), Offsets { first: -3, amounts: vec![0; 7] }],
            &[b, Offsets { first: 10, amounts: vec![0; 6] }],
        );
        assert_eq!(best[0], (11, -11));
    }
}
