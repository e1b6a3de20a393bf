//! How well a pose is known, in words of metres: the principal motions of its covariance.

use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};

use super::twist::{quarters, skew};

/// A direction in which a pose may move, and by how much it is uncertain there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PrincipalMotion {
    /// The standard deviation of points of the scan along this motion, metres.
    pub sigma: f64,
    /// The turn about the scan's centre, radians a metre of sigma.
    pub rotation: Vector3<f64>,
    /// The shift of the scan's centre, metres a metre of sigma.
    pub translation: Vector3<f64>,
}

/// The six principal motions of a pose, the most uncertain first.
///
/// `covariance` is that of the left perturbation of `model_from_scan` (rad, m). Rotations are taken about
/// `centre_in_model` (metres) and made metres by `lever_arm`, the RMS distance of the scan's points from there.
/// `None` where the covariance or the lever arm is not finite.
#[must_use]
pub fn principal_motions(
    covariance: &Matrix6<f64>,
    centre_in_model: &Vector3<f64>,
    lever_arm: f64,
) -> Option<[PrincipalMotion; 6]> {
    let turn = Matrix3::identity() * lever_arm;
    let at_centre = quarters(&turn, &Matrix3::zeros(), &-skew(centre_in_model), &Matrix3::identity());
    let in_metres = at_centre * covariance * at_centre.transpose();
    if in_metres.iter().any(|x| !x.is_finite()) || lever_arm <= 0.0 {
        return None;
    }
    let eigen = SymmetricEigen::try_new(in_metres, f64::EPSILON, 1000)?;
    let mut order = [0, 1, 2, 3, 4, 5];
    order.sort_by(|&i, &j| eigen.eigenvalues[j].total_cmp(&eigen.eigenvalues[i]));
    Some(order.map(|k| {
        let direction: Vector6<f64> = eigen.eigenvectors.column(k).into();
        PrincipalMotion {
            sigma: eigen.eigenvalues[k].max(0.0).sqrt(),
            rotation: direction.fixed_rows::<3>(0) / lever_arm,
            translation: direction.fixed_rows::<3>(3).into(),
        }
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slide_of_a_far_away_scan_is_the_most_uncertain_motion() {
        // A scan at 100 m that may slide along x by 20 mm and is known to 1 mm otherwise.
        let centre = Vector3::new(0.0, 100.0, 0.0);
        let mut about_centre = Matrix6::identity() * 1e-6;
        about_centre[(3, 3)] = 4e-4;
        let to_origin =
            quarters(&Matrix3::identity(), &Matrix3::zeros(), &skew(&centre), &Matrix3::identity());
        let covariance = to_origin * about_centre * to_origin.transpose();
        let motions = principal_motions(&covariance, &centre, 1.0).unwrap();
        assert!((motions[0].sigma - 0.02).abs() < 1e-9);
        assert!((motions[0].translation.x.abs() - 1.0).abs() < 1e-6);
        assert!(motions[1..].iter().all(|motion| (motion.sigma - 1e-3).abs() < 1e-9));
        assert_eq!(principal_motions(&(covariance * f64::NAN), &centre, 1.0), None);
    }
}
