//! Sums over the correspondences of one pair of scans, eight side by side, in double precision: these are most of what a joint dense adjustment
//! computes. Used by `dense_pair`, which makes matrices of them, and by `joint_dense`.

use multiversion::multiversion;

use crate::geometry::{Kernel, Point, Pose};

/// A point of scan j and the surface of scan i it lies near.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correspondence {
    /// A point of the surface in the frame of scan i, metres.
    pub point_in_i: Point,
    /// Its unit normal in the frame of scan i.
    pub normal_in_i: Point,
    /// The point in the frame of scan j, metres.
    pub point_in_j: Point,
    /// How much it counts, at least zero.
    pub weight: f32,
}

/// Correspondences that are worked on side by side.
const LANES: usize = 8;

type Lanes = [f64; LANES];

/// Entries of a symmetric 6x6 and of a symmetric 3x3 matrix.
const TRIANGLE: usize = 21;
const SMALL_TRIANGLE: usize = 6;
/// The cost, the gradient, the information, the weight, and the first and second moments of the points.
const SUMS: usize = 1 + 6 + TRIANGLE + 1 + 3 + SMALL_TRIANGLE;

/// What a pair's correspondences sum up to at a relative pose; weights are those of the kernel there. Lower triangles row by row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Sums {
    /// `sum w rho(r^2)`.
    pub cost: f64,
    /// `sum w rho' J^T r`.
    pub gradient: [f64; 6],
    /// `sum w rho' J^T J`.
    pub information: [f64; TRIANGLE],
    /// `sum w rho'`.
    pub weight: f64,
    /// `sum w rho' x`, x the point in the frame of scan i.
    pub first: [f64; 3],
    /// `sum w rho' x x^T`.
    pub second: [f64; SMALL_TRIANGLE],
}

impl Sums {
    /// Over all correspondences.
    pub(super) fn of(correspondences: &[Correspondence], i_from_j: &Pose, kernel: Kernel) -> Self {
        let sums = sums(correspondences, &rows(i_from_j), kernel);
        let mut next = 0;
        Self {
            cost: take::<1>(&sums, &mut next)[0],
            gradient: take(&sums, &mut next),
            information: take(&sums, &mut next),
            weight: take::<1>(&sums, &mut next)[0],
            first: take(&sums, &mut next),
            second: take(&sums, &mut next),
        }
    }
}

/// The next N sums.
fn take<const N: usize>(sums: &[f64; SUMS], next: &mut usize) -> [f64; N] {
    let from = *next;
    *next += N;
    std::array::from_fn(|k| sums[from + k])
}

/// The energy of a pair alone: `sum w rho(r^2)`.
pub(super) fn cost(correspondences: &[Correspondence], i_from_j: &Pose, kernel: Kernel) -> f64 {
    costs(correspondences, &rows(i_from_j), kernel)
}

/// Rotation and translation, row by row.
fn rows(pose: &Pose) -> [[f64; 4]; 3] {
    let rotation = pose.rotation.matrix();
    std::array::from_fn(|i| [rotation[(i, 0)], rotation[(i, 1)], rotation[(i, 2)], pose.translation[i]])
}

/// Correspondences side by side, in the frame of scan i.
struct Block {
    point: [Lanes; 3],
    normal: [Lanes; 3],
    /// Distances of the points from the planes, metres.
    residual: Lanes,
    /// Zero beyond the last correspondence.
    weight: Lanes,
}

