//! SE(3): a rigid motion between two named frames.

use std::ops::Mul;

use nalgebra::{Matrix3, Matrix4, Rotation3, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// A rigid motion `x_b = R x_a + t`, named `b_from_a` wherever it is stored.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// The orthonormal matrix R, determinant +1.
    pub rotation: Rotation3<f64>,
    /// t, metres.
    pub translation: Vector3<f64>,
}

/// Why a matrix is no rigid motion.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseError {
    /// An entry is infinite or not a number.
    #[error("the matrix has an entry that is not finite")]
    NotFinite,
    /// R^T R differs from the identity.
    #[error(
        "the rotation part is not orthonormal: R^T R differs from the identity by {0:.3e}, at most {1:.0e} is allowed"
    )]
    NotOrthonormal(f64, f64),
    /// A mirror image.
    #[error("the rotation part mirrors: its determinant is {0:.3}")]
    Mirrors(f64),
    /// The last row is not 0 0 0 1.
    #[error("the last row is not 0 0 0 1")]
    NotAffine,
}

/// How far R^T R may be from the identity in text that people wrote (five digits are common).
const ORTHONORMAL_TOLERANCE: f64 = 1e-3;

impl Pose {
    /// The motion that moves nothing.
    #[must_use]
    pub fn identity() -> Self {
        Self { rotation: Rotation3::identity(), translation: Vector3::zeros() }
    }

    /// From a rotation and a translation in metres.
    #[must_use]
    pub fn new(rotation: Rotation3<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// A pure translation, metres.
    #[must_use]
    pub fn from_translation(translation: Vector3<f64>) -> Self {
        Self { rotation: Rotation3::identity(), translation }
    }

    /// From a unit quaternion (w last in TUM order is the caller's business) and a translation in metres.
    #[must_use]
    pub fn from_quaternion(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation: rotation.to_rotation_matrix(), translation }
    }

    /// From a 4x4 row-major matrix. Small departures from orthonormality are repaired by the nearest rotation.
    pub fn from_rows(rows: &[[f64; 4]; 4]) -> Result<Self, PoseError> {
        if rows.iter().flatten().any(|x| !x.is_finite()) {
            return Err(PoseError::NotFinite);
        }
        if rows[3].iter().zip([0.0, 0.0, 0.0, 1.0]).any(|(x, y)| (x - y).abs() > 1e-6) {
            return Err(PoseError::NotAffine);
        }
        let r = Matrix3::from_fn(|i, j| rows[i][j]);
        let off = (r.transpose() * r - Matrix3::identity()).amax();
        if off > ORTHONORMAL_TOLERANCE {
            return Err(PoseError::NotOrthonormal(off, ORTHONORMAL_TOLERANCE));
        }
        if r.determinant() < 0.0 {
            return Err(PoseError::Mirrors(r.determinant()));
        }
        let svd = r.svd(true, true);
        let nearest = match (svd.u, svd.v_t) {
            (Some(u), Some(v_t)) => u * v_t,
            _ => r,
        };
        let translation = Vector3::new(rows[0][3], rows[1][3], rows[2][3]);
        Ok(Self { rotation: Rotation3::from_matrix_unchecked(nearest), translation })
    }

