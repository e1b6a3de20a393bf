//! Settings of the mapper. Lengths are in voxels of the prepared scans, angles in radians, supports in log-odds summed over
//! agreeing edges.

use serde::{Deserialize, Serialize};

use super::decision::Decisions;
use crate::control::Seed;
use crate::graph::SupportOptions;

/// What a join must show. Tried from the strictest down; after every join the strictest comes first again.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct JoinLevel {
    /// Least support, after half of the runner-up's is taken off; at the strictest level, of pairs that do not speak against the pose by themselves.
    pub support: f64,
    /// Largest share of violations of free space among the points that can be judged.
    pub violation: f64,
    /// Fewest agreeing matches of an initial pair.
    pub initial_matches: usize,
}

/// Settings of the mapper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct MappingOptions {
    /// Root of the random choices.
    pub seed: Seed,
    /// How pairs are judged. Not stored: a stored project keeps to the shipped verifier.
    #[serde(skip)]
    pub support: SupportOptions,
    /// Pairs retrieved for each scan.
    pub retrieved: usize,
    /// Rounds of widening for scans and components that stay apart, each trying as many pairs again.
    pub widening_rounds: usize,
    /// From strict to lenient. Below the last, scans wait.
    pub levels: Vec<JoinLevel>,
    /// What holds together by less than this is taken apart and decided anew when scans arrive.
    pub firm_support: f64,
    /// Least support for joining two pieces of several scans each.
    pub least_large_support: f64,
    /// Share of the runner-up's support taken off a candidate's.
    pub rival_share: f64,
    /// Two components may violate each other's free space by this many times the share by which they violate their own …
    pub violation_contrast: f64,
    /// … and this share more.
    pub violation_floor: f64,
    /// Candidate poses agree within this angle …
    pub cluster_angle: f64,
    /// … and this distance at the moved scan's centroid.
    pub cluster_voxels: f64,
    /// Candidate poses are rivals beyond this angle …
    pub rival_angle: f64,
    /// … or this distance.
    pub rival_voxels: f64,
    /// Largest distance between an observation and its landmark.
    pub track_voxels: f64,
    /// Observations of a landmark, at least.
    pub track_length: usize,
    /// Most covisible neighbours that move with a new scan in local bundle adjustment.
    pub local_neighbors: usize,
    /// The model is refined when it has grown by this share …
    pub refine_growth: f64,
    /// … and by at least this many joins.
    pub refine_joins: usize,
    /// What clients decided; every join obeys.
    pub decisions: Decisions,
}

impl MappingOptions {
    /// Whether a level asks as much as any.
    #[must_use]
    pub fn is_strictest(&self, level: &JoinLevel) -> bool {
        level.support >= self.most_support()
    }

    /// The most support that any level asks.
    #[must_use]
    pub fn most_support(&self) -> f64 {
        self.levels.iter().map(|level| level.support).fold(0.0, f64::max)
    }

    /// Whether a join of pieces of so many scans must rest on more than one edge: what two pieces of several scans share in one pair alone is
    /// easily a coincidence.
    #[must_use]
    pub fn asks_for_several(&self, a: usize, b: usize, level: &JoinLevel) -> bool {
        a > 1 && b > 1 && !self.is_strictest(level)
    }

    /// The strictest level alone.
    #[must_use]
    pub fn strictest_level(&self) -> &[JoinLevel] {
        &self.levels[..self.levels.len().min(1)]
    }

    /// The levels at which joins are firm: what they put together needs no second thought.
    #[must_use]
    pub fn firm_levels(&self) -> &[JoinLevel] {
        let firm = self.levels.iter().take_while(|level| level.support >= self.firm_support).count();
        &self.levels[..firm]
    }
}

impl Default for MappingOptions {
    fn default() -> Self {
        let level = |support, violation, initial_matches| JoinLevel { support, violation, initial_matches };
        Self {
            seed: Seed(0),
            support: SupportOptions::default(),
            retrieved: 14,
            widening_rounds: 6,
            levels: vec![
                level(8.0, 0.08, 100),
                level(4.0, 0.1, 50),
                level(2.5, 0.15, 25),
                level(1.5, 0.2, 12),
            ],
            firm_support: 4.0,
            least_large_support: 2.5,
            rival_share: 0.5,
            violation_contrast: 3.0,
            violation_floor: 0.01,
            cluster_angle: 9.0_f64.to_radians(),
            cluster_voxels: 5.0,
            rival_angle: 14.0_f64.to_radians(),
            rival_voxels: 7.0,
            track_voxels: 2.0,
            track_length: 2,
            local_neighbors: 5,
            refine_growth: 0.1,
            refine_joins: 4,
            decisions: Decisions::default(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::graph::evidence;

    #[test]
    fn one_sure_pair_makes_a_firm_join_and_two_one_of_the_strictest_level() {
        let options = MappingOptions::default();
        let sure = evidence(50.0);
        assert!((sure - options.firm_support).abs() < 1e-12);
        assert!((2.0 * sure - options.strictest_level()[0].support).abs() < 1e-12);
        assert!(evidence(0.0) < evidence(2.0) && evidence(2.0) < sure && evidence(-9.0) >= 0.0);
    }
}
