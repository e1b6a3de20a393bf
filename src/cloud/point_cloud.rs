//! One scan's points, as every layer above sees them.

use serde::{Deserialize, Serialize};

use crate::geometry::Point;

/// What a scan is known by inside the core: a digest of its content. Two scans with the same content are the
/// same scan, and nothing depends on a file name or on the order of arrival.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ScanKey(pub u128);

impl ScanKey {
    /// The key of a file: the first 128 bits of the BLAKE3 hash of its bytes and of how they are read
    /// (`interpretation`: units, sensor position; empty for the defaults).
    #[must_use]
    pub fn of_hash(hash: &blake3::Hash, interpretation: &[u8]) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(hash.as_bytes());
        hasher.update(interpretation);
        let mut key = [0; 16];
        key.copy_from_slice(&hasher.finalize().as_bytes()[..16]);
        Self(u128::from_be_bytes(key))
    }
}

impl std::fmt::Display for ScanKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:032x}", self.0)
    }
}

impl std::fmt::Debug for ScanKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "ScanKey({:08x}…)", self.0 >> 96)
    }
}

/// Points of one scan, in metres, all finite.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Relative to `origin`, in the axes of the scan's own frame.
    pub points: Vec<Point>,
    /// One RGB colour a point, or empty when the file has none.
    pub colors: Vec<[u8; 3]>,
    /// Where `points` are relative to, in the scan's own frame: zero, unless the file holds coordinates so large
    /// (georeferenced ones) that single precision would lose them.
    pub origin: [f64; 3],
}

impl PointCloud {
    /// A cloud without colours at the origin of its frame.
    #[must_use]
    pub fn from_points(points: Vec<Point>) -> Self {
        Self { points, ..Self::default() }
    }

    /// Number of points.
    #[must_use]
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are no points.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }
}
