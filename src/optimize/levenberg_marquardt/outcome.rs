//! What becomes of a minimisation: the least state found with a report of how and why it ended there, or the reason why there is none.

use super::super::{BlockSolverError, OptionError};
use crate::control::Cancelled;

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
