//! Point clouds: the type, their decoders (bytes in, points out) and encoders, normals, downsampling, pictures.

mod decode;
mod encode;
mod merged;
mod normals;
mod point_cloud;
mod preview;

pub use decode::{DecodeError, DecodeOptions, Decoded, Format, decode, metres_per_unit, sniff};
pub use encode::PlyWriter;
pub use merged::MergedPly;
pub use normals::{face, normals};
pub use point_cloud::{PointCloud, ScanKey};
pub use preview::{
    Image, ImageError, PartColor, PreviewOptions, PreviewPart, PreviewScan, render, scan_color,
};
