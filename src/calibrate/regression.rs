//! Ridge-penalised logistic regression on weighted examples, by Newton's method. The sums run over blocks of fixed size in a
//! fixed order, so the result is the same at any number of threads.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::pairwise::Logistic;

const ITERATIONS: usize = 30;
/// The penalty on the square of every weight of a feature, and of a product: these bend the boundary where examples are few.
const RIDGE: (f64, f64) = (3.0, 30.0);
/// Examples that are summed up together.
const BLOCK: usize = 1024;
/// Steps are halved at most so often where a whole one would not improve the fit.
const HALVINGS: usize = 12;

/// One labelled example.
#[derive(Debug, Clone)]
pub(super) struct Example {
    /// Features as the regression takes them.
    pub features: Vec<f64>,
    /// Log-odds from elsewhere, to which the regression adds; 0 if it is to say all.
    pub offset: f64,
    /// Whether the pose is right.
    pub right: bool,
    /// How much it counts; 1 on average.
    pub weight: f64,
}

/// Fits a regression with quadratic terms, or `None` when the examples hold no feature or only one label.
pub(super) fn fit(examples: &[Example]) -> Option<Logistic> {
    let first = examples.first()?;
    if !examples.iter().any(|e| e.right != first.right) {
        return None;
    }
    let count = first.features.len();
    let total: f64 = examples.iter().map(|e| e.weight).sum();
    let average =
        |of: &dyn Fn(&Example) -> f64| examples.iter().map(|e| e.weight * of(e)).sum::<f64>() / total;
    let mean: Vec<f64> = (0..count).map(|k| average(&|e| e.features[k])).collect();
    let deviation: Vec<f64> =
        (0..count).map(|k| average(&|e| (e.features[k] - mean[k]).powi(2)).sqrt().max(1e-6)).collect();
    let mut logistic = Logistic { mean, deviation, weights: Vec::new() };
    let size = logistic.terms(&first.features).len();
    let mut weights = DVector::<f64>::zeros(size);
    let mut state = State::at(&logistic, &weights, examples);
    for _ in 0..ITERATIONS {
        let step = state.hessian.clone().cholesky()?.solve(&state.gradient);
        let mut share = 1.0;
        let next = (0..HALVINGS).find_map(|_| {
            let tried = &weights - &step * share;
            share *= 0.5;
            let next = State::at(&logistic, &tried, examples);
            (next.loss <= state.loss).then_some((tried, next))
        });
        let Some(next) = next else { break };
        (weights, state) = next;
        if step.amax() < 1e-7 {
            break;
        }
    }
    logistic.weights = weights.as_slice().to_vec();
    Some(logistic)
}

/// The penalised loss at some weights, and its derivatives.
struct State {
    loss: f64,
    gradient: DVector<f64>,
    hessian: DMatrix<f64>,
}

impl State {
    fn at(logistic: &Logistic, weights: &DVector<f64>, examples: &[Example]) -> Self {
        let size = weights.len();
        let parts: Vec<Self> =
            examples.par_chunks(BLOCK).map(|block| Self::of(logistic, weights, block)).collect();
        let features = logistic.mean.len();
        let penalty = DVector::from_fn(size, |term, _| match term {
            0 => 1e-9,
            term if term <= features => RIDGE.0,
            _ => RIDGE.1,
        });
        let mut sum = Self {
            loss: 0.5 * weights.component_mul(weights).dot(&penalty),
            gradient: weights.component_mul(&penalty),
            hessian: DMatrix::from_diagonal(&penalty),
        };
        for part in parts {
            sum.loss += part.loss;
            sum.gradient += part.gradient;
            sum.hessian += part.hessian;
        }
        sum
    }

