//! What a client decided about two scans, in the ids that clients know: the data alone cannot tell identical rooms apart.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{DecisionId, ScanId, Timestamp};
use crate::geometry::{Pose, PoseError};

/// Farther than any two scans are apart, metres.
const MAX_DISTANCE: f64 = 1e7;
/// No entry of a rotation is larger, rounding included.
const MAX_ROTATION_ENTRY: f64 = 1.001;

/// What was decided about the two scans.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(tag = "verdict", rename_all = "kebab-case")]
pub enum Verdict {
    /// They belong together at about this pose.
    Join {
        /// Maps points of scan b into scan a: metres, own frames of the scans.
        a_from_b: Pose,
    },
    /// They do not belong together: at about this pose, or, without one, in no way.
    Forbid {
        /// Maps points of scan b into scan a: metres, own frames of the scans.
        a_from_b: Option<Pose>,
    },
}

/// A decision about two scans. Each stands for the component that holds it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// One scan.
    pub scan_a: ScanId,
    /// The other.
    pub scan_b: ScanId,
    /// What holds for them.
    #[serde(flatten)]
    pub verdict: Verdict,
}

/// A decision as it is stored.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeptDecision {
    /// Its id.
    pub id: DecisionId,
    /// What was decided.
    pub decision: Decision,
    /// When.
    pub created: Timestamp,
}

/// Why a matrix is no motion between two scans.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum BadMotion {
    /// Not sixteen numbers in four rows.
    #[error("it must be four rows of four numbers: {0}")]
    Shape(String),
    /// An entry that no rotation has; products of such numbers may not even be finite.
    #[error(
        "the rotation part has the entry {0:e}; it must lie between -{MAX_ROTATION_ENTRY} and {MAX_ROTATION_ENTRY}"
    )]
    RotationEntry(f64),
    /// No scans are that far apart.
    #[error("it moves by {0:e} m along an axis; at most {MAX_DISTANCE} m are allowed")]
    TooFar(f64),
    /// See [`PoseError`].
    #[error(transparent)]
    NotRigid(#[from] PoseError),
}

impl Verdict {
    /// The pose that it is about, if any.
    #[must_use]
    pub fn a_from_b(&self) -> Option<Pose> {
        match self {
            Self::Join { a_from_b } => Some(*a_from_b),
            Self::Forbid { a_from_b } => *a_from_b,
        }
    }

    /// The word that clients use.
    #[must_use]
    pub fn word(&self) -> &'static str {
        match self {
            Self::Join { .. } => "join",
            Self::Forbid { .. } => "forbid",
        }
    }
}

impl KeptDecision {
    /// A project may hold so many, at most.
    pub const MOST: u32 = 1000;
}

/// Reads a rigid motion from JSON: a 4x4 matrix, row-major, metres.
///
/// # Errors
/// Where it is no such matrix, far from rigid, or moves farther than any scans are apart.
pub fn motion(rows: &Value) -> Result<Pose, BadMotion> {
    let rows: [[f64; 4]; 4] =
        serde_json::from_value(rows.clone()).map_err(|e| BadMotion::Shape(e.to_string()))?;
    let [[a, b, c, x], [d, e, f, y], [g, h, i, z], _] = rows;
    if let Some(entry) = [a, b, c, d, e, f, g, h, i].into_iter().find(|n| n.abs() > MAX_ROTATION_ENTRY) {
        return Err(BadMotion::RotationEntry(entry));
    }
    if let Some(far) = [x, y, z].into_iter().find(|n| n.abs() > MAX_DISTANCE) {
        return Err(BadMotion::TooFar(far));
    }
    Ok(Pose::from_rows(&rows)?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn a_motion_is_read_only_if_it_is_one() {
        let good = json!([[0, -1, 0, 2.5], [1, 0, 0, 0], [0, 0, 1, -1e6], [0, 0, 0, 1]]);
        assert_eq!(motion(&good).unwrap().translation.x, 2.5);
        let with = |row: usize, column: usize, value: f64| {
            let mut rows = good.clone();
            rows[row][column] = json!(value);
            motion(&rows).unwrap_err()
        };
        assert!(matches!(with(0, 0, 1e308), BadMotion::RotationEntry(_)));
        assert!(matches!(with(0, 3, -1e8), BadMotion::TooFar(_)));
        assert!(matches!(with(0, 0, 0.5), BadMotion::NotRigid(PoseError::NotOrthonormal(..))));
        assert!(matches!(with(2, 2, -1.0), BadMotion::NotRigid(PoseError::Mirrors(_))));
        assert!(matches!(with(3, 0, 1.0), BadMotion::NotRigid(PoseError::NotAffine)));
        for shape in [json!(1), json!([]), json!([[1, 0, 0, 0]]), json!([["1", 0, 0, 0]]), json!({ "a": 1 })]
        {
            assert!(matches!(motion(&shape), Err(BadMotion::Shape(_))), "{shape}");
        }
    }

    #[test]
    fn a_decision_survives_its_json() {
        let (scan_a, scan_b) = (ScanId::generate(), ScanId::generate());
        let a_from_b = Pose::from_translation(nalgebra::Vector3::new(1.0, 2.0, 3.0));
        for verdict in [
            Verdict::Join { a_from_b },
            Verdict::Forbid { a_from_b: None },
            Verdict::Forbid { a_from_b: Some(a_from_b) },
        ] {
            let decision = Decision { scan_a, scan_b, verdict };
            let text = serde_json::to_string(&decision).unwrap();
            assert_eq!(serde_json::from_str::<Decision>(&text).unwrap(), decision, "{text}");
        }
    }
}
