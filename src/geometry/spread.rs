//! How points spread around their mean: the principal components of a neighbourhood.

use multiversion::multiversion;
use nalgebra::Vector3;

use super::Moments;

/// Variances along the principal axes, and the axis of the least.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Ascending, square metres. Rounding may take the least slightly below zero.
    pub values: [f64; 3],
    /// The direction of the least variance, a unit vector of arbitrary sign. Where the two smaller are alike it is any direction between theirs.
    pub least: Vector3<f64>,
}

/// Matrices whose components are found side by side.
const LANES: usize = 8;

/// One number of each of them.
type Numbers = [f64; LANES];

/// cos(2/3 arccos((x + 1) / 2)) on [-1, 1] to within 2e-12: the polynomial through its values at thirteen Chebyshev nodes, from the constant up.
const THIRD: [f64; 13] = [
    0.766_044_443_118_978,
    0.247_409_066_305_97,
    -0.015_509_188_431_430_5,
    0.002_466_353_286_295_8,
    -0.000_504_124_832_036_538,
    0.000_116_421_713_441_271,
    -2.891_881_870_956_61e-5,
    7.553_708_960_314_52e-6,
    -2.039_643_266_108_75e-6,
    5.436_753_739_726_65e-7,
    -1.534_265_249_937_76e-7,
    6.130_853_112_831_37e-8,
    -1.796_658_291_376_63e-8,
];

impl Spread {
    /// Of neighbourhoods, in closed form; where there is no point nothing is a number. Eigenvalues of a symmetric matrix by the angle that its determinant gives, and the
    /// vector across the two rows of its remainder that span most (D. Eberly, "A Robust Eigensolver for 3 x 3 Symmetric Matrices", 2014).
    #[must_use]
    pub fn of_all(neighborhoods: &[Moments]) -> Vec<Self> {
        let mut found = Vec::with_capacity(neighborhoods.len());
        for some in neighborhoods.chunks(LANES) {
            let mut covariances = [[0.0; LANES]; 6];
            for (lane, near) in some.iter().enumerate() {
                let n = f64::from(near.count);
                let mean = near.sum.map(|sum| f64::from(sum) / n);
                for (at, (i, j)) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].into_iter().enumerate() {
                    covariances[at][lane] = f64::from(near.products[at]) / n - mean[i] * mean[j];
                }
            }
            let components = components(&covariances);
            found.extend((0..some.len()).map(|lane| Self {
                values: components.values.map(|value| value[lane]),
                least: components.least.map(|axis| axis[lane]).into(),
            }));
        }
        found
    }
}

/// What [`Spread`] holds, of many.
struct Components {
    values: [Numbers; 3],
    least: [Numbers; 3],
}

