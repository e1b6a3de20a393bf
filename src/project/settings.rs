//! A project and what its owner decided about it.

use crate::control::Seed;

use super::{Name, ProjectId, Timestamp, VersionNumber};

/// What the owner of a project may decide. Fixed when the project is made.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ProjectSettings {
    /// Root of every random choice: the same scans with the same seed give the same poses.
    pub seed: Seed,
    /// The voxel size from which every length scale derives, metres. `None`: from the extents of the first scans.
    pub resolution: Option<f64>,
}

/// Why settings are refused.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BadSettings {
    /// The resolution is no length a scan can have.
    #[error("the resolution is {0} m; it must lie between 0.00001 and 100 m")]
    Resolution(f64),
    /// Larger than a JSON reader keeps exactly.
    #[error("the seed is {0}; it must be at most 9007199254740991 (2^53 - 1)")]
    Seed(u64),
}

impl ProjectSettings {
    /// Checks that every number makes sense.
    pub fn validate(&self) -> Result<(), BadSettings> {
        if let Some(r) = self.resolution
            && !(1e-5..=100.0).contains(&r)
        {
            return Err(BadSettings::Resolution(r));
        }
        if self.seed.0 >= 1 << 53 {
            return Err(BadSettings::Seed(self.seed.0));
        }
        Ok(())
    }
}

/// A set of scans of one place (or several: each becomes a component) and its model.
#[derive(Debug, Clone, PartialEq)]
pub struct Project {
    /// Its id.
    pub id: ProjectId,
    /// What people call it.
    pub name: Name,
    /// What the owner decided.
    pub settings: ProjectSettings,
    /// The newest version of its model.
    pub head: VersionNumber,
    /// When it was made.
    pub created: Timestamp,
    /// Scans that were not deleted.
    pub scans: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn resolutions_that_are_no_length_are_refused() {
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 101.0] {
            let settings = ProjectSettings { resolution: Some(bad), ..Default::default() };
            assert!(matches!(settings.validate(), Err(BadSettings::Resolution(_))), "{bad}");
        }
        let settings = ProjectSettings { resolution: Some(0.05), ..Default::default() };
        assert_eq!(settings.validate(), Ok(()));
    }
}
