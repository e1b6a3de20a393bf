//! Levenberg-Marquardt over poses: the one minimiser of all adjustments in this layer.
//!
//! Steps are judged by the true energy, robust kernels included, never by the linearised one; damping follows
//! Nielsen (1999): it shrinks by the gain ratio and grows twice as fast with every rejection in a row.

mod outcome;

use nalgebra::Vector6;

pub use outcome::{MinimiseError, Minimum, Report, Termination};

use super::{BlockSolver, BlockSolverError, BlockSystem, OptionError};
use crate::control::Control;

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

impl MinimiseOptions {
    /// Checks that every tolerance is a number of at least zero and the damping is positive.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::not_negative("relative_cost", self.relative_cost)?;
        OptionError::not_negative("step", self.step)?;
        OptionError::not_negative("gradient", self.gradient)?;
        OptionError::positive("initial_damping", self.initial_damping)
    }
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
pub(super) mod laws;
#[cfg(test)]
mod tests;
