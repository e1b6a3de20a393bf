//! Point clouds: the type, their decoders (bytes in, points out) and encoders, normals, downsampling, pictures.

mod normals;
mod point_cloud;

pub use normals::{face, normals};
pub use point_cloud::{PointCloud, ScanKey};
