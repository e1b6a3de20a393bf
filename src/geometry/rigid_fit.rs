//! The rigid motion that fits weighted point pairs best, in closed form.
//!
//! Uses nalgebra only. Used wherever correspondences become a pose: consensus over matches, the pooled fit of a
//! scan against landmarks, aggregation of tracks, alignment of an estimate to the truth.

use nalgebra::{Matrix3, Matrix4, Quaternion, SymmetricEigen, UnitQuaternion, Vector3};

use super::Pose;

/// The least share that the second principal spread must have of the first (as variances, metres squared), below
/// which the points lie on a line and the rotation about that line is unknown: 0.03 mm across for 1 m along.
const LEAST_SPREAD_RATIO: f64 = 1e-9;

/// The least extent relative to the distance from the origin at which differences of coordinates still carry digits.
const LEAST_RELATIVE_EXTENT: f64 = 1e-12;

/// Steps of the eigenvalue iteration, far above what a 4x4 matrix needs.
const EIGEN_STEPS: usize = 1000;

/// The motion `b_from_a` that minimises `sum_k w_k |R a_k + t - b_k|^2` over `(a_k, b_k, w_k)`: points of frame a,
/// their partners in frame b (metres), and weights of at least zero.
///
/// Horn's closed form (1987): the rotation is the quaternion of the largest eigenvalue of a symmetric 4x4 matrix
/// built from the cross-covariance. It gives a proper rotation even where the best orthogonal matrix mirrors, and
/// keeps its precision for thin, nearly planar and far-away point sets; sums run relative to the first pair, so
/// points a thousand kilometres from the origin cost no digits beyond those of their coordinates.
///
/// Returns `None` where the rotation is not determined: fewer than three distinct points, all on one line, a mirrored
/// set whose best rotation is not unique, no positive weight, or a value that is not finite or a weight below zero.
///
/// ```
/// use cairn::geometry::{Pose, rigid_fit};
/// use nalgebra::{Rotation3, Vector3};
///
/// let b_from_a = Pose::new(Rotation3::new(Vector3::new(0.1, -0.7, 0.4)), Vector3::new(1.0, 2.0, 3.0));
/// let points = [Vector3::x(), Vector3::y(), Vector3::zeros()];
/// let fit = rigid_fit(points.iter().map(|p| (*p, b_from_a.transform(p), 1.0))).unwrap();
/// assert!(fit.difference(&b_from_a).1 < 1e-12);
/// ```
#[must_use]
pub fn rigid_fit(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>, f64)>) -> Option<Pose> {
    let moments = Moments::of(pairs)?;
    let (mean_a, mean_b, cross) = moments.centred()?;
    let rotation = best_rotation(&cross)?;
    let r = rotation.to_rotation_matrix();
    let pose = Pose::new(r, mean_b - r * mean_a);
    pose.is_finite().then_some(pose)
}

/// First and mixed second moments of the pairs, relative to the first pair.
struct Moments {
    origin_a: Vector3<f64>,
    origin_b: Vector3<f64>,
    weight: f64,
    sum_a: Vector3<f64>,
    sum_b: Vector3<f64>,
    /// `sum w a b^T`.
    cross: Matrix3<f64>,
}

impl Moments {
    fn of(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>, f64)>) -> Option<Self> {
        let mut pairs = pairs.filter(|(_, _, w)| *w != 0.0).peekable();
        let (origin_a, origin_b, _) = *pairs.peek()?;
        let mut m = Self {
            origin_a,
            origin_b,
            weight: 0.0,
            sum_a: Vector3::zeros(),
            sum_b: Vector3::zeros(),
            cross: Matrix3::zeros(),
        };
        for (a, b, w) in pairs {
            if w < 0.0 {
                return None;
            }
            let (a, b) = (a - origin_a, b - origin_b);
            m.weight += w;
            m.sum_a += a * w;
            m.sum_b += b * w;
            m.cross += (a * w) * b.transpose();
        }
        Some(m)
    }

    /// The weighted means (metres) and the cross-covariance `mean (a - mean_a)(b - mean_b)^T` (metres squared).
    fn centred(&self) -> Option<(Vector3<f64>, Vector3<f64>, Matrix3<f64>)> {
        let (offset_a, offset_b) = (self.sum_a / self.weight, self.sum_b / self.weight);
        let cross = self.cross / self.weight - offset_a * offset_b.transpose();
        let least_extent = LEAST_RELATIVE_EXTENT * self.origin_a.amax().max(self.origin_b.amax());
        let extent_squared = cross.norm();
        // Also false for anything that is not a number.
        let spans = extent_squared > least_extent * least_extent && extent_squared.is_finite();
        spans.then(|| (self.origin_a + offset_a, self.origin_b + offset_b, cross))
    }
}

