//! What a joint dense adjustment is given: poses, surfaces, landmarks; and what may be wrong with them.

use super::super::{Correspondence, MinimiseError, Track, TrackError};
use crate::geometry::Pose;

/// Finds which points of one scan lie on which surface of another. Called from several threads.
pub trait Correspondences: Sync {
    /// Ordered pairs (i, j) of scans: points of j are sought on surfaces of i. List both orders to use both directions.
    fn pairs(&self) -> &[(usize, usize)];

    /// Correspondences of the pair at this index, at a relative pose, no further apart than `gate` metres. Must depend on
    /// nothing else.
    fn associate(&self, pair: usize, i_from_j: &Pose, gate: f64) -> Vec<Correspondence>;
}

/// What is adjusted, and by what.
#[derive(Clone, Copy)]
pub struct DenseProblem<'a, C> {
    /// `model_from_scan`, one a scan.
    pub poses: &'a [Pose],
    /// Scans that must not move, one flag a scan.
    pub held: &'a [bool],
    /// Surfaces.
    pub surfaces: &'a C,
    /// Landmarks; may be empty.
    pub tracks: &'a [Track],
}

impl<C: Correspondences> DenseProblem<'_, C> {
    /// Checks that all that is given fits together; tracks are checked by their terms.
    pub(super) fn validate(&self) -> Result<(), DenseError> {
        let scans = self.poses.len();
        if self.held.len() != scans {
            return Err(DenseError::HeldMismatch { flags: self.held.len(), poses: scans });
        }
        if let Some(scan) = self.poses.iter().position(|pose| !pose.is_finite()) {
            return Err(DenseError::PoseNotFinite { scan });
        }
        for (pair, &(i, j)) in self.surfaces.pairs().iter().enumerate() {
            if i == j || i >= scans || j >= scans {
                return Err(DenseError::BadPair { pair, i, j, scans });
            }
        }
        Ok(())
    }
}

/// Why nothing was adjusted.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum DenseError {
    /// One flag a pose is needed.
    #[error("{flags} held flags were given for {poses} poses")]
    HeldMismatch {
        /// Flags.
        flags: usize,
        /// Poses.
        poses: usize,
    },
    /// A pose has an entry that is not finite.
    #[error("the pose of scan {scan} is not finite")]
    PoseNotFinite {
        /// Its index.
        scan: usize,
    },
    /// A pair joins a scan to itself or to one that is not among the poses.
    #[error("pair {pair} joins scans {i} and {j} of {scans}")]
    BadPair {
        /// Its index.
        pair: usize,
        /// One scan.
        i: usize,
        /// The other.
        j: usize,
        /// How many there are.
        scans: usize,
    },
    /// No pair has enough correspondences in the gate, and there are no tracks.
    #[error("no two scans have {least} correspondences within {gate} m, and there are no tracks")]
    NothingInCommon {
        /// The least number.
        least: usize,
        /// Metres.
        gate: f64,
    },
    /// A track is malformed.
    #[error(transparent)]
    Track(#[from] TrackError),
    /// The minimiser failed, or was cancelled.
    #[error(transparent)]
    Minimise(#[from] MinimiseError),
}
