//! Solves block systems by sparse Cholesky, keeping the symbolic factorisation from one solve to the next.
//!
//! Uses faer, sequentially (its `rayon` feature is off), so the bits of a solution do not depend on the threads.

use faer::Mat;
use faer::linalg::solvers::Solve;
use faer::sparse::linalg::solvers::{Llt, SymbolicLlt};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMat};
use faer::{MatMut, Side};
use nalgebra::{Matrix6, Vector6};

use super::BlockSystem;

/// Why a block system has no solution.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum BlockSolverError {
    /// Some direction has no information, or an entry is not a number.
    #[error("the normal equations of {free} free poses are not positive definite")]
    NotPositiveDefinite {
        /// Variables that are not held.
        free: usize,
    },
    /// The system is too large to be factorised on this machine.
    #[error("the normal equations of {free} free poses are too large to factorise")]
    TooLarge {
        /// Variables that are not held.
        free: usize,
    },
    /// A marginal was asked of a variable that is held or does not exist.
    #[error("variable {variable} is held or unknown, so it has no covariance")]
    NotFree {
        /// Its index.
        variable: usize,
    },
}

/// A Cholesky solver that recognises the sparsity pattern of its last system.
#[derive(Debug, Default)]
pub struct BlockSolver {
    pattern: Option<Pattern>,
}

/// Rows and columns of the scalar lower triangle, and what follows from them.
#[derive(Debug)]
struct Pattern {
    blocks: usize,
    below: Vec<(usize, usize)>,
    scalars: SymbolicSparseColMat<usize>,
    factorisation: SymbolicLlt<usize>,
}

impl BlockSolver {
    /// A solver that has seen no system yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// The x with `(H + damping D) x = b`, six numbers a variable and zero for held ones; D is the diagonal of H kept
    /// above a floor. Fails where the matrix is not positive definite.
    pub fn solve(
        &mut self,
        system: &BlockSystem,
        damping: f64,
    ) -> Result<Vec<Vector6<f64>>, BlockSolverError> {
        let failed = BlockSolverError::NotPositiveDefinite { free: system.free() };
        let factor = self.factorise(system, damping)?;
        let mut x: Vec<f64> = system.rhs().iter().flatten().copied().collect();
        let rows = x.len();
        factor.solve_in_place(MatMut::from_column_major_slice_mut(&mut x, rows, 1));
        if x.iter().any(|value| !value.is_finite()) {
            return Err(failed);
        }
        Ok(system.spread(|slot| Vector6::from_column_slice(&x[6 * slot..6 * slot + 6])))
    }

    /// The marginal covariances of some free variables: the 6x6 diagonal blocks of `H^-1`, in the unit of the energy's
    /// residuals with a standard deviation of one metre; multiply by the residual variance (metres squared).
    pub fn covariances(
        &mut self,
        system: &BlockSystem,
        variables: &[usize],
    ) -> Result<Vec<Matrix6<f64>>, BlockSolverError> {
        let failed = BlockSolverError::NotPositiveDefinite { free: system.free() };
        let slots = variables
            .iter()
            .map(|&variable| system.slot(variable).ok_or(BlockSolverError::NotFree { variable }))
            .collect::<Result<Vec<_>, _>>()?;
        let factor = self.factorise(system, 0.0)?;
        let columns = slots.iter().map(|slot| {
            let mut unit = Mat::<f64>::zeros(6 * system.free(), 6);
            for k in 0..6 {
                unit[(6 * slot + k, k)] = 1.0;
            }
            factor.solve_in_place(unit.as_mut());
            let block = Matrix6::from_fn(|r, c| 0.5 * (unit[(6 * slot + r, c)] + unit[(6 * slot + c, r)]));
            if block.iter().all(|value| value.is_finite()) { Ok(block) } else { Err(failed) }
        });
        columns.collect()
    }

