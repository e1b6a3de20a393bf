//! Registration recall of 3DMatch and 3DLoMatch, as the literature measures it.
//!
//! A pair (i, j) of the truth is registered when the root mean square distance of its overlapping points after the
//! estimate is at most tau, which the information matrix of the pair gives without the points (Choi, Zhou and Koltun
//! 2015): `xi^T L xi / L[0,0] <= tau^2` with `E = T_ij^-1 X_i^-1 X_j` and `xi = [t(E); vec q(E)]`, q of E's rotation
//! with w >= 0. Pairs of consecutive scans are not scored.

use std::collections::BTreeMap;

use nalgebra::Vector6;
use serde::Serialize;

use super::{Estimate, PlacedScan};
use crate::geometry::pose_text::{InfoEntry, LogEntry};

/// Registration recall of one benchmark file.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Recall {
    /// Scored pairs: those of the file whose scans are not consecutive.
    pub pairs: usize,
    /// Pairs registered within tau.
    pub registered: usize,
    /// `registered / pairs`, or `None` without pairs.
    pub recall: Option<f64>,
    /// The same without the first row of the file, as the harness behind the published multiview tables has it (it
    /// tests an index for > 0).
    pub recall_published: Option<f64>,
}

/// Why recall cannot be measured.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RecallError {
    /// The two files have different numbers of blocks.
    #[error("the log has {log} pairs, but the info file has {info}")]
    Length {
        /// Blocks of the log.
        log: usize,
        /// Blocks of the info file.
        info: usize,
    },
    /// A block is of different pairs.
    #[error("pair {row} is ({}, {}) in the log, but ({}, {}) in the info file", log.0, log.1, info.0, info.1)]
    Pair {
        /// Counted from 0.
        row: usize,
        /// i and j of the log.
        log: (u32, u32),
        /// i and j of the info file.
        info: (u32, u32),
    },
}

/// Measures the recall of `estimate` on the pairs of a benchmark; `tau_m` is 0.2 m in the literature.
///
/// Scan i of the benchmark is the one whose name holds `cloud_bin_<i>`. A pair with an unregistered scan, or
/// scans of different components, has failed.
///
/// # Errors
/// Where log and info do not list the same pairs.
pub fn recall(
    estimate: &Estimate,
    log: &[LogEntry],
    info: &[InfoEntry],
    tau_m: f64,
) -> Result<Recall, RecallError> {
    if log.len() != info.len() {
        return Err(RecallError::Length { log: log.len(), info: info.len() });
    }
    let by_index: BTreeMap<u32, &PlacedScan> = estimate
        .placed
        .iter()
        .filter_map(|(name, placed)| benchmark_index(name).map(|index| (index, placed)))
        .collect();
    let mut outcomes = Vec::with_capacity(log.len());
    for (row, (pair, weight)) in log.iter().zip(info).enumerate() {
        if (pair.i, pair.j) != (weight.i, weight.j) {
            return Err(RecallError::Pair { row, log: (pair.i, pair.j), info: (weight.i, weight.j) });
        }
        if pair.i.abs_diff(pair.j) <= 1 {
            continue;
        }
        let registered = match (by_index.get(&pair.i), by_index.get(&pair.j)) {
            (Some(i), Some(j)) if i.component == j.component => {
                let i_from_j = i.model_from_scan.inverse() * j.model_from_scan;
                let error = pair.i_from_j.inverse() * i_from_j;
                let (t, q) = (error.translation, error.quaternion());
                let xi = Vector6::new(t.x, t.y, t.z, q.i, q.j, q.k);
                let squared = xi.dot(&(weight.information * xi)) / (weight.information[(0, 0)] + 1e-6);
                squared <= tau_m * tau_m
            }
            _ => false,
        };
        outcomes.push((row, registered));
    }
    let share = |outcomes: &[(usize, bool)]| {
        let registered = outcomes.iter().filter(|(_, registered)| *registered).count();
        (!outcomes.is_empty()).then(|| registered as f64 / outcomes.len() as f64)
    };
    let without_first = match outcomes.split_first() {
        Some(((0, _), rest)) => rest,
        _ => &outcomes,
    };
    Ok(Recall {
        pairs: outcomes.len(),
        registered: outcomes.iter().filter(|(_, registered)| *registered).count(),
        recall: share(&outcomes),
        recall_published: share(without_first),
    })
}

