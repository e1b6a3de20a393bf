//! What is computed once per scan: normals, keypoints, descriptors, global signature, and the dense structures
//! (voxel index, range image) that verification reads. Uses `cloud` and `geometry`; used by `pairwise` and above.

mod color;
mod fine;
mod fpfh;
mod keypoints;
mod planes;
mod prepared;
mod range_image;
mod resolution;
mod sensor;
mod signature;
mod similarity;
mod surfel;

pub use fine::FineSurface;
pub use fpfh::{DESCRIPTOR_LEN, Descriptor, fpfh};
pub use keypoints::select_keypoints;
pub use planes::{Offsets, PlaneProfile};
pub use prepared::{PrepareError, PrepareOptions, PreparedScan, Scan, prepare};
pub use range_image::{RangeImage, Visibility};
pub use resolution::{choose_resolution, extent, natural_resolution};
pub use sensor::{SensorPosition, Stance, Surfaces, Viewpoint, viewpoint};
pub use signature::{SIGNATURE_LEN, signature};
pub use surfel::Surfel;
