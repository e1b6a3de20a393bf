//! Derivatives of rigid motions with respect to left perturbations `[rotation (rad); translation (m)]`.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use crate::geometry::Pose;

/// `[v]x`, the matrix with `[v]x u = v x u`.
pub(super) fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    v.cross_matrix()
}

/// A 6x6 matrix of its rotation (first) and translation (last) quarters.
pub(super) fn quarters(
    rotation: &Matrix3<f64>,
    upper: &Matrix3<f64>,
    lower: &Matrix3<f64>,
    translation: &Matrix3<f64>,
) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(upper);
    m.fixed_view_mut::<3, 3>(3, 0).copy_from(lower);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(translation);
    m
}

/// A twist of its rotation and its translation.
pub(super) fn twist(rotation: &Vector3<f64>, translation: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(rotation.x, rotation.y, rotation.z, translation.x, translation.y, translation.z)
}

/// `Ad(T)`: to first order, `T exp(xi) T^-1 = exp(Ad(T) xi)`.
pub(super) fn adjoint(pose: &Pose) -> Matrix6<f64> {
    let r = pose.rotation.matrix();
    quarters(r, &Matrix3::zeros(), &(skew(&pose.translation) * r), r)
}

/// The rotation vector of a motion's rotation, of length at most pi.
///
/// By the quaternion, which keeps its digits near 0 and near pi.
pub(super) fn rotation_vector(pose: &Pose) -> Vector3<f64> {
    let q = pose.quaternion();
    let imaginary = q.imag();
    let sine = imaginary.norm();
    // Below the square root of the least positive number, sine and angle cannot be told apart.
    let factor = if sine > 1e-150 { 2.0 * sine.atan2(q.w) / sine } else { 2.0 };
    imaginary * factor
}

/// `dw' / du` at u = 0 for `exp([w']x) = exp([u]x) exp([w]x)`: the inverse left Jacobian of SO(3).
pub(super) fn inverse_left_jacobian(w: &Vector3<f64>) -> Matrix3<f64> {
    let angle = w.norm();
    let factor = if angle < 1e-3 {
        1.0 / 12.0 + angle * angle / 720.0
    } else {
        1.0 / (angle * angle) - 0.5 / (angle * (0.5 * angle).tan())
    };
    let cross = skew(w);
    Matrix3::identity() - cross * 0.5 + cross * cross * factor
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use std::f64::consts::PI;

    const AXIS: Vector3<f64> = Vector3::new(0.48, -0.6, 0.64);

    fn turned(angle: f64) -> Pose {
        Pose::new(Rotation3::new(AXIS * angle), Vector3::new(3.0, -1.0, 2.0))
    }

    #[test]
    fn the_rotation_vector_inverts_the_exponential_near_zero_and_near_pi() {
        for angle in [0.0, 1e-12, 1e-5, 0.3, 2.0, PI - 1e-6, PI - 1e-10] {
            let w = rotation_vector(&turned(angle));
            assert!((w - AXIS * angle).norm() < 1e-9, "{angle} came back as {w:?}");
        }
    }

    #[test]
    fn the_inverse_left_jacobian_is_the_numerical_derivative() {
        for angle in [0.0, 1e-6, 0.999e-3, 1.001e-3, 0.4, 2.0, PI - 1e-3] {
            let jacobian = inverse_left_jacobian(&(AXIS * angle));
            for axis in 0..3 {
                let moved = |h: f64| {
                    let mut xi = Vector6::zeros();
                    xi[axis] = h;
                    rotation_vector(&turned(angle).perturbed(&xi))
                };
                let numeric = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                assert!((numeric - jacobian.column(axis)).norm() < 1e-6, "at {angle} rad");
            }
        }
    }

    #[test]
    fn the_adjoint_carries_a_perturbation_through_a_motion() {
        let (pose, xi) = (turned(1.1), Vector6::new(1.0, -2.0, 0.5, 0.3, 2.0, -1.0) * 1e-6);
        let left = pose * Pose::from_twist(&xi) * pose.inverse();
        let right = Pose::from_twist(&(adjoint(&pose) * xi));
        assert!((left.to_matrix() - right.to_matrix()).amax() < 1e-10);
    }
}
