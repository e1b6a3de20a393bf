//! The surface terms of one pair of scans: point-to-plane distances, and the relative motions they cannot see.
//!
//! Everything of a pair is summed in the frame of scan i as a function of a left perturbation of `i_from_j`; the
//! derivative by pose i is minus that by pose j carried through the adjoint, so a pair costs one 6x6 matrix, not a 12x12.

use nalgebra::{Cholesky, Matrix3, Matrix6, SMatrix, SymmetricEigen, Vector3, Vector6};

use super::dense_sums::{Correspondence, Sums};
use super::twist::{adjoint, quarters, rotation_vector, skew, twist};
use crate::geometry::{Kernel, Pose};

/// `sum w rho(r^2)` with `r = n . (x_i(point of j) - point of i)`, linearised.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PairTerms {
    pub cost: f64,
    /// `sum w rho' J^T J`, J by a left perturbation of `i_from_j`.
    pub information: Matrix6<f64>,
    /// `-sum w rho' J^T r`.
    pub rhs: Vector6<f64>,
    /// The information the same correspondences would have if they held points on points, not on planes.
    pub point_information: Matrix6<f64>,
}

impl PairTerms {
    /// Of a pair's correspondences at a relative pose.
    pub(super) fn of(correspondences: &[Correspondence], i_from_j: &Pose, kernel: Kernel) -> Self {
        let sums = Sums::of(correspondences, i_from_j, kernel);
        let information = symmetric::<6>(&sums.information);
        let second = symmetric::<3>(&sums.second);
        let turn = Matrix3::identity() * second.trace() - second;
        let first = Vector3::from(sums.first);
        let point_information =
            quarters(&turn, &skew(&first), &-skew(&first), &(Matrix3::identity() * sums.weight));
        Self { cost: sums.cost, information, rhs: -Vector6::from(sums.gradient), point_information }
    }

    /// The same as a function of the left perturbation of pose j in the model frame; that of pose i is its negative.
    pub(super) fn in_model(&self, model_from_i: &Pose) -> Self {
        let carry = adjoint(&model_from_i.inverse());
        let carried = |m: &Matrix6<f64>| carry.transpose() * m * carry;
        Self {
            cost: self.cost,
            information: carried(&self.information),
            rhs: carry.transpose() * self.rhs,
            point_information: carried(&self.point_information),
        }
    }
}

/// A symmetric matrix by its lower triangle, row by row.
fn symmetric<const N: usize>(triangle: &[f64]) -> SMatrix<f64, N, N> {
    SMatrix::from_fn(|i, j| {
        let (row, column) = (i.max(j), i.min(j));
        triangle[row * (row + 1) / 2 + column]
    })
}

/// A share of the point information's diagonal added to it, so that thin sets of points have a factor: far above the
/// rounding of single-precision coordinates, far below any real extent.
const RIDGE: f64 = 1e-9;

/// The motions that planes leave free: those u with `u^T H u <= share * u^T D u`, where H is the point-to-plane and D
/// the point-to-point information of the same correspondences. The ratio is the share of the motion's displacement that
/// runs along normals: about a third in a furnished room, zero for a slide along a lone plane, and it does not depend on
/// how large the overlap is or how far from the origin it lies.
///
/// Each is scaled to `u^T D u = 1`. Motions that not even the points resist, as the turn about a line on which they all
/// lie, count as free. `None` if there are no points, or a value is not finite.
pub(super) fn blind_motions(
    information: &Matrix6<f64>,
    point_information: &Matrix6<f64>,
    share: f64,
) -> Option<Vec<Vector6<f64>>> {
    let ridge = Matrix6::from_diagonal(&(point_information.diagonal() * RIDGE));
    let lower = Cholesky::new(point_information + ridge)?.l();
    let left = lower.solve_lower_triangular(information)?;
    let whitened = lower.solve_lower_triangular(&left.transpose())?;
    let symmetric = (whitened + whitened.transpose()) * 0.5;
    if symmetric.iter().any(|x| !x.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::try_new(symmetric, f64::EPSILON, 1000)?;
    let blind = (0..6).filter(|&k| eigen.eigenvalues[k] <= share);
    blind.map(|k| lower.tr_solve_lower_triangular(&eigen.eigenvectors.column(k))).collect()
}

/// Keeps a relative pose where it was, along the motions that the pair's planes cannot see:
/// `weight * sum_u (u^T D zeta)^2` over blind motions u, zeta the motion from the reference.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hold {
    reference: Pose,
    information: Matrix6<f64>,
    /// How many motions are held.
    pub motions: usize,
}

impl Hold {
    /// For a pair at the relative pose where its terms were taken.
    pub(super) fn of(terms: &PairTerms, i_from_j: &Pose, share: f64, weight: f64) -> Self {
        let d = &terms.point_information;
        let (information, motions) = match blind_motions(&terms.information, d, share) {
            Some(blind) => {
                let seen = blind.iter().map(|u| d * u);
                (seen.map(|du| du * du.transpose()).sum::<Matrix6<f64>>() * weight, blind.len())
            }
            None => (d * weight, 6),
        };
        Self { reference: *i_from_j, information, motions }
    }

