//! What rotation and translation averaging share: vectors of nodes from vectors of links, some of which are wrong, by
//! iteratively reweighted least squares.
//!
//! The sum of lengths of the residuals is minimised first (L1, weights `1 / |r|`): it is convex in the differences, so a start that is
//! bent by outliers recovers. Then come Geman-McClure weights, under which an outlier pulls hardly at all. This is the order of
//! Chatterjee and Govindu, "Efficient and Robust Large-Scale Rotation Averaging" (2013).

use nalgebra::{Matrix6, Vector3, Vector6};

use super::block_solver::{BlockSolver, BlockSolverError};
use super::block_system::BlockSystem;
use super::gauge::Gauge;
use super::option_error::OptionError;
use crate::control::{Cancelled, Control};
use crate::geometry::Kernel;

/// No link is weaker than this share of its own weight, so that nodes that hang on outliers alone still have a place.
const LEAST_WEIGHT: f64 = 1e-6;
/// In the first phase, residuals below this share of the scale weigh alike.
const ABSOLUTE_FLOOR: f64 = 1e-3;

/// How averaging treats residuals and when it stops. Lengths of residuals are radians for rotations and metres for translations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AveragingOptions {
    /// Scale of the Geman-McClure kernel: a residual this long weighs a quarter.
    pub scale: f64,
    /// Rounds that minimise the sum of lengths, at most.
    pub absolute_rounds: usize,
    /// Rounds with the kernel, at most.
    pub robust_rounds: usize,
    /// A phase ends when no node moved by more than this share of the scale.
    pub least_step: f64,
}

impl AveragingOptions {
    /// The defaults for a scale: 5 degrees for rotations in the literature, a few voxels for translations.
    #[must_use]
    pub fn with_scale(scale: f64) -> Self {
        Self { scale, absolute_rounds: 20, robust_rounds: 100, least_step: 1e-4 }
    }

    fn validate(&self) -> Result<(), OptionError> {
        OptionError::positive("scale", self.scale)?;
        OptionError::not_negative("least_step", self.least_step)
    }
}

/// The averaged nodes, and which links they believe.
#[derive(Debug, Clone, PartialEq)]
pub struct Averaged<T> {
    /// One a node. The lowest index of each connected group is as it came, as are nodes without links.
    pub nodes: Vec<T>,
    /// The final length of each link's residual.
    pub residuals: Vec<f64>,
    /// The final weight of each link under the kernel alone, in [0, 1].
    pub weights: Vec<f64>,
    /// Rounds of both phases.
    pub rounds: usize,
}

/// Why nothing was averaged.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum AveragingError {
    /// An option that makes no sense.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// An edge joins a node to itself or to one that does not exist.
    #[error("edge {edge} joins nodes {i} and {j} of {nodes}")]
    BadEnds {
        /// Its index.
        edge: usize,
        /// One end.
        i: usize,
        /// The other.
        j: usize,
        /// How many nodes there are.
        nodes: usize,
    },
    /// A number of an edge is not finite, or its weight is not positive.
    #[error("edge {edge} has a measurement that is not finite or a weight that is not positive")]
    NotFinite {
        /// Its index.
        edge: usize,
    },
    /// The normal equations have no solution.
    #[error(transparent)]
    Solver(#[from] BlockSolverError),
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// A link between two nodes, without what was measured along it.
#[derive(Debug, Clone, Copy)]
pub(super) struct Link {
    pub i: usize,
    pub j: usize,
    pub weight: f64,
    /// Whether the measurement is a number.
    pub finite: bool,
}

/// What is averaged: nodes of type `T` and measured links.
pub(super) trait Averageable<T> {
    /// The vector r of a link by which node j must move, relative to node i, for the link to hold.
    fn residual(&self, link: usize, nodes: &[T]) -> Vector3<f64>;

    /// The node moved by a vector.
    fn moved(&self, node: &T, by: &Vector3<f64>) -> T;
}

/// Minimises `sum_l w_l rho(|r_l|)` over all nodes.
pub(super) fn average<T: Clone>(
    problem: &impl Averageable<T>,
    links: &[Link],
    start: &[T],
    options: &AveragingOptions,
    control: Control<'_>,
) -> Result<Averaged<T>, AveragingError> {
    options.validate()?;
    for (edge, &Link { i, j, weight, finite }) in links.iter().enumerate() {
        if i == j || i.max(j) >= start.len() {
            return Err(AveragingError::BadEnds { edge, i, j, nodes: start.len() });
        }
        if !finite || !weight.is_finite() || weight <= 0.0 {
            return Err(AveragingError::NotFinite { edge });
        }
    }
    let gauge = Gauge::new(&vec![false; start.len()], links.iter().map(|l| (l.i, l.j)), std::iter::empty());
    let kernel = Kernel::GemanMcClure(options.scale);
    let absolute = |square: f64| 1.0 / (square.sqrt() / options.scale).max(ABSOLUTE_FLOOR);
    let robust = |square: f64| kernel.weight(square).max(LEAST_WEIGHT);
    let phases: [(usize, &dyn Fn(f64) -> f64); 2] =
        [(options.absolute_rounds, &absolute), (options.robust_rounds, &robust)];

    let mut nodes = start.to_vec();
    let (mut solver, mut rounds) = (BlockSolver::new(), 0);
    for (limit, weight) in phases {
        for _ in 0..limit {
            control.check()?;
            let system = normal_equations(problem, links, &nodes, &gauge.held, weight);
            let steps = solver.solve(&system, 0.0)?;
            rounds += 1;
            let mut longest = 0.0_f64;
            for ((node, step), _) in nodes.iter_mut().zip(&steps).zip(&gauge.held).filter(|(_, held)| !**held)
            {
                let by: Vector3<f64> = step.fixed_rows::<3>(0).into();
                longest = longest.max(by.norm());
                *node = problem.moved(node, &by);
            }
            if longest <= options.least_step * options.scale {
                break;
            }
        }
    }
    let residuals: Vec<f64> = (0..links.len()).map(|link| problem.residual(link, &nodes).norm()).collect();
    let weights = residuals.iter().map(|r| kernel.weight(r * r)).collect();
    Ok(Averaged { nodes, residuals, weights, rounds })
}

/// `sum w |x_j - x_i - r|^2` over the moves x of the nodes that are not held. Three numbers a node suffice, so the last three of each
/// block are zero.
fn normal_equations<T>(
    problem: &impl Averageable<T>,
    links: &[Link],
    nodes: &[T],
    held: &[bool],
    weight: &dyn Fn(f64) -> f64,
) -> BlockSystem {
    let mut system = BlockSystem::new(held);
    for (index, link) in links.iter().enumerate() {
        let residual = problem.residual(index, nodes);
        let weight = link.weight * weight(residual.norm_squared());
        let pull = residual * weight;
        system.add_relative(
            link.i,
            link.j,
            &(Matrix6::identity() * weight),
            &Vector6::new(pull.x, pull.y, pull.z, 0.0, 0.0, 0.0),
        );
    }
    system
}
