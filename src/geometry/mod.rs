//! Rigid motions, closed-form fits, robust kernels, voxel grids and the neighbour index. Uses nothing of ours.
//!
//! Conventions, said once: metres and radians; `b_from_a` maps points of frame `a` into frame `b`
//! (`x_b = R x_a + t`), products read right to left and adjacent names cancel; perturbations act on the left:
//! `exp(xi) * b_from_a` with `xi = [rotation (rad); translation (m)]`.

#[cfg(test)]
pub(crate) mod assert;
mod nearest_grid;
mod neighbors;
mod pose;
pub mod pose_text;
mod rigid_fit;
mod robust;
mod spread;
mod surroundings;
mod voxel_grid;
mod whole;

pub use nearest_grid::NearestGrid;
pub use neighbors::{Moments, NeighborIndex, Pairs};
pub use pose::{Pose, PoseError};
pub use rigid_fit::rigid_fit;
pub use robust::Kernel;
pub use spread::Spread;
pub use voxel_grid::{cell_of, occupied_voxels, voxel_centroids, voxel_groups};
pub use whole::whole;

/// A point or direction in single precision, local to its scan. Metres.
pub type Point = [f32; 3];
