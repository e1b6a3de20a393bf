//! How points spread around their mean: the principal components of a neighbourhood.

use nalgebra::{Matrix3, Vector3};

use super::Moments;

/// Variances along the principal axes, and the axis of the least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Ascending, square metres. Rounding may take the least slightly below zero.
    pub values: [f64; 3],
    /// The direction of the least variance, a unit vector of arbitrary sign. Where the two smaller are alike it is any direction between theirs.
    pub least: Vector3<f64>,
}

impl Spread {
    /// Of at least one point, in closed form: eigenvalues of a symmetric matrix by the angle that its determinant gives, and the
    /// vector across the two rows of its remainder that span most (D. Eberly, "A Robust Eigensolver for 3 x 3 Symmetric Matrices", 2014).
    #[must_use]
    pub fn of(near: &Moments) -> Self {
        let n = near.count as f64;
        let entry =
            |at: usize, i: usize, j: usize| near.products[at] / n - near.sum[i] / n * (near.sum[j] / n);
        let (xy, xz, yz) = (entry(1, 0, 1), entry(2, 0, 2), entry(4, 1, 2));
        #[rustfmt::skip]
        let covariance = Matrix3::new(
            entry(0, 0, 0), xy, xz,
            xy, entry(3, 1, 1), yz,
            xz, yz, entry(5, 2, 2),
        );
        Self::of_covariance(&covariance)
    }

    fn of_covariance(covariance: &Matrix3<f64>) -> Self {
        let mean = covariance.trace() / 3.0;
        let centred = covariance - Matrix3::identity() * mean;
        let scale = (centred.norm_squared() / 6.0).sqrt();
        if scale <= f64::EPSILON * mean.abs() {
            return Self { values: [mean; 3], least: Vector3::z() };
        }
        let half = ((centred / scale).determinant() / 2.0).clamp(-1.0, 1.0);
        let angle = half.acos() / 3.0;
        let largest = mean + 2.0 * scale * angle.cos();
        let smallest = mean + 2.0 * scale * (angle + std::f64::consts::TAU / 3.0).cos();
        let rest = covariance - Matrix3::identity() * smallest;
        let (x, y, z) = (rest.column(0), rest.column(1), rest.column(2));
        let across = [x.cross(&y), y.cross(&z), z.cross(&x)];
        let longest = across.iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()));
        let least = longest.and_then(|a| a.try_normalize(0.0)).unwrap_or_else(Vector3::z);
        Self { values: [smallest, 3.0 * mean - smallest - largest, largest], least }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn it_is_the_eigenvector_of_the_least_eigenvalue(
            values in prop::array::uniform3(0.0..1.0_f64),
            flat in prop::bool::ANY,
            axis in prop::array::uniform3(-3.0..3.0_f64),
            size in -12..3_i32,
        ) {
            let size = 10.0_f64.powi(size);
            let mut values = values.map(|v| v * size);
            if flat {
                values[2] = 0.0;
            }
            let rotation = nalgebra::Rotation3::new(Vector3::from(axis));
            let matrix = rotation.matrix() * Matrix3::from_diagonal(&Vector3::from(values)) * rotation.matrix().transpose();
            let found = Spread::of_covariance(&matrix);
            values.sort_by(f64::total_cmp);
            for (found, expected) in found.values.iter().zip(values) {
                prop_assert!((found - expected).abs() <= 1e-7 * values[2], "{found} of {expected}");
            }
            prop_assert!((found.least.norm() - 1.0).abs() < 1e-9);
            let gap = values[1] - values[0];
            if gap > 1e-3 * values[2] {
                let off = (matrix * found.least - found.least * values[0]).norm();
                prop_assert!(off <= 1e-4 * gap, "{off} of {gap}");
            }
        }
    }

    #[test]
    fn what_spreads_alike_has_some_direction() {
        for matrix in [Matrix3::zeros(), Matrix3::identity() * 4.0] {
            let found = Spread::of_covariance(&matrix);
            assert!((found.least.norm() - 1.0).abs() < 1e-9);
            assert_eq!(found.values, [matrix[(0, 0)]; 3]);
        }
        let line = Spread::of_covariance(&Matrix3::from_diagonal(&Vector3::new(1.0, 0.0, 0.0)));
        assert!((line.least.norm() - 1.0).abs() < 1e-9 && line.least.x.abs() < 1e-6, "{line:?}");
    }
}
