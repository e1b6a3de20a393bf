//! Scans in one frame, as one PLY file: each is moved and written in turn, so that only one need be in memory.
//!
//! Uses [`PlyWriter`]; used by whoever exports a registered model.

use std::io::{self, Seek, Write};

use nalgebra::Vector3;

use super::{PlyWriter, PointCloud};
use crate::geometry::Pose;

/// Beyond this distance from zero single precision loses millimetres, and the file gets an offset, metres.
const FAR: f64 = 5_000.0;

/// A merged cloud being written: metres in single precision, with a colour a point.
///
/// ```
/// use cairn::cloud::{MergedPly, PointCloud};
/// use cairn::geometry::Pose;
/// let cloud = PointCloud::from_points(vec![[0.0, 0.0, 1.0]]);
/// let mut file = std::io::Cursor::new(Vec::new());
/// let mut merged = MergedPly::new(&mut file, [&Pose::identity()])?;
/// merged.append(&cloud, &Pose::identity(), [200, 80, 40])?;
/// assert_eq!(merged.finish()?, 1);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct MergedPly<W: Write + Seek> {
    ply: PlyWriter<W>,
    offset: Vector3<f64>,
}

impl<W: Write + Seek> MergedPly<W> {
    /// Begins the file. `poses` are all `model_from_scan` that will follow: where they are as far from zero as
    /// georeferenced ones, a whole number of metres is subtracted from every point and named in a comment of the header.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn new<'a>(out: W, poses: impl IntoIterator<Item = &'a Pose>) -> io::Result<Self> {
        let offset = offset(poses);
        let mut comments = vec!["made by cairn; metres".to_owned()];
        if offset != Vector3::zeros() {
            comments.push(format!("add the offset {} {} {} to every point", offset.x, offset.y, offset.z));
        }
        let comments: Vec<&str> = comments.iter().map(String::as_str).collect();
        Ok(Self { ply: PlyWriter::new(out, true, &comments)?, offset })
    }

    /// Writes all points of a scan in their own colours; those that have none are drawn in `color`.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn append(&mut self, cloud: &PointCloud, model_from_scan: &Pose, color: [u8; 3]) -> io::Result<()> {
        let origin = Vector3::from(cloud.origin);
        for (i, point) in cloud.points.iter().enumerate() {
            let in_scan = Vector3::from(*point).cast::<f64>() + origin;
            let at = (model_from_scan.transform(&in_scan) - self.offset).cast::<f32>();
            self.ply.colored_point(at.into(), cloud.colors.get(i).copied().unwrap_or(color))?;
        }
        Ok(())
    }

    /// Ends the file. Returns the number of points.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn finish(self) -> io::Result<u64> {
        self.ply.finish()
    }
}

/// The position farthest from zero, rounded, if it is far.
fn offset<'a>(poses: impl IntoIterator<Item = &'a Pose>) -> Vector3<f64> {
    let far = |far: Vector3<f64>, pose: &Pose| {
        if pose.translation.amax() > far.amax() { pose.translation } else { far }
    };
    let farthest = poses.into_iter().fold(Vector3::zeros(), far);
    if farthest.amax() > FAR { farthest.map(f64::round) } else { Vector3::zeros() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{DecodeOptions, decode};
    use crate::control::CancelToken;

    #[test]
    fn scans_of_large_coordinates_keep_their_millimetres() {
        let cloud = PointCloud {
            points: vec![[0.25, 0.5, 0.125]],
            origin: [500_000.0, 5_000_000.0, 100.0],
            ..PointCloud::default()
        };
        let pose = Pose::from_translation(Vector3::new(-400_000.0, 1.0, 2.0));
        let mut file = io::Cursor::new(Vec::new());
        let mut merged = MergedPly::new(&mut file, [&pose]).unwrap();
        merged.append(&cloud, &pose, [1, 2, 3]).unwrap();
        merged.finish().unwrap();
        let bytes = file.into_inner();
        assert!(String::from_utf8_lossy(&bytes).contains("add the offset -400000 1 2 to every point"));
        let read = decode(&mut bytes.as_slice(), &DecodeOptions::default(), &CancelToken::new()).unwrap();
        assert_eq!(read.cloud.colors, [[1, 2, 3]]);
    }
}