/// The number behind `cloud_bin_` in a name.
/// In the names of the 3DMatch benchmark, all that identifies a scan.
#[must_use]
pub fn benchmark_index(name: &str) -> Option<u32> {
    name.match_indices("cloud_bin_").find_map(|(at, mark)| {
        let rest = name.get(at + mark.len()..)?;
        let digits = rest.find(|c: char| !c.is_ascii_digit()).unwrap_or(rest.len());
        rest.get(..digits)?.parse().ok()
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use nalgebra::{Matrix6, Rotation3, Vector3};

    /// Four scans a metre apart; 100 points around each pair's overlap at a metre's distance.
    fn benchmark() -> (Vec<LogEntry>, Vec<InfoEntry>) {
        let information = Matrix6::from_diagonal(&Vector6::new(100.0, 100.0, 100.0, 400.0, 400.0, 400.0));
        [(0, 2), (0, 3), (1, 2), (1, 3)]
            .into_iter()
            .map(|(i, j)| {
                let i_from_j = Pose::from_translation(Vector3::new(f64::from(j) - f64::from(i), 0.0, 0.0));
                (LogEntry { i, j, n: 4, i_from_j }, InfoEntry { i, j, information })
            })
            .unzip()
    }

    fn estimate(moved: [Vector3<f64>; 4], components: [&str; 4]) -> Estimate {
        let mut estimate = Estimate::default();
        for (index, (moved, component)) in moved.into_iter().zip(components).enumerate() {
            let at = Vector3::new(index as f64, 0.0, 0.0) + moved;
            let turned = Pose::new(Rotation3::new(Vector3::new(0.3, 0.2, -1.0)), Vector3::new(5.0, 0.0, 1.0));
            let model_from_scan = turned * Pose::from_translation(at);
            let placed = PlacedScan { model_from_scan, component: component.to_owned() };
            estimate.placed.insert(format!("x/cloud_bin_{index}.ply"), placed);
        }
        estimate
    }

    #[test]
    fn the_truth_in_any_frame_scores_all_pairs_that_are_not_consecutive() {
        let (log, info) = benchmark();
        let perfect = recall(&estimate([Vector3::zeros(); 4], ["0"; 4]), &log, &info, 0.2).unwrap();
        assert_eq!((perfect.pairs, perfect.registered), (3, 3));
        assert_eq!((perfect.recall, perfect.recall_published), (Some(1.0), Some(1.0)));
    }

    #[test]
    fn errors_beyond_tau_and_other_components_fail_and_the_published_rule_skips_the_first_row() {
        let (log, info) = benchmark();
        let mut moved = [Vector3::zeros(); 4];
        moved[2].y = 0.21;
        let one_off = recall(&estimate(moved, ["0"; 4]), &log, &info, 0.2).unwrap();
        assert_eq!((one_off.registered, one_off.recall_published), (2, Some(1.0)));
        moved[2].y = 0.19;
        assert_eq!(recall(&estimate(moved, ["0"; 4]), &log, &info, 0.2).unwrap().registered, 3);
        let split = estimate([Vector3::zeros(); 4], ["0", "0", "0", "1"]);
        assert_eq!(recall(&split, &log, &info, 0.2).unwrap().registered, 1);
        assert_eq!(recall(&Estimate::default(), &log, &info, 0.2).unwrap().recall, Some(0.0));
    }

    #[test]
    fn rotations_count_by_the_information_matrix() {
        // 400 / 100 * sin(angle / 2)^2 <= 0.2^2 holds up to 11.48 degrees.
        for (angle_deg, registered) in [(11.4f64, 3), (11.6, 2)] {
            let (log, info) = benchmark();
            let mut estimate = estimate([Vector3::zeros(); 4], ["0"; 4]);
            let scan = estimate.placed.get_mut("x/cloud_bin_2.ply").unwrap();
            let turned = Rotation3::new(Vector3::new(0.0, angle_deg.to_radians(), 0.0));
            scan.model_from_scan = scan.model_from_scan * Pose::new(turned, Vector3::zeros());
            assert_eq!(recall(&estimate, &log, &info, 0.2).unwrap().registered, registered);
        }
    }

    #[test]
    fn files_that_disagree_are_refused() {
        let (log, mut info) = benchmark();
        info.swap(1, 2);
        let error = recall(&Estimate::default(), &log, &info, 0.2).unwrap_err();
        assert_eq!(error, RecallError::Pair { row: 1, log: (0, 3), info: (1, 2) });
        info.pop();
        assert!(matches!(recall(&Estimate::default(), &log, &info, 0.2), Err(RecallError::Length { .. })));
    }
}