    fn motion(&self, i_from_j: &Pose) -> Vector6<f64> {
        let moved = *i_from_j * self.reference.inverse();
        twist(&rotation_vector(&moved), &moved.translation)
    }

    pub(super) fn cost(&self, i_from_j: &Pose) -> f64 {
        let motion = self.motion(i_from_j);
        motion.dot(&(self.information * motion))
    }

    /// Adds this term, linearised for small motions, to those of the pair.
    pub(super) fn add_to(&self, terms: &mut PairTerms, i_from_j: &Pose) {
        let motion = self.motion(i_from_j);
        let pulled = self.information * motion;
        terms.cost += motion.dot(&pulled);
        terms.information += self.information;
        terms.rhs -= pulled;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::optimize::dense_sums::cost as pair_cost;
    use nalgebra::Rotation3;

    /// A grid on each of the given planes through (2, 1, 1), by unit normal.
    fn planes(normals: &[Vector3<f64>]) -> Vec<Correspondence> {
        let mut all = Vec::new();
        for n in normals {
            let u = n.cross(&Vector3::new(0.3, 0.5, 0.8)).normalize();
            let v = n.cross(&u);
            for (a, b) in (0..7).flat_map(|a| (0..7).map(move |b| (f64::from(a) - 3.0, f64::from(b) - 3.0))) {
                let p = (Vector3::new(2.0, 1.0, 1.0) + u * (a * 0.3) + v * (b * 0.3)).cast::<f32>();
                let (point, normal) = (p.into(), n.cast::<f32>().into());
                all.push(Correspondence {
                    point_in_i: point,
                    normal_in_i: normal,
                    point_in_j: point,
                    weight: 1.0,
                });
            }
        }
        all
    }

    #[test]
    fn a_plane_leaves_three_motions_free_an_edge_one_and_a_corner_none() {
        let [x, y, z] = [Vector3::x(), Vector3::y(), Vector3::z()];
        for (normals, free) in [(vec![z], 3), (vec![z, y], 1), (vec![x, y, z], 0)] {
            let terms = PairTerms::of(&planes(&normals), &Pose::identity(), Kernel::Squared);
            let blind = blind_motions(&terms.information, &terms.point_information, 0.01).unwrap();
            assert_eq!(blind.len(), free);
            for u in &blind {
                assert!((u.dot(&(terms.point_information * u)) - 1.0).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn the_right_hand_side_is_the_numerical_gradient() {
        let all = planes(&[Vector3::x(), Vector3::new(0.6, 0.0, 0.8)]);
        let at = Pose::new(Rotation3::new(Vector3::new(0.1, -0.05, 0.02)), Vector3::new(0.05, 0.1, -0.03));
        for kernel in [Kernel::Squared, Kernel::Cauchy(0.1), Kernel::GemanMcClure(0.2)] {
            let terms = PairTerms::of(&all, &at, kernel);
            for axis in 0..6 {
                let moved = |h: f64| {
                    let mut xi = Vector6::zeros();
                    xi[axis] = h;
                    pair_cost(&all, &at.perturbed(&xi), kernel)
                };
                let numeric = -(moved(1e-6) - moved(-1e-6)) / 4e-6;
                assert!((numeric - terms.rhs[axis]).abs() < 1e-5, "{numeric} is not {}", terms.rhs[axis]);
            }
            assert!((terms.cost - pair_cost(&all, &at, kernel)).abs() < 1e-12);
        }
    }

    #[test]
    fn a_hold_resists_slides_only() {
        let terms = PairTerms::of(&planes(&[Vector3::z()]), &Pose::identity(), Kernel::Squared);
        let hold = Hold::of(&terms, &Pose::identity(), 0.01, 1.0);
        assert_eq!(hold.motions, 3);
        let moved = |v: Vector3<f64>| hold.cost(&Pose::from_translation(v));
        // 49 points, each a decimetre away.
        assert!((moved(Vector3::x() * 0.1) - 0.49).abs() < 1e-6);
        assert!(moved(Vector3::z() * 0.1) < 1e-9);
    }

    #[test]
    fn points_on_a_line_leave_the_turn_about_it_free_too() {
        let mut line = planes(&[Vector3::z()]);
        line.truncate(7);
        let terms = PairTerms::of(&line, &Pose::identity(), Kernel::Squared);
        let hold = Hold::of(&terms, &Pose::identity(), 0.01, 0.5);
        assert_eq!(hold.motions, 4);
        let none = PairTerms::of(&[], &Pose::identity(), Kernel::Squared);
        assert_eq!(Hold::of(&none, &Pose::identity(), 0.01, 0.5).cost(&Pose::identity()), 0.0);
    }
}
