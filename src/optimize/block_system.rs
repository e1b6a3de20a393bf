//! The normal equations of an adjustment: a symmetric sparse matrix of 6x6 blocks and its right-hand side.
//!
//! Filled by the energies of this layer, possibly in parallel parts that are then merged; solved by
//! [`BlockSolver`](super::BlockSolver).

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::sync::Arc;

use nalgebra::{Matrix6, Vector6};

/// `H x = b` for the variables that are not held; x holds six numbers a variable.
///
/// For an energy `E = sum w rho(|r|^2)` with Jacobians J the energies of this layer fill in `H = sum w rho' J^T J` and
/// `b = -sum w rho' J^T r`, so that `E(x) = E - 2 b^T x + x^T H x` near x = 0.
#[derive(Debug, Clone)]
pub struct BlockSystem {
    slots: Arc<Slots>,
    diagonal: Vec<Matrix6<f64>>,
    /// Blocks below the diagonal by (column, row): the order in which a column-major matrix stores them.
    below: BTreeMap<(usize, usize), Matrix6<f64>>,
    rhs: Vec<Vector6<f64>>,
}

/// Which variables have a place in the system.
#[derive(Debug)]
struct Slots {
    slot_of: Vec<Option<usize>>,
    variable_of: Vec<usize>,
}

/// The least entry of the damping diagonal, relative to its largest of the same kind (rotations, translations).
const DAMPING_FLOOR: f64 = 1e-12;

impl BlockSystem {
    /// An empty system over `held.len()` variables, of which the held ones have no row.
    #[must_use]
    pub fn new(held: &[bool]) -> Self {
        let variable_of: Vec<usize> = (0..held.len()).filter(|&v| !held[v]).collect();
        let mut slot_of = vec![None; held.len()];
        for (slot, &variable) in variable_of.iter().enumerate() {
            slot_of[variable] = Some(slot);
        }
        Self::with_slots(Arc::new(Slots { slot_of, variable_of }))
    }

    /// An empty system over the same variables.
    #[must_use]
    pub fn empty_like(&self) -> Self {
        Self::with_slots(Arc::clone(&self.slots))
    }

    fn with_slots(slots: Arc<Slots>) -> Self {
        let free = slots.variable_of.len();
        Self {
            slots,
            diagonal: vec![Matrix6::zeros(); free],
            below: BTreeMap::new(),
            rhs: vec![Vector6::zeros(); free],
        }
    }

    /// Adds to the block of row `i` and column `j`, and for `i != j` the transpose to row `j` and column `i`. A block
    /// on the diagonal must be symmetric. Blocks of held variables are ignored: their x is zero.
    ///
    /// # Panics
    /// If `i` or `j` is not a variable of the system.
    pub fn add(&mut self, i: usize, j: usize, block: &Matrix6<f64>) {
        let (Some(i), Some(j)) = (self.slots.slot_of[i], self.slots.slot_of[j]) else { return };
        match i.cmp(&j) {
            std::cmp::Ordering::Equal => self.diagonal[i] += block,
            std::cmp::Ordering::Greater => *self.below.entry((j, i)).or_insert_with(Matrix6::zeros) += block,
            std::cmp::Ordering::Less => {
                *self.below.entry((i, j)).or_insert_with(Matrix6::zeros) += block.transpose();
            }
        }
    }

    /// Adds to the right-hand side of variable `i`, unless it is held.
    ///
    /// # Panics
    /// If `i` is not a variable of the system.
    pub fn add_rhs(&mut self, i: usize, rhs: &Vector6<f64>) {
        if let Some(i) = self.slots.slot_of[i] {
            self.rhs[i] += rhs;
        }
    }

    /// Adds a term of the relative motion of two variables: `information` and `rhs` of `x_j - x_i`.
    ///
    /// # Panics
    /// If `i` or `j` is not a variable of the system.
    pub fn add_relative(&mut self, i: usize, j: usize, information: &Matrix6<f64>, rhs: &Vector6<f64>) {
        self.add(i, i, information);
        self.add(j, j, information);
        self.add(i, j, &-information);
        self.add_rhs(j, rhs);
        self.add_rhs(i, &-rhs);
    }

