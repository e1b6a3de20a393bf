//! What the normal equations of every problem must be, for the tests of this layer.

use nalgebra::Vector6;

use super::Problem;

/// Panics unless the right-hand side is minus half the numerical gradient of the true cost, for all free numbers.
pub(in crate::optimize) fn assert_gradient<P: Problem>(
    problem: &P,
    state: &P::State,
    variables: usize,
    tolerance: f64,
) {
    let (system, cost) = problem.linearise(state);
    assert!((cost - problem.cost(state)).abs() <= 1e-12 * cost, "linearise and cost disagree");
    let h = 1e-6;
    for variable in (0..variables).filter(|&v| system.slot(v).is_some()) {
        for axis in 0..6 {
            let moved = |h: f64| {
                let mut delta = vec![Vector6::zeros(); variables];
                delta[variable][axis] = h;
                problem.cost(&problem.step(state, &delta))
            };
            let numeric = -(moved(h) - moved(-h)) / (4.0 * h);
            let analytic = system.rhs()[system.slot(variable).unwrap()][axis];
            let scale = tolerance * system.diagonal_block(variable).unwrap()[(axis, axis)].max(1.0);
            assert!(
                (numeric - analytic).abs() < scale,
                "variable {variable}, axis {axis}: numerical {numeric:.9e}, analytic {analytic:.9e}"
            );
        }
    }
}
