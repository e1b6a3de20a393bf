//! What is computed once per scan: normals, keypoints, descriptors, global signature, and the dense structures
//! (voxel index, range image) that verification reads.

mod prepared;

pub use prepared::{
    PrepareError, PrepareOptions, PreparedScan, SensorPosition, choose_resolution, extent, prepare,
};