    /// As a 4x4 row-major matrix.
    #[must_use]
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let m = self.to_matrix();
        std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)]))
    }

    /// As a homogeneous matrix.
    #[must_use]
    pub fn to_matrix(&self) -> Matrix4<f64> {
        let mut m = self.rotation.to_homogeneous();
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        m
    }

    /// The rotation as a unit quaternion with w >= 0.
    #[must_use]
    pub fn quaternion(&self) -> UnitQuaternion<f64> {
        // The conversion keeps the matrix's rounding errors as a length that is not one, and would let them grow.
        let q =
            UnitQuaternion::new_normalize(UnitQuaternion::from_rotation_matrix(&self.rotation).into_inner());
        if q.w < 0.0 { UnitQuaternion::new_unchecked(-q.into_inner()) } else { q }
    }

    /// `a_from_b` of `b_from_a`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Maps a point of frame a into frame b.
    #[must_use]
    pub fn transform(&self, point_in_a: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_in_a + self.translation
    }

    /// Maps a single-precision point of frame a into frame b, computed in double precision.
    #[must_use]
    pub fn transform_point(&self, point_in_a: [f32; 3]) -> [f32; 3] {
        let p = self.transform(&Vector3::from(point_in_a).cast());
        [p.x as f32, p.y as f32, p.z as f32]
    }

    /// exp of a twist `[rotation vector (rad); translation (m)]`, with the rotation and the translation taken
    /// separately (the retraction of SO(3) x R3, not the screw motion): `R = exp([w]x)`, `t = v`.
    #[must_use]
    pub fn from_twist(xi: &Vector6<f64>) -> Self {
        let w = Vector3::new(xi[0], xi[1], xi[2]);
        Self { rotation: Rotation3::new(w), translation: Vector3::new(xi[3], xi[4], xi[5]) }
    }

    /// This pose moved by a left perturbation: `R <- exp([w]x) R`, `t <- exp([w]x) t + v`.
    #[must_use]
    pub fn perturbed(&self, xi: &Vector6<f64>) -> Self {
        Self::from_twist(xi) * *self
    }

    /// The angle of the rotation, radians, in [0, pi].
    #[must_use]
    pub fn angle(&self) -> f64 {
        // atan2 keeps its precision near 0 and near pi, where acos of the trace loses half its digits.
        let q = self.quaternion();
        2.0 * q.imag().norm().atan2(q.w)
    }

    /// The angle (rad) and distance (m) that separate two motions between the same frames.
    #[must_use]
    pub fn difference(&self, other: &Self) -> (f64, f64) {
        let delta = self.inverse() * *other;
        (delta.angle(), (self.translation - other.translation).norm())
    }

    /// Whether every entry is a finite number.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.rotation.matrix().iter().chain(self.translation.iter()).all(|x| x.is_finite())
    }

    /// The nearest exact rotation, after many products have let rounding errors pile up.
    #[must_use]
    pub fn renormalised(&self) -> Self {
        Self { rotation: self.quaternion().to_rotation_matrix(), translation: self.translation }
    }
}

impl Mul for Pose {
    type Output = Self;

    /// `c_from_b * b_from_a = c_from_a`.
    fn mul(self, b_from_a: Self) -> Self {
        Self {
            rotation: self.rotation * b_from_a.rotation,
            translation: self.rotation * b_from_a.translation + self.translation,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn poses() -> impl Strategy<Value = Pose> {
        (prop::array::uniform3(-4.0..4.0f64), prop::array::uniform3(-50.0..50.0f64))
            .prop_map(|(w, t)| Pose::new(Rotation3::new(Vector3::from(w)), Vector3::from(t)))
    }

    proptest! {
        #[test]
        fn a_pose_times_its_inverse_moves_nothing(a in poses()) {
            let (angle, distance) = (a * a.inverse()).difference(&Pose::identity());
            prop_assert!(angle < 1e-12 && distance < 1e-12);
        }

        #[test]
        fn products_act_right_to_left(a in poses(), b in poses(), p in prop::array::uniform3(-9.0..9.0f64)) {
            let p = Vector3::from(p);
            prop_assert!(((a * b).transform(&p) - a.transform(&b.transform(&p))).norm() < 1e-10);
        }

        #[test]
        fn rows_round_trip(a in poses()) {
            let back = Pose::from_rows(&a.to_rows()).unwrap();
            let (angle, distance) = back.difference(&a);
            prop_assert!(angle < 1e-9 && distance < 1e-12);
        }
    }

    #[test]
    fn the_angle_is_exact_near_zero_and_near_pi() {
        for angle in [1e-9, 1e-6, 1.0, std::f64::consts::PI - 1e-9] {
            let pose = Pose::new(Rotation3::new(Vector3::new(0.0, angle, 0.0)), Vector3::zeros());
            assert!((pose.angle() - angle).abs() < 1e-12, "{angle} came back as {}", pose.angle());
        }
    }

    #[test]
    fn renormalising_again_and_again_stays_a_rotation() {
        let step = Pose::new(Rotation3::new(Vector3::new(0.7, -0.2, 1.1)), Vector3::new(1.0, 0.0, 0.0));
        let mut pose = step;
        for _ in 0..10_000 {
            pose = (step * pose.inverse() * step).renormalised();
        }
        let r = pose.rotation.matrix();
        assert!((r.transpose() * r - Matrix3::identity()).amax() < 1e-14);
    }

    #[test]
    fn mirrors_and_scales_are_refused() {
        let mut rows = Pose::identity().to_rows();
        rows[0][0] = -1.0;
        assert_eq!(Pose::from_rows(&rows), Err(PoseError::Mirrors(-1.0)));
        rows[0][0] = 1.1;
        assert!(matches!(Pose::from_rows(&rows), Err(PoseError::NotOrthonormal(..))));
        rows[0][0] = f64::NAN;
        assert_eq!(Pose::from_rows(&rows), Err(PoseError::NotFinite));
    }
}