    /// Adds another system over the same variables.
    ///
    /// # Panics
    /// If the other system has fewer free variables.
    pub fn merge(&mut self, other: Self) {
        for (slot, block) in other.diagonal.iter().enumerate() {
            self.diagonal[slot] += block;
        }
        for (slot, rhs) in other.rhs.iter().enumerate() {
            self.rhs[slot] += rhs;
        }
        for (key, block) in other.below {
            match self.below.entry(key) {
                Entry::Vacant(entry) => {
                    entry.insert(block);
                }
                Entry::Occupied(mut entry) => *entry.get_mut() += block,
            }
        }
    }

    /// How many variables are not held.
    #[must_use]
    pub fn free(&self) -> usize {
        self.slots.variable_of.len()
    }

    /// The block of row and column `variable`, or `None` for a held variable: the information on it while all others
    /// stand still.
    ///
    /// # Panics
    /// If `variable` is not a variable of the system.
    #[must_use]
    pub fn diagonal_block(&self, variable: usize) -> Option<&Matrix6<f64>> {
        self.slots.slot_of[variable].map(|slot| &self.diagonal[slot])
    }

    /// `E(0) - E(x)` that the system predicts for its own damped solution x:
    /// `b^T x + damping x^T D x` (see [`BlockSolver::solve`](super::BlockSolver::solve)).
    #[must_use]
    pub fn predicted_decrease(&self, x: &[Vector6<f64>], damping: f64) -> f64 {
        let scales = self.damping_scales();
        let terms = self.slots.variable_of.iter().zip(&self.rhs).zip(&scales);
        terms.map(|((&v, b), d)| b.dot(&x[v]) + damping * d.dot(&x[v].component_mul(&x[v]))).sum()
    }

    /// `b^T D^-1 b`: the decrease a step along the scaled gradient would bring if all numbers were independent.
    #[must_use]
    pub fn scaled_gradient(&self) -> f64 {
        self.rhs
            .iter()
            .zip(self.damping_scales())
            .map(|(b, d)| b.component_mul(b).component_div(&d).sum())
            .sum()
    }

    /// The diagonal D by which damping is scaled, a vector a free variable: H's own diagonal (Marquardt), so that
    /// damping does not depend on units, kept above a small share of the largest entry of its kind.
    pub(super) fn damping_scales(&self) -> Vec<Vector6<f64>> {
        let largest = |range: std::ops::Range<usize>| {
            let entries = self.diagonal.iter().flat_map(|m| range.clone().map(|k| m[(k, k)]));
            let largest = entries.fold(0.0, f64::max);
            if largest > 0.0 { largest } else { 1.0 }
        };
        let floors = [largest(0..3) * DAMPING_FLOOR, largest(3..6) * DAMPING_FLOOR];
        self.diagonal.iter().map(|m| Vector6::from_fn(|k, _| m[(k, k)].max(floors[k / 3]))).collect()
    }

    pub(super) fn slot(&self, variable: usize) -> Option<usize> {
        self.slots.slot_of.get(variable).copied().flatten()
    }

    pub(super) fn diagonal(&self) -> &[Matrix6<f64>] {
        &self.diagonal
    }

    pub(super) fn below(&self) -> &BTreeMap<(usize, usize), Matrix6<f64>> {
        &self.below
    }

    pub(super) fn rhs(&self) -> &[Vector6<f64>] {
        &self.rhs
    }

    /// A vector a free variable as a vector a variable, zero for the held ones.
    pub(super) fn spread(&self, free: impl Fn(usize) -> Vector6<f64>) -> Vec<Vector6<f64>> {
        self.slots.slot_of.iter().map(|slot| slot.map_or_else(Vector6::zeros, &free)).collect()
    }
}