impl Block {
    #[expect(clippy::inline_always, reason = "apart from what sums it is compiled for the least processor")]
    #[inline(always)]
    fn of(few: &[Correspondence], i_from_j: &[[f64; 4]; 3]) -> Self {
        let (mut own, mut surface, mut normal) = ([[0.0; LANES]; 3], [[0.0; LANES]; 3], [[0.0; LANES]; 3]);
        let mut weight = [0.0; LANES];
        for (k, c) in few.iter().enumerate().take(LANES) {
            for axis in 0..3 {
                own[axis][k] = f64::from(c.point_in_j[axis]);
                surface[axis][k] = f64::from(c.point_in_i[axis]);
                normal[axis][k] = f64::from(c.normal_in_i[axis]);
            }
            weight[k] = f64::from(c.weight);
        }
        let (mut point, mut residual) = ([[0.0; LANES]; 3], [0.0; LANES]);
        for axis in 0..3 {
            let [x, y, z, shift] = i_from_j[axis];
            for k in 0..LANES {
                point[axis][k] = x * own[0][k] + y * own[1][k] + z * own[2][k] + shift;
                residual[k] += normal[axis][k] * (point[axis][k] - surface[axis][k]);
            }
        }
        Self { point, normal, residual, weight }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn sums(correspondences: &[Correspondence], i_from_j: &[[f64; 4]; 3], kernel: Kernel) -> [f64; SUMS] {
    let mut parts = [[0.0_f64; LANES]; SUMS];
    for few in correspondences.chunks(LANES) {
        let Block { point, normal, residual, weight } = Block::of(few, i_from_j);
        let (mut square, mut jacobian) = ([0.0; LANES], [[0.0; LANES]; 6]);
        for k in 0..LANES {
            square[k] = residual[k] * residual[k];
            jacobian[0][k] = point[1][k] * normal[2][k] - point[2][k] * normal[1][k];
            jacobian[1][k] = point[2][k] * normal[0][k] - point[0][k] * normal[2][k];
            jacobian[2][k] = point[0][k] * normal[1][k] - point[1][k] * normal[0][k];
            for axis in 0..3 {
                jacobian[3 + axis][k] = normal[axis][k];
            }
        }
        let (costs, robust) = kernel.of_each(&square);
        let mut used = [0.0; LANES];
        for k in 0..LANES {
            used[k] = weight[k] * robust[k];
            parts[0][k] += weight[k] * costs[k];
        }
        let mut at = 1;
        let weighted: [Lanes; 6] = std::array::from_fn(|i| std::array::from_fn(|k| used[k] * jacobian[i][k]));
        for i in 0..6 {
            for k in 0..LANES {
                parts[at][k] += weighted[i][k] * residual[k];
            }
            at += 1;
        }
        for i in 0..6 {
            for j in 0..=i {
                for k in 0..LANES {
                    parts[at][k] += weighted[i][k] * jacobian[j][k];
                }
                at += 1;
            }
        }
        for k in 0..LANES {
            parts[at][k] += used[k];
        }
        at += 1;
        let carried: [Lanes; 3] = std::array::from_fn(|i| std::array::from_fn(|k| used[k] * point[i][k]));
        for i in 0..3 {
            for k in 0..LANES {
                parts[at][k] += carried[i][k];
            }
            at += 1;
        }
        for i in 0..3 {
            for j in 0..=i {
                for k in 0..LANES {
                    parts[at][k] += carried[i][k] * point[j][k];
                }
                at += 1;
            }
        }
    }
    parts.map(|lanes| lanes.iter().sum())
}

#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn costs(correspondences: &[Correspondence], i_from_j: &[[f64; 4]; 3], kernel: Kernel) -> f64 {
    let mut parts = [0.0; LANES];
    for few in correspondences.chunks(LANES) {
        let Block { residual, weight, .. } = Block::of(few, i_from_j);
        let (costs, _) = kernel.of_each(&residual.map(|r| r * r));
        for k in 0..LANES {
            parts[k] += weight[k] * costs[k];
        }
    }
    parts.iter().sum()
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Matrix6, Rotation3, Vector3, Vector6};

    use super::*;

    #[test]
    fn sums_are_those_of_one_correspondence_after_the_other() {
        let pose = Pose::new(Rotation3::new(Vector3::new(0.3, -0.2, 0.5)), Vector3::new(1.0, -2.0, 0.5));
        let correspondences: Vec<Correspondence> = (0..21_u8)
            .map(|k| {
                let t = f32::from(k);
                let normal = Vector3::new(t.sin(), t.cos(), 0.5).normalize();
                Correspondence {
                    point_in_i: [0.1 * t, 1.0 - 0.2 * t, t.cos()],
                    normal_in_i: normal.into(),
                    point_in_j: [0.1 * t - 1.0, 2.0 - 0.15 * t, t.sin()],
                    weight: 0.5 + 0.1 * t,
                }
            })
            .collect();
        for (count, kernel) in [
            (0, Kernel::Squared),
            (7, Kernel::Huber(0.3)),
            (8, Kernel::Cauchy(0.5)),
            (21, Kernel::GemanMcClure(0.7)),
        ] {
            let few = &correspondences[..count];
            let (mut energy, mut gradient, mut information) = (0.0, Vector6::zeros(), Matrix6::zeros());
            let (mut total, mut first, mut second) = (0.0, Vector3::zeros(), Matrix3::zeros());
            for c in few {
                let point = pose.transform(&Vector3::from(c.point_in_j).cast());
                let normal = Vector3::from(c.normal_in_i).cast::<f64>();
                let residual = normal.dot(&(point - Vector3::from(c.point_in_i).cast()));
                let weight = f64::from(c.weight) * kernel.weight(residual.powi(2));
                let turn = point.cross(&normal);
                let jacobian = Vector6::new(turn.x, turn.y, turn.z, normal.x, normal.y, normal.z);
                energy += f64::from(c.weight) * kernel.rho(residual.powi(2));
                gradient += jacobian * weight * residual;
                information += jacobian * weight * jacobian.transpose();
                total += weight;
                first += point * weight;
                second += point * weight * point.transpose();
            }
            let sums = Sums::of(few, &pose, kernel);
            let same = |x: f64, y: f64| assert!((x - y).abs() < 1e-10 * (1.0 + y.abs()), "{x} is not {y}");
            same(sums.cost, energy);
            same(cost(few, &pose, kernel), energy);
            same(sums.weight, total);
            let mut at = 0;
            for i in 0..6 {
                same(sums.gradient[i], gradient[i]);
                for j in 0..=i {
                    same(sums.information[at], information[(i, j)]);
                    at += 1;
                }
            }
            at = 0;
            for i in 0..3 {
                same(sums.first[i], first[i]);
                for j in 0..=i {
                    same(sums.second[at], second[(i, j)]);
                    at += 1;
                }
            }
        }
    }
}
