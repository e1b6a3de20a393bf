//! Cumulative error curves over all pairs of scans: how many relative poses are within each threshold.

use serde::Serialize;

use super::Estimate;
use super::against_truth::median;

/// Rotation thresholds of the literature, degrees.
pub const ROTATION_STEPS_DEG: [f64; 5] = [3.0, 5.0, 10.0, 30.0, 45.0];

/// Translation thresholds of the literature, metres.
pub const TRANSLATION_STEPS_M: [f64; 5] = [0.05, 0.1, 0.25, 0.5, 0.75];

/// One point of a curve.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EcdfStep {
    /// Degrees or metres.
    pub threshold: f64,
    /// Share of all pairs whose error is below it.
    pub share: f64,
}

/// The curves of an estimate.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Ecdf {
    /// All pairs of scans with true poses in one frame.
    pub pairs: usize,
    /// Pairs of which both scans are registered, in one component. The others count as failed at every threshold.
    pub connected: usize,
    /// At [`ROTATION_STEPS_DEG`].
    pub rotation_deg: Vec<EcdfStep>,
    /// At [`TRANSLATION_STEPS_M`].
    pub translation_m: Vec<EcdfStep>,
    /// Mean over connected pairs, degrees; `None` without any.
    pub mean_rotation_deg: Option<f64>,
    /// Median over connected pairs, degrees.
    pub median_rotation_deg: Option<f64>,
    /// Mean over connected pairs, metres.
    pub mean_translation_m: Option<f64>,
    /// Median over connected pairs, metres.
    pub median_translation_m: Option<f64>,
}

/// Compares the relative poses of all pairs of scans of one component of the truth: the angle of `(T_i^-1 T_j)^-1 (X_i^-1 X_j)`, and the distance of the
/// two translations, metres.
#[must_use]
pub fn ecdf(estimate: &Estimate, truth: &Estimate) -> Ecdf {
    let scans: Vec<_> = truth.placed.iter().map(|(name, scan)| (scan, estimate.find(name))).collect();
    let (mut pairs, mut errors) = (0, Vec::new());
    for (index, (true_i, estimated_i)) in scans.iter().enumerate() {
        for (true_j, estimated_j) in scans.iter().skip(index + 1) {
            if true_i.component != true_j.component {
                continue;
            }
            pairs += 1;
            let Some(estimated_i) = estimated_i else { continue };
            let Some(estimated_j) = estimated_j.filter(|j| j.component == estimated_i.component) else {
                continue;
            };
            let true_i_from_j = true_i.model_from_scan.inverse() * true_j.model_from_scan;
            let i_from_j = estimated_i.model_from_scan.inverse() * estimated_j.model_from_scan;
            errors.push(true_i_from_j.difference(&i_from_j));
        }
    }
    let curve = |steps: &[f64], error: &dyn Fn(&(f64, f64)) -> f64| {
        let below = |threshold: f64| errors.iter().filter(|e| error(e) < threshold).count() as f64;
        let share = |threshold| if pairs == 0 { 0.0 } else { below(threshold) / pairs as f64 };
        steps.iter().map(|&threshold| EcdfStep { threshold, share: share(threshold) }).collect()
    };
    Ecdf {
        pairs,
        connected: errors.len(),
        rotation_deg: curve(&ROTATION_STEPS_DEG, &|e| e.0.to_degrees()),
        translation_m: curve(&TRANSLATION_STEPS_M, &|e| e.1),
        mean_rotation_deg: mean(errors.iter().map(|e| e.0.to_degrees())),
        median_rotation_deg: median(errors.iter().map(|e| e.0.to_degrees())),
        mean_translation_m: mean(errors.iter().map(|e| e.1)),
        median_translation_m: median(errors.iter().map(|e| e.1)),
    }
}

fn mean(values: impl ExactSizeIterator<Item = f64>) -> Option<f64> {
    let count = values.len();
    (count > 0).then(|| values.sum::<f64>() / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::PlacedScan;
    use crate::geometry::Pose;
    use nalgebra::{Rotation3, Vector3};

    fn scans(poses: &[Pose; 3], components: [&str; 3]) -> Estimate {
        let mut estimate = Estimate::default();
        for ((name, model_from_scan), component) in ["a", "b", "c"].into_iter().zip(poses).zip(components) {
            let placed = PlacedScan { model_from_scan: *model_from_scan, component: component.to_owned() };
            estimate.placed.insert(name.to_owned(), placed);
        }
        estimate
    }

    fn shares(steps: &[EcdfStep]) -> Vec<f64> {
        steps.iter().map(|step| (step.share * 3.0).round()).collect()
    }

    #[test]
    fn pairs_are_counted_below_each_threshold_and_unconnected_ones_fail() {
        let truth = scans(&[Pose::identity(); 3], ["0"; 3]);
        let moved = Pose::new(Rotation3::new(Vector3::z() * 4f64.to_radians()), Vector3::new(0.0, 0.3, 0.0));
        let estimate = scans(&[Pose::identity(), Pose::identity(), moved], ["0"; 3]);
        let curves = ecdf(&estimate, &truth);
        assert_eq!((curves.pairs, curves.connected), (3, 3));
        assert_eq!(shares(&curves.rotation_deg), [1.0, 3.0, 3.0, 3.0, 3.0]);
        assert_eq!(shares(&curves.translation_m), [1.0, 1.0, 1.0, 3.0, 3.0]);
        let mut split = scans(&[Pose::identity(), Pose::identity(), moved], ["0", "1", "0"]);
        assert_eq!(shares(&ecdf(&split, &truth).rotation_deg), [0.0, 1.0, 1.0, 1.0, 1.0]);
        split.placed.remove("c");
        assert_eq!(ecdf(&split, &truth).connected, 0);
        assert_eq!(ecdf(&split, &Estimate::default()).pairs, 0);
    }
}
