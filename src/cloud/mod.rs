//! Point clouds: the type, their decoders (bytes in, points out) and encoders, normals, downsampling, pictures.

mod point_cloud;

pub use point_cloud::{PointCloud, ScanKey};
