//! Levenberg-Marquardt over poses: the one minimiser of all adjustments in this layer.
//!
//! Steps are judged by the true energy, robust kernels included, never by the linearised one; damping follows
//! Nielsen (1999): it shrinks by the gain ratio and grows twice as fast with every rejection in a row.

use nalgebra::Vector6;

use super::{BlockSolver, BlockSolverError, BlockSystem};
use crate::control::{Cancelled, Control};

/// An energy over poses and whatever is eliminated beside them.
pub trait Problem {
    /// Poses, and what follows from them.
    type State: Clone;

    /// The true energy `sum w rho(|r|^2)`, metres squared.
    fn cost(&self, state: &Self::State) -> f64;

    /// The normal equations at a state, and its true energy.
    fn linearise(&self, state: &Self::State) -> (BlockSystem, f64);

    /// The state moved by a left perturbation a pose (zero for held ones, which must come back bit for bit).
    fn step(&self, state: &Self::State, delta: &[Vector6<f64>]) -> Self::State;

    /// A typical distance of points from their scan's origin, metres: what a radian means in metres.
    fn length(&self) -> f64;
}

/// When to stop. All tolerances are free of scale and unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MinimiseOptions {
    /// Linear solves at most, rejected steps included.
    pub max_iterations: usize,
    /// Stop when a step lowers the energy by at most this share.
    pub relative_cost: f64,
    /// Stop when no pose turns by more than this many radians, nor moves by more than this share of the problem's length.
    pub step: f64,
    /// Stop when the scaled gradient promises at most this share of the energy.
    pub gradient: f64,
    /// The first damping, relative to the diagonal of the normal equations.
    pub initial_damping: f64,
}

impl Default for MinimiseOptions {
    fn default() -> Self {
        Self { max_iterations: 50, relative_cost: 1e-6, step: 1e-10, gradient: 1e-12, initial_damping: 1e-5 }
    }
}

/// An option that makes no sense.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[error("option {name} is {value}, but it must be {requirement}")]
pub struct OptionError {
    /// The field.
    pub name: &'static str,
    /// What it was.
    pub value: f64,
    /// What it may be.
    pub requirement: &'static str,
}

impl OptionError {
    /// Checks that a number is positive and finite.
    pub(super) fn positive(name: &'static str, value: f64) -> Result<(), Self> {
        let requirement = "positive and finite";
        if value > 0.0 && value.is_finite() { Ok(()) } else { Err(Self { name, value, requirement }) }
    }

    /// Checks that a number is at least zero and finite.
    pub(super) fn not_negative(name: &'static str, value: f64) -> Result<(), Self> {
        let requirement = "at least zero and finite";
        if value >= 0.0 && value.is_finite() { Ok(()) } else { Err(Self { name, value, requirement }) }
    }
}

impl MinimiseOptions {
    /// Checks that every tolerance is a number of at least zero and the damping is positive.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::not_negative("relative_cost", self.relative_cost)?;
        OptionError::not_negative("step", self.step)?;
        OptionError::not_negative("gradient", self.gradient)?;
        OptionError::positive("initial_damping", self.initial_damping)
    }
}

/// Why the minimiser stopped, with what was measured and the limit it met.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Termination {
    /// The gradient promises too little.
    Gradient {
        /// Share of the energy.
        measured: f64,
        /// The limit.
        threshold: f64,
    },
    /// The step was too small.
    Step {
        /// Largest turn in radians or shift in lengths.
        measured: f64,
        /// The limit.
        threshold: f64,
    },
    /// The energy no longer falls.
    RelativeCost {
        /// Share of the energy.
        measured: f64,
        /// The limit.
        threshold: f64,
    },
    /// The iterations are used up; the state is the best so far.
    MaxIterations {
        /// How many.
        iterations: usize,
    },
    /// No step lowers the energy, however short; the state is the best so far.
    NoProgress {
        /// Damping reached.
        measured: f64,
        /// The limit.
        threshold: f64,
    },
    /// Every pose is held, or there is nothing that could move one.
    NothingFree,
}

impl std::fmt::Display for Termination {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Gradient { measured, threshold } => {
                write!(f, "the gradient promises {measured:.1e} of the energy (limit {threshold:.1e})")
            }
            Self::Step { measured, threshold } => {
                write!(f, "the last step was {measured:.1e} (limit {threshold:.1e})")
            }
            Self::RelativeCost { measured, threshold } => {
                write!(f, "the energy fell by a share of {measured:.1e} (limit {threshold:.1e})")
            }
            Self::MaxIterations { iterations } => write!(f, "all {iterations} iterations are used up"),
            Self::NoProgress { measured, threshold } => {
                write!(f, "no step lowers the energy: damping reached {measured:.1e} (limit {threshold:.1e})")
            }
            Self::NothingFree => write!(f, "nothing is free to move"),
        }
    }
}

/// What a minimisation did.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Report {
    /// Linear solves, rejected steps included.
    pub iterations: usize,
    /// The true energy at the start, metres squared.
    pub cost_before: f64,
    /// The true energy at the end, never above that at the start.
    pub cost_after: f64,
    /// Why it stopped.
    pub termination: Termination,
}