    fn factorise(&mut self, system: &BlockSystem, damping: f64) -> Result<Llt<usize, f64>, BlockSolverError> {
        let pattern = match self.pattern.take() {
            Some(pattern) if pattern.fits(system) => pattern,
            _ => Pattern::of(system)?,
        };
        let values = scalar_values(system, damping);
        let matrix = SparseColMatRef::new(pattern.scalars.as_ref(), &values);
        let factor = Llt::try_new_with_symbolic(pattern.factorisation.clone(), matrix, Side::Lower);
        self.pattern = Some(pattern);
        factor.map_err(|error| match error {
            faer::sparse::linalg::LltError::Numeric(_) => {
                BlockSolverError::NotPositiveDefinite { free: system.free() }
            }
            faer::sparse::linalg::LltError::Generic(_) => BlockSolverError::TooLarge { free: system.free() },
        })
    }
}

impl Pattern {
    fn fits(&self, system: &BlockSystem) -> bool {
        self.blocks == system.free() && self.below.iter().eq(system.below().keys())
    }

    fn of(system: &BlockSystem) -> Result<Self, BlockSolverError> {
        let below: Vec<(usize, usize)> = system.below().keys().copied().collect();
        let blocks = system.free();
        let mut starts = vec![0];
        let mut rows = Vec::new();
        for_each_column(blocks, &below, |column, k, blocks_below| {
            rows.extend((k..6).map(|row| 6 * column + row));
            rows.extend(blocks_below.iter().flat_map(|(_, block)| (0..6).map(move |row| 6 * block + row)));
            starts.push(rows.len());
        });
        let scalars = SymbolicSparseColMat::new_checked(6 * blocks, 6 * blocks, starts, None, rows);
        let factorisation = SymbolicLlt::try_new(scalars.as_ref(), Side::Lower)
            .map_err(|_| BlockSolverError::TooLarge { free: blocks })?;
        Ok(Self { blocks, below, scalars, factorisation })
    }
}

/// Visits the scalar columns in order: the block column, the column within it, and the blocks below its diagonal.
fn for_each_column<B>(blocks: usize, below: &[B], mut visit: impl FnMut(usize, usize, &[B]))
where
    B: BlockKey,
{
    let mut rest = below;
    for column in 0..blocks {
        let here = rest.partition_point(|block| block.column() <= column);
        for k in 0..6 {
            visit(column, k, &rest[..here]);
        }
        rest = &rest[here..];
    }
}

/// What names the column of a block.
trait BlockKey {
    fn column(&self) -> usize;
}

impl BlockKey for (usize, usize) {
    fn column(&self) -> usize {
        self.0
    }
}

impl BlockKey for (&(usize, usize), &Matrix6<f64>) {
    fn column(&self) -> usize {
        self.0.0
    }
}

