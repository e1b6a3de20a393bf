//! The minimiser on an energy with a known minimum.

use super::*;
use crate::control::{CancelToken, Silent};
use nalgebra::Matrix6;

/// One variable whose state is a plain vector; `sum_k (x_k^2 - k)^2 / 4 + offset`: curved, with a known minimum.
struct Quartic {
    offset: f64,
}

impl Problem for Quartic {
    type State = Vector6<f64>;

    fn cost(&self, x: &Vector6<f64>) -> f64 {
        (0..6).map(|k| (x[k] * x[k] - k as f64).powi(2) / 4.0).sum::<f64>() + self.offset
    }

    fn linearise(&self, x: &Vector6<f64>) -> (BlockSystem, f64) {
        let mut system = BlockSystem::new(&[false]);
        let residual = Vector6::from_fn(|k, _| 0.5 * (x[k] * x[k] - k as f64));
        system.add(0, 0, &Matrix6::from_diagonal(&x.component_mul(x)));
        system.add_rhs(0, &-x.component_mul(&residual));
        (system, self.cost(x))
    }

    fn step(&self, x: &Vector6<f64>, delta: &[Vector6<f64>]) -> Vector6<f64> {
        x + delta[0]
    }

    fn length(&self) -> f64 {
        1.0
    }
}

fn run(offset: f64, options: &MinimiseOptions) -> Minimum<Vector6<f64>> {
    let cancel = CancelToken::new();
    let control = Control { cancel: &cancel, observer: &Silent };
    minimise(&Quartic { offset }, Vector6::repeat(3.0), options, control).unwrap()
}

#[test]
fn a_curved_valley_is_descended_to_its_bottom() {
    let minimum = run(1.0, &MinimiseOptions { relative_cost: 1e-14, ..MinimiseOptions::default() });
    assert!(minimum.report.converged(), "{:?}", minimum.report);
    assert!((minimum.report.cost_after - 1.0).abs() < 1e-8, "{:?}", minimum.report);
}

#[test]
fn the_reason_to_stop_carries_the_measure_and_the_limit() {
    let few = MinimiseOptions { max_iterations: 2, ..MinimiseOptions::default() };
    assert_eq!(run(1.0, &few).report.termination, Termination::MaxIterations { iterations: 2 });
    let coarse = MinimiseOptions { relative_cost: 0.9, ..MinimiseOptions::default() };
    let Termination::RelativeCost { measured, threshold } = run(1e6, &coarse).report.termination else {
        panic!("another reason")
    };
    assert!(measured <= threshold && threshold == 0.9);
}

#[test]
fn a_cancelled_run_is_an_error_and_so_is_an_energy_that_is_no_number() {
    let cancel = CancelToken::new();
    let control = Control { cancel: &cancel, observer: &Silent };
    let options = MinimiseOptions::default();
    let nan = minimise(&Quartic { offset: f64::NAN }, Vector6::repeat(3.0), &options, control);
    assert!(matches!(nan, Err(MinimiseError::NotFinite(_))));
    cancel.cancel();
    let stopped = minimise(&Quartic { offset: 0.0 }, Vector6::repeat(3.0), &options, control);
    assert!(matches!(stopped, Err(MinimiseError::Cancelled(_))));
}

#[test]
fn options_that_make_no_sense_are_named() {
    let options = MinimiseOptions { step: f64::NAN, ..MinimiseOptions::default() };
    assert_eq!(options.validate().unwrap_err().name, "step");
    let options = MinimiseOptions { initial_damping: 0.0, ..MinimiseOptions::default() };
    assert_eq!(options.validate().unwrap_err().name, "initial_damping");
}