impl Report {
    /// Whether a minimum was found, as far as the tolerances tell.
    #[must_use]
    pub fn converged(&self) -> bool {
        !matches!(self.termination, Termination::MaxIterations { .. } | Termination::NoProgress { .. })
    }
}

/// The state with the least energy found.
#[derive(Debug, Clone)]
pub struct Minimum<S> {
    /// Poses, and what follows from them.
    pub state: S,
    /// How it was found.
    pub report: Report,
}

/// Why nothing could be minimised.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum MinimiseError {
    /// An option makes no sense.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The energy of the start is infinite or not a number.
    #[error("the energy at the start is {0}")]
    NotFinite(f64),
    /// The problem does not fit this machine.
    #[error(transparent)]
    Solver(BlockSolverError),
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// Damping beyond which a step is shorter than rounding.
const MOST_DAMPING: f64 = 1e16;
/// Damping below which it no longer matters.
const LEAST_DAMPING: f64 = 1e-12;

/// Minimises the energy of a problem from a start. Cancellation is checked before every linear solve.
pub fn minimise<P: Problem>(
    problem: &P,
    start: P::State,
    options: &MinimiseOptions,
    control: Control<'_>,
) -> Result<Minimum<P::State>, MinimiseError> {
    options.validate()?;
    let (mut system, mut cost) = problem.linearise(&start);
    if !cost.is_finite() {
        return Err(MinimiseError::NotFinite(cost));
    }
    let mut report =
        Report { iterations: 0, cost_before: cost, cost_after: cost, termination: Termination::NothingFree };
    let mut state = start;
    if system.free() == 0 {
        return Ok(Minimum { state, report });
    }
    let mut solver = BlockSolver::new();
    let mut damping = Damping { value: options.initial_damping, growth: 2.0 };
    report.termination = loop {
        control.check()?;
        if let Some(termination) = options.flat(&system, cost) {
            break termination;
        }
        if report.iterations == options.max_iterations {
            break Termination::MaxIterations { iterations: report.iterations };
        }
        report.iterations += 1;
        let trial = match solver.solve(&system, damping.value) {
            Ok(delta) => Some(Trial::of(problem, &state, &system, &delta, damping.value)),
            Err(BlockSolverError::NotPositiveDefinite { .. }) => None,
            Err(error) => return Err(MinimiseError::Solver(error)),
        };
        let settled = trial.as_ref().and_then(|trial| options.settled(trial, cost));
        match trial {
            // False as well for a cost that is not a number.
            Some(trial) if trial.cost < cost => {
                damping.accepted((cost - trial.cost) / trial.predicted);
                (state, cost) = (trial.state, trial.cost);
                if settled.is_none() {
                    (system, _) = problem.linearise(&state);
                }
            }
            _ => damping.rejected(),
        }
        if let Some(termination) = settled {
            break termination;
        }
        if damping.value > MOST_DAMPING {
            break Termination::NoProgress { measured: damping.value, threshold: MOST_DAMPING };
        }
    };
    report.cost_after = cost;
    Ok(Minimum { state, report })
}

/// A step that was computed but not yet accepted.
struct Trial<S> {
    state: S,
    cost: f64,
    predicted: f64,
    /// Largest turn in radians or shift in lengths.
    size: f64,
}

impl<S: Clone> Trial<S> {
    fn of<P: Problem<State = S>>(
        problem: &P,
        state: &S,
        system: &BlockSystem,
        delta: &[Vector6<f64>],
        damping: f64,
    ) -> Self {
        let moved = problem.step(state, delta);
        let length = problem.length();
        let size = delta
            .iter()
            .map(|xi| xi.fixed_rows::<3>(0).norm().max(xi.fixed_rows::<3>(3).norm() / length))
            .fold(0.0, f64::max);
        let cost = problem.cost(&moved);
        Self { cost, predicted: system.predicted_decrease(delta, damping), size, state: moved }
    }
}

impl MinimiseOptions {
    fn flat(&self, system: &BlockSystem, cost: f64) -> Option<Termination> {
        let measured = if cost > 0.0 { system.scaled_gradient() / cost } else { 0.0 };
        (measured <= self.gradient).then_some(Termination::Gradient { measured, threshold: self.gradient })
    }

    fn settled<S>(&self, trial: &Trial<S>, cost: f64) -> Option<Termination> {
        let change = (cost - trial.cost).abs() / cost;
        if trial.size <= self.step {
            return Some(Termination::Step { measured: trial.size, threshold: self.step });
        }
        (change <= self.relative_cost)
            .then_some(Termination::RelativeCost { measured: change, threshold: self.relative_cost })
    }
}

/// Nielsen's damping.
struct Damping {
    value: f64,
    growth: f64,
}

impl Damping {
    fn accepted(&mut self, gain: f64) {
        let shrink = (1.0 - (2.0 * gain - 1.0).powi(3)).clamp(1.0 / 3.0, 2.0);
        self.value = (self.value * shrink).max(LEAST_DAMPING);
        self.growth = 2.0;
    }

    fn rejected(&mut self) {
        self.value *= self.growth;
        self.growth *= 2.0;
    }
}

#[cfg(test)]
pub(super) mod laws {
    use super::*;

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
}

#[cfg(test)]
mod tests {
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
}