/// The values of the scalar lower triangle of `H + damping D`, in the order of [`Pattern::of`].
fn scalar_values(system: &BlockSystem, damping: f64) -> Vec<f64> {
    let below: Vec<_> = system.below().iter().collect();
    let scales = system.damping_scales();
    let mut values = Vec::with_capacity(21 * system.free() + 36 * below.len());
    for_each_column(system.free(), &below, |column, k, blocks_below| {
        values.push(system.diagonal()[column][(k, k)] + damping * scales[column][k]);
        values.extend((k + 1..6).map(|row| system.diagonal()[column][(row, k)]));
        values.extend(blocks_below.iter().flat_map(|(_, block)| block.column(k).into_iter().copied()));
    });
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{DMatrix, DVector};
    use rand::RngExt;

    use crate::control::Seed;

    /// A positive definite system of a chain with one loop, and the same as a dense matrix over all variables.
    fn chain(held: &[bool]) -> (BlockSystem, DMatrix<f64>, DVector<f64>) {
        let n = held.len();
        let mut rng = Seed(3).derive("block system", 0);
        let mut system = BlockSystem::new(held);
        let mut dense = DMatrix::zeros(6 * n, 6 * n);
        let mut rhs = DVector::zeros(6 * n);
        for (i, j) in (0..n).map(|i| (i, (i + 1) % n)) {
            let a = Matrix6::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let b = Matrix6::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let r = Vector6::from_fn(|_, _| rng.random_range(-1.0..1.0));
            for (row, col, block) in [
                (i, i, a.transpose() * a + Matrix6::identity()),
                (i, j, a.transpose() * b),
                (j, j, b.transpose() * b),
            ] {
                system.add(row, col, &block);
                let mut view = dense.view_mut((6 * row, 6 * col), (6, 6));
                view += block;
                if row != col {
                    let mut view = dense.view_mut((6 * col, 6 * row), (6, 6));
                    view += block.transpose();
                }
            }
            system.add_rhs(i, &r);
            let mut view = rhs.rows_mut(6 * i, 6);
            view += r;
        }
        (system, dense, rhs)
    }

    #[test]
    fn a_solution_solves_the_dense_system() {
        let (system, dense, rhs) = chain(&[false; 7]);
        let x = BlockSolver::new().solve(&system, 0.0).unwrap();
        let x = DVector::from_iterator(42, x.iter().flatten().copied());
        assert!((dense * x - rhs).amax() < 1e-10);
    }

    #[test]
    fn held_variables_stay_at_zero_and_the_others_solve_their_rows() {
        let held = [false, true, false, false, true, false];
        let (system, dense, rhs) = chain(&held);
        let x = BlockSolver::new().solve(&system, 0.0).unwrap();
        let residual = dense * DVector::from_iterator(36, x.iter().flatten().copied()) - rhs;
        for (variable, held) in held.into_iter().enumerate() {
            if held {
                assert_eq!(x[variable], Vector6::zeros());
            } else {
                assert!(residual.rows(6 * variable, 6).amax() < 1e-10);
            }
        }
    }

    #[test]
    fn a_kept_pattern_gives_the_same_bits_as_a_new_one() {
        let (system, ..) = chain(&[false; 5]);
        let mut solver = BlockSolver::new();
        solver.solve(&system, 0.0).unwrap();
        assert_eq!(solver.solve(&system, 0.1), BlockSolver::new().solve(&system, 0.1));
        let (other, ..) = chain(&[false; 8]);
        assert_eq!(solver.solve(&other, 0.1), BlockSolver::new().solve(&other, 0.1));
    }

    #[test]
    fn covariances_are_the_blocks_of_the_inverse() {
        let (system, dense, _) = chain(&[false; 6]);
        let inverse = dense.try_inverse().unwrap();
        let covariances = BlockSolver::new().covariances(&system, &[4, 1]).unwrap();
        for (variable, covariance) in [4, 1].into_iter().zip(covariances) {
            let expected = inverse.view((6 * variable, 6 * variable), (6, 6));
            assert!((covariance - expected).amax() < 1e-9);
        }
        let (system, ..) = chain(&[false, true, false]);
        assert_eq!(
            BlockSolver::new().covariances(&system, &[1]),
            Err(BlockSolverError::NotFree { variable: 1 })
        );
    }

    #[test]
    fn systems_without_a_solution_are_errors() {
        let failed = |system: &BlockSystem| BlockSolver::new().solve(system, 0.0).unwrap_err();
        let nothing = BlockSystem::new(&[false, false]);
        assert_eq!(failed(&nothing), BlockSolverError::NotPositiveDefinite { free: 2 });
        let mut indefinite = BlockSystem::new(&[false]);
        indefinite.add(0, 0, &-Matrix6::identity());
        assert_eq!(failed(&indefinite), BlockSolverError::NotPositiveDefinite { free: 1 });
        let mut not_a_number = BlockSystem::new(&[false]);
        not_a_number.add(0, 0, &(Matrix6::identity() * f64::NAN));
        assert_eq!(failed(&not_a_number), BlockSolverError::NotPositiveDefinite { free: 1 });
    }

    #[test]
    fn a_system_in_which_all_is_held_has_the_zero_solution() {
        assert_eq!(
            BlockSolver::new().solve(&BlockSystem::new(&[true, true]), 0.0),
            Ok(vec![Vector6::zeros(); 2])
        );
    }
}