/// The components of symmetric matrices, given by their entries xx, xy, xz, yy, yz, zz.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn components([xx, xy, xz, yy, yz, zz]: &[Numbers; 6]) -> Components {
    const NONE: [Numbers; 3] = [[0.0; LANES]; 3];
    let mut found = Components { values: NONE, least: NONE };
    let Components { values: [smallest, middle, largest], least: [x, y, z] } = &mut found;
    for k in 0..LANES {
        let (a, b, c) = (xy[k], xz[k], yz[k]);
        let mean = (xx[k] + yy[k] + zz[k]) / 3.0;
        let (p, q, r) = (xx[k] - mean, yy[k] - mean, zz[k] - mean);
        let off_diagonal = a * a + b * b + c * c;
        let scale = ((p * p + q * q + r * r + 2.0 * off_diagonal) / 6.0).sqrt();
        let spreads_alike = scale <= f64::EPSILON * mean.abs();
        let inverse = if spreads_alike { 0.0 } else { 1.0 / scale };
        let (p, q, r) = (p * inverse, q * inverse, r * inverse);
        let (u, v, w) = (a * inverse, b * inverse, c * inverse);
        let determinant = p * (q * r - w * w) - u * (u * r - w * v) + v * (u * w - q * v);
        let half = (determinant * 0.5).clamp(-1.0, 1.0);
        largest[k] = mean + 2.0 * scale * cosine_of_third(half);
        smallest[k] = mean - 2.0 * scale * cosine_of_third(-half);
        middle[k] = 3.0 * mean - smallest[k] - largest[k];

        let (p, q, r) = (xx[k] - smallest[k], yy[k] - smallest[k], zz[k] - smallest[k]);
        let across = [
            [a * c - b * q, b * a - p * c, p * q - a * a],
            [q * r - c * c, c * b - a * r, a * c - q * b],
            [c * b - r * a, r * p - b * b, b * a - c * p],
        ];
        let square = |[x, y, z]: [f64; 3]| x * x + y * y + z * z;
        let squares = across.map(square);
        let second = squares[1] > squares[0];
        let (best, most) = if second { (across[1], squares[1]) } else { (across[0], squares[0]) };
        let third = squares[2] > most;
        let (best, most) = if third { (across[2], squares[2]) } else { (best, most) };
        let length = most.sqrt();
        let determined = !spreads_alike && length > 0.0;
        let inverse = if determined { 1.0 / length } else { 0.0 };
        x[k] = best[0] * inverse;
        y[k] = best[1] * inverse;
        z[k] = if determined { best[2] * inverse } else { 1.0 };
    }
    found
}

/// cos(arccos(x) / 3), by the cosine of the half of that angle, of which it is a function without a corner.
#[inline]
fn cosine_of_third(x: f64) -> f64 {
    let at = 2.0 * ((1.0 + x) * 0.5).sqrt() - 1.0;
    THIRD.iter().rev().fold(0.0, |value, coefficient| value * at + coefficient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    /// The spread of a neighbourhood with a covariance matrix, found beside those of others.
    fn of_covariance(matrix: &Matrix3<f64>) -> Spread {
        let near = |matrix: &Matrix3<f64>| Moments {
            count: 1,
            sum: [0.0; 3],
            products: [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|at| matrix[at] as f32),
        };
        let mut all = vec![near(&Matrix3::from_diagonal(&Vector3::new(3.0, 2.0, 1.0))); LANES + 3];
        all[LANES + 1] = near(matrix);
        let found = Spread::of_all(&all);
        assert_eq!(found.len(), all.len());
        assert!((found[LANES + 2].least.z.abs() - 1.0).abs() < 1e-12, "{:?}", found[LANES + 2]);
        found[LANES + 1]
    }

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
            let found = of_covariance(&matrix);
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
    fn a_third_of_an_angle_is_a_third() {
        for i in 0..=1000 {
            let angle = std::f64::consts::PI * f64::from(i) / 1000.0;
            let found = cosine_of_third(angle.cos());
            assert!((found - (angle / 3.0).cos()).abs() < 1e-8, "{angle}: {found}");
            if angle < 3.1 {
                assert!((found - (angle / 3.0).cos()).abs() < 1e-11, "{angle}: {found}");
            }
        }
    }

    #[test]
    fn nothing_has_no_spread() {
        let one = Moments { count: 1, ..Moments::default() };
        let [nothing, point] = Spread::of_all(&[Moments::default(), one])[..] else { panic!("two go in") };
        assert!(nothing.values.iter().all(|value| value.is_nan()));
        assert_eq!(point.values, [0.0; 3]);
    }

    #[test]
    fn what_spreads_alike_has_some_direction() {
        for matrix in [Matrix3::zeros(), Matrix3::identity() * 4.0] {
            let found = of_covariance(&matrix);
            assert!((found.least.norm() - 1.0).abs() < 1e-9);
            assert_eq!(found.values, [matrix[(0, 0)]; 3]);
        }
        let line = of_covariance(&Matrix3::from_diagonal(&Vector3::new(1.0, 0.0, 0.0)));
        assert!((line.least.norm() - 1.0).abs() < 1e-9 && line.least.x.abs() < 1e-6, "{line:?}");
    }
}