/// Horn's quaternion for a cross-covariance `S = mean a b^T`, or `None` when it is not unique.
///
/// With the singular values s1 >= s2 >= s3 of S and d the sign of its determinant, the two largest eigenvalues are
/// `s1 + s2 + d s3` and `s1 - s2 - d s3`: half their gap tells how well the worst rotation axis is held.
fn best_rotation(s: &Matrix3<f64>) -> Option<UnitQuaternion<f64>> {
    let trace = s.trace();
    let d = Vector3::new(s.m23 - s.m32, s.m31 - s.m13, s.m12 - s.m21);
    let mut n = Matrix4::zeros();
    n[(0, 0)] = trace;
    n.fixed_view_mut::<3, 1>(1, 0).copy_from(&d);
    n.fixed_view_mut::<1, 3>(0, 1).copy_from(&d.transpose());
    n.fixed_view_mut::<3, 3>(1, 1).copy_from(&(s + s.transpose() - Matrix3::identity() * trace));
    // Scaled, so that the iteration's tolerance is relative.
    let eigen = SymmetricEigen::try_new(n / s.norm(), f64::EPSILON, EIGEN_STEPS)?;
    let mut order = [0, 1, 2, 3];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    let [largest, second, ..] = order.map(|i| eigen.eigenvalues[i]);
    if (largest - second) <= 2.0 * LEAST_SPREAD_RATIO * largest {
        return None;
    }
    let q = eigen.eigenvectors.column(order[0]);
    Some(UnitQuaternion::from_quaternion(Quaternion::new(q[0], q[1], q[2], q[3])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::assert::assert_pose_near;
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    fn vectors(half_width: f64) -> impl Strategy<Value = Vector3<f64>> {
        prop::array::uniform3(-half_width..half_width).prop_map(Vector3::from)
    }

    fn tetrahedron(scale: f64) -> [Vector3<f64>; 4] {
        [Vector3::zeros(), Vector3::x() * scale, Vector3::y() * scale, Vector3::z() * scale]
    }

    proptest! {
        #[test]
        fn exact_pairs_give_back_their_motion(
            w in vectors(4.0), t in vectors(50.0), extra in prop::collection::vec((vectors(3.0), 0.1..5.0f64), 0..20)
        ) {
            let truth = Pose::new(Rotation3::new(w), t);
            let pairs = tetrahedron(1.0).map(|p| (p, 1.0)).into_iter().chain(extra);
            let fit = rigid_fit(pairs.map(|(p, w)| (p, truth.transform(&p), w))).unwrap();
            assert_pose_near(&fit, &truth, 1e-10, 1e-10);
        }

        #[test]
        fn no_nearby_motion_fits_noisy_pairs_better(
            noise in prop::collection::vec(vectors(0.2), 8), xi in prop::array::uniform6(-0.01..0.01f64)
        ) {
            let corners = (0..8).map(|k| Vector3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2)));
            let pairs: Vec<_> =
                corners.zip(&noise).enumerate().map(|(k, (a, n))| (a, a + n, 1.0 + k as f64)).collect();
            let error = |pose: &Pose| -> f64 {
                pairs.iter().map(|(a, b, w)| w * (pose.transform(a) - b).norm_squared()).sum()
            };
            let fit = rigid_fit(pairs.iter().copied()).unwrap();
            prop_assert!(error(&fit) <= error(&fit.perturbed(&xi.into())) + 1e-12);
        }
    }

    #[test]
    fn rotations_near_zero_and_near_pi_are_exact() {
        for angle in [0.0, 1e-9, 1e-4, std::f64::consts::PI - 1e-9, std::f64::consts::PI] {
            let truth =
                Pose::new(Rotation3::new(Vector3::new(0.6, 0.0, 0.8) * angle), Vector3::new(1.0, 0.0, 0.0));
            let fit = rigid_fit(tetrahedron(1.0).iter().map(|p| (*p, truth.transform(p), 1.0))).unwrap();
            assert_pose_near(&fit, &truth, 1e-12, 1e-12);
        }
    }

    #[test]
    fn points_far_from_the_origin_keep_their_digits() {
        let far = Vector3::new(4.0e6, -5.0e6, 6.0e6);
        let truth = Rotation3::new(Vector3::new(0.2, 0.3, -0.1));
        let fit = rigid_fit(tetrahedron(1.0).iter().map(|p| (p + far, truth * p + far, 1.0))).unwrap();
        for p in tetrahedron(1.0) {
            assert!((fit.transform(&(p + far)) - (truth * p + far)).norm() < 1e-8);
        }
    }

    #[test]
    fn flat_and_thin_sets_are_fitted_by_a_proper_rotation() {
        let truth = Pose::new(Rotation3::new(Vector3::new(2.0, -1.0, 0.3)), Vector3::new(0.0, 4.0, 0.0));
        let thin = [Vector3::zeros(), Vector3::x() * 10.0, Vector3::new(5.0, 0.01, 0.0)];
        let fit = rigid_fit(thin.iter().map(|p| (*p, truth.transform(p), 1.0))).unwrap();
        assert_pose_near(&fit, &truth, 1e-8, 1e-8);
    }

    #[test]
    fn a_mirrored_set_gives_a_rotation_and_no_mirror() {
        let mirrored = |p: &Vector3<f64>| Vector3::new(p.x, p.y, -p.z);
        let points = [Vector3::x() * 3.0, Vector3::y() * 2.0, Vector3::z() * 0.5, Vector3::zeros()];
        let fit = rigid_fit(points.iter().map(|p| (*p, mirrored(p), 1.0))).unwrap();
        assert!((fit.rotation.matrix().determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn weights_of_zero_ignore_a_pair() {
        let truth = Pose::from_translation(Vector3::new(1.0, 2.0, 3.0));
        let good = tetrahedron(1.0).map(|p| (p, truth.transform(&p), 1.0));
        let bad = (Vector3::new(9.0, 9.0, 9.0), Vector3::zeros(), 0.0);
        let fit = rigid_fit(std::iter::once(bad).chain(good)).unwrap();
        assert_pose_near(&fit, &truth, 1e-12, 1e-12);
    }

    #[test]
    fn what_determines_no_rotation_is_none() {
        let same = |p: Vector3<f64>| (p, p, 1.0);
        let line = (0..9).map(|k| Vector3::new(1.0, 0.7, 0.1) * (f64::from(k) * 0.3));
        assert_eq!(rigid_fit(std::iter::empty()), None);
        assert_eq!(rigid_fit(std::iter::repeat_n(Vector3::new(0.1, 0.2, 0.3), 5).map(same)), None);
        assert_eq!(rigid_fit([Vector3::x(), Vector3::y()].into_iter().map(same)), None);
        assert_eq!(rigid_fit(line.map(same)), None);
        assert_eq!(rigid_fit(tetrahedron(1.0).into_iter().map(|p| (p, p, 0.0))), None);
        assert_eq!(rigid_fit(tetrahedron(1.0).into_iter().map(|p| (p, p, -1.0))), None);
        assert_eq!(rigid_fit(tetrahedron(1.0).into_iter().map(|p| (p, p * f64::NAN, 1.0))), None);
        assert_eq!(rigid_fit(tetrahedron(1.0).into_iter().map(|p| (p, p, f64::INFINITY))), None);
    }
}
