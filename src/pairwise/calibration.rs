//! Fits the verifier's weights: ridge-penalised logistic regression by Newton's method. Deterministic.

use nalgebra::{DMatrix, DVector};

use super::verifier::Logistic;

const ITERATIONS: usize = 30;
/// The penalty on the square of every weight but the constant.
const RIDGE: f64 = 3.0;

/// One labelled example.
#[derive(Debug, Clone)]
pub struct Example {
    /// Features as the regression takes them.
    pub features: Vec<f64>,
    /// Whether the pose is right.
    pub right: bool,
}

/// Fits a regression with quadratic terms, or `None` when the examples hold no feature or only one label.
#[must_use]
pub fn fit(examples: &[Example]) -> Option<Logistic> {
    let first = examples.first()?;
    if !examples.iter().any(|e| e.right != first.right) {
        return None;
    }
    let count = first.features.len();
    let n = examples.len() as f64;
    let mean: Vec<f64> =
        (0..count).map(|k| examples.iter().map(|e| e.features[k]).sum::<f64>() / n).collect();
    let deviation: Vec<f64> = (0..count)
        .map(|k| {
            let variance = examples.iter().map(|e| (e.features[k] - mean[k]).powi(2)).sum::<f64>() / n;
            variance.sqrt().max(1e-6)
        })
        .collect();
    let mut logistic = Logistic { mean, deviation, weights: Vec::new() };
    let rows: Vec<DVector<f64>> =
        examples.iter().map(|e| DVector::from_vec(logistic.terms(&e.features))).collect();
    let size = rows[0].len();
    let mut weights = DVector::<f64>::zeros(size);
    for _ in 0..ITERATIONS {
        let mut hessian = DMatrix::<f64>::identity(size, size) * RIDGE;
        hessian[(0, 0)] = 1e-9;
        let mut gradient = weights.map(|w| w * RIDGE);
        gradient[0] = 0.0;
        for (row, example) in rows.iter().zip(examples) {
            let p = 1.0 / (1.0 + (-row.dot(&weights)).exp());
            gradient.axpy(p - f64::from(u8::from(example.right)), row, 1.0);
            hessian.syger((p * (1.0 - p)).max(1e-9), row, row, 1.0);
        }
        hessian.fill_upper_triangle_with_lower_triangle();
        let step = hessian.cholesky()?.solve(&gradient);
        weights -= &step;
        if step.amax() < 1e-8 {
            break;
        }
    }
    logistic.weights = weights.as_slice().to_vec();
    Some(logistic)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quadratic_boundary_is_learned() {
        let examples: Vec<Example> = (0..900)
            .map(|i| {
                let (x, y) = (f64::from(i % 30) / 10.0 - 1.5, f64::from(i / 30) / 10.0 - 1.5);
                Example { features: vec![x, y], right: x * x + y * y < 1.0 }
            })
            .collect();
        let logistic = fit(&examples).expect("both labels are there");
        let correct = examples.iter().filter(|e| (logistic.logit(&e.features) > 0.0) == e.right).count();
        assert!(correct > 850, "{correct} of 900");
        assert!(fit(&examples[..1]).is_none());
    }
}