    fn of(logistic: &Logistic, weights: &DVector<f64>, block: &[Example]) -> Self {
        let terms: Vec<f64> = block.iter().flat_map(|e| logistic.terms(&e.features)).collect();
        // One column an example.
        let terms = DMatrix::from_vec(weights.len(), block.len(), terms);
        let offsets = DVector::from_iterator(block.len(), block.iter().map(|e| e.offset));
        let logits = terms.tr_mul(weights) + offsets;
        let mut weighted = terms.clone();
        let (mut loss, mut residuals) = (0.0, DVector::zeros(block.len()));
        for (i, (example, logit)) in block.iter().zip(logits.iter()).enumerate() {
            let p = 1.0 / (1.0 + (-logit).exp());
            let target = f64::from(u8::from(example.right));
            loss += example.weight * log_loss(*logit, example.right);
            residuals[i] = example.weight * (p - target);
            weighted.column_mut(i).scale_mut(example.weight * (p * (1.0 - p)).max(1e-9));
        }
        Self { loss, gradient: &terms * residuals, hessian: weighted * terms.transpose() }
    }
}

/// `-ln p` of what happened.
pub(super) fn log_loss(logit: f64, right: bool) -> f64 {
    let against = if right { -logit } else { logit };
    against.max(0.0) + (-against.abs()).exp().ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(weight: impl Fn(bool) -> f64) -> Vec<Example> {
        (0..900)
            .map(|i| {
                let (x, y) = (f64::from(i % 30) / 10.0 - 1.5, f64::from(i / 30) / 10.0 - 1.5);
                let right = x * x + y * y < 1.0;
                Example { features: vec![x, y], offset: 0.0, right, weight: weight(right) }
            })
            .collect()
    }

    #[test]
    fn a_quadratic_boundary_is_learned() {
        let examples = disc(|_| 1.0);
        let logistic = fit(&examples).expect("both labels are there");
        let correct = examples.iter().filter(|e| (logistic.logit(&e.features) > 0.0) == e.right).count();
        assert!(correct > 850, "{correct} of 900");
        assert!(fit(&examples[..1]).is_none());
    }

    #[test]
    fn examples_that_weigh_more_move_the_boundary_away_from_them() {
        let [plain, heavy] =
            [1.0, 9.0].map(|w| fit(&disc(|right| if right { w } else { 1.0 })).expect("both labels"));
        let border = [1.0, 0.0];
        assert!(heavy.logit(&border) > plain.logit(&border) + 0.5);
    }

    #[test]
    fn what_is_known_already_is_not_learned_again() {
        // Right with the probability that log-odds of 2 x + 0.5 give, of which the offset knows all or nothing.
        let examples = |known: bool| -> Vec<Example> {
            let at = |i: i32| {
                let x = f64::from(i) / 100.0;
                let logit = 2.0 * x + 0.5;
                let p = 1.0 / (1.0 + (-logit).exp());
                let example = move |right, weight| Example {
                    features: vec![x],
                    offset: if known { logit } else { 0.0 },
                    right,
                    weight,
                };
                [example(true, 2.0 * p), example(false, 2.0 * (1.0 - p))]
            };
            (-150..150).flat_map(at).collect()
        };
        let learned = |known| {
            let of = fit(&examples(known)).expect("both labels");
            of.logit(&[1.0]) - of.logit(&[-1.0])
        };
        assert!((3.0..4.5).contains(&learned(false)), "{}", learned(false));
        assert!(learned(true).abs() < 1e-6, "{}", learned(true));
    }

    #[test]
    fn a_weight_is_as_good_as_repetition_and_threads_change_no_bit() {
        let examples: Vec<Example> = disc(|_| 1.0).into_iter().cycle().take(2700).collect();
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| fit(&examples)).expect("both labels")
        };
        assert_eq!(run(1), run(2));
        let weighed = fit(&disc(|_| 3.0)).expect("both labels");
        let difference = weighed.logit(&[0.3, -0.4]) - run(1).logit(&[0.3, -0.4]);
        assert!(difference.abs() < 1e-6, "{difference}");
    }
}
