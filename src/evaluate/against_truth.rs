//! Where each scan ended against where it belongs.
//!
//! Each component lies in a frame of its own. It is laid on the truth by the motion that puts most of its scans right: every
//! scan proposes one (true pose times inverse estimate), the best is refined over the scans that agree. So one wrong scan
//! does not tilt the others, as it would in a least-squares alignment.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Rotation3, Vector3};
use serde::Serialize;

use super::{Ecdf, Estimate, ecdf};
use crate::geometry::Pose;

/// How far a scan may be off and still be placed right.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Tolerance {
    /// Degrees.
    pub rotation_deg: f64,
    /// Metres.
    pub translation_m: f64,
}

impl Default for Tolerance {
    /// 5 degrees and 0.2 m, the scale of rooms.
    fn default() -> Self {
        Self { rotation_deg: 5.0, translation_m: 0.2 }
    }
}

impl Tolerance {
    pub(super) fn holds(&self, (angle_rad, distance_m): (f64, f64)) -> bool {
        angle_rad.to_degrees() < self.rotation_deg && distance_m < self.translation_m
    }
}

/// A scan that is not where the rest of its component says it should be.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WrongScan {
    /// Its name.
    pub name: String,
    /// Degrees.
    pub rotation_deg: f64,
    /// Metres.
    pub translation_m: f64,
    /// It is of another place than most of its component. If the frames of the two are unrelated, so is the error to anything.
    pub elsewhere: bool,
}

/// One component of the estimate.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ComponentReport {
    /// Its name in the estimate.
    pub component: String,
    /// Its scans that have a true pose.
    pub scans: usize,
    /// Those within the tolerance.
    pub right: usize,
    /// The others, worst first.
    pub wrong: Vec<WrongScan>,
    /// Median error of its scans, degrees.
    pub median_rotation_deg: f64,
    /// Median error of its scans, millimetres.
    pub median_translation_mm: f64,
    /// Largest error, degrees.
    pub worst_rotation_deg: f64,
    /// Largest error, millimetres.
    pub worst_translation_mm: f64,
}

/// An estimate against the truth.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TruthReport {
    /// What counts as right.
    pub tolerance: Tolerance,
    /// Scans with a true pose.
    pub scans: usize,
    /// Of those, the ones in a component with at least one other of them.
    pub registered: usize,
    /// Of those, the ones within the tolerance.
    pub right: usize,
    /// `registered - right`: wrong placements.
    pub wrong: usize,
    /// Estimated scans that the truth does not know.
    pub unknown: usize,
    /// Largest first.
    pub components: Vec<ComponentReport>,
    /// Median over all registered scans, degrees; `None` without any.
    pub median_rotation_deg: Option<f64>,
    /// Median over all registered scans, millimetres; `None` without any.
    pub median_translation_mm: Option<f64>,
    /// Relative poses of all pairs.
    pub pairs: Ecdf,
}

/// One scan with both its poses.
struct PosedTwice<'a> {
    name: &'a str,
    truth_from_scan: Pose,
    place: &'a str,
    model_from_scan: Pose,
}

/// Compares an estimate with true poses. The components of the truth are places of their own: in a component of the estimate, the scans
/// of all places but one are wrong. Scans alone in their component say nothing and count as not registered.
#[must_use]
pub fn against_truth(estimate: &Estimate, truth: &Estimate, tolerance: Tolerance) -> TruthReport {
    let mut by_component: BTreeMap<&str, Vec<PosedTwice<'_>>> = BTreeMap::new();
    for (name, scan) in &truth.placed {
        if let Some(placed) = estimate.find(name) {
            by_component.entry(&placed.component).or_default().push(PosedTwice {
                name,
                truth_from_scan: scan.model_from_scan,
                place: &scan.component,
                model_from_scan: placed.model_from_scan,
            });
        }
    }
    let (mut components, mut errors) = (Vec::new(), Vec::new());
    for (component, scans) in by_component.iter().filter(|(_, scans)| scans.len() > 1) {
        let laid = align(scans, tolerance);
        let of_scans: Vec<(f64, f64)> = scans.iter().map(|scan| scan.error(&laid.truth_from_model)).collect();
        components.push(component_report(component, scans, &of_scans, laid.place, tolerance));
        errors.extend(of_scans);
    }
    components.sort_by(|a, b| b.scans.cmp(&a.scans).then_with(|| a.component.cmp(&b.component)));
    let right = components.iter().map(|c| c.right).sum();
    TruthReport {
        tolerance,
        scans: truth.placed.len(),
        registered: errors.len(),
        right,
        wrong: errors.len() - right,
        unknown: estimate.placed.keys().filter(|name| truth.find(name).is_none()).count(),
        components,
        median_rotation_deg: median(errors.iter().map(|e| e.0.to_degrees())),
        median_translation_mm: median(errors.iter().map(|e| e.1 * 1e3)),
        pairs: ecdf(estimate, truth),
    }
}

impl PosedTwice<'_> {
    /// Radians and metres; the distance is that of the two sensor positions.
    fn error(&self, truth_from_model: &Pose) -> (f64, f64) {
        self.truth_from_scan.difference(&(*truth_from_model * self.model_from_scan))
    }
}

/// A component laid on a place of the truth.
struct Laid<'a> {
    truth_from_model: Pose,
    place: &'a str,
}

/// The motion that lays most scans of a component on the truth of one place.
fn align<'a>(scans: &[PosedTwice<'a>], tolerance: Tolerance) -> Laid<'a> {
    // More right scans first; among equals, the smaller error of the right ones in units of the tolerance.
    let score = |truth_from_model: &Pose, place: &str| {
        let (mut right, mut off) = (0usize, 0.0);
        for scan in scans.iter().filter(|scan| scan.place == place) {
            let error = scan.error(truth_from_model);
            if tolerance.holds(error) {
                right += 1;
                off += error.0.to_degrees() / tolerance.rotation_deg + error.1 / tolerance.translation_m;
            }
        }
        (right, -off)
    };
    let mut best = Pose::identity();
    let mut place = "";
    let mut best_score = (0, f64::NEG_INFINITY);
    for scan in scans {
        let proposal = scan.truth_from_scan * scan.model_from_scan.inverse();
        let proposed = score(&proposal, scan.place);
        if proposed.0 > best_score.0 || (proposed.0 == best_score.0 && proposed.1 > best_score.1) {
            (best, place, best_score) = (proposal, scan.place, proposed);
        }
    }
    let of_place = || scans.iter().filter(|scan| scan.place == place);
    for _ in 0..5 {
        let refined = mean_motion(of_place().filter(|scan| tolerance.holds(scan.error(&best))));
        let Some((refined, refined_score)) = refined.map(|refined| (refined, score(&refined, place))) else {
            break;
        };
        if refined_score.0 < best_score.0 || refined_score == best_score {
            break;
        }
        (best, best_score) = (refined, refined_score);
    }
    Laid { truth_from_model: best, place }
}

/// The chordal mean of the rotations that take estimate to truth, and the translation that fits best under it.
fn mean_motion<'a>(scans: impl Iterator<Item = &'a PosedTwice<'a>> + Clone) -> Option<Pose> {
    let count = scans.clone().count() as f64;
    let sum: Matrix3<f64> = scans
        .clone()
        .map(|s| (s.truth_from_scan.rotation * s.model_from_scan.rotation.inverse()).into_inner())
        .sum();
    let svd = sum.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let proper = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = Rotation3::from_matrix_unchecked(u * proper * v_t);
    let shift: Vector3<f64> =
        scans.map(|s| s.truth_from_scan.translation - rotation * s.model_from_scan.translation).sum();
    (count > 0.0).then(|| Pose::new(rotation, shift / count))
}

fn component_report(
    component: &str,
    scans: &[PosedTwice<'_>],
    errors: &[(f64, f64)],
    place: &str,
    tolerance: Tolerance,
) -> ComponentReport {
    let mut wrong: Vec<WrongScan> = scans
        .iter()
        .zip(errors)
        .filter(|(scan, error)| scan.place != place || !tolerance.holds(**error))
        .map(|(scan, error)| WrongScan {
            name: scan.name.to_owned(),
            rotation_deg: error.0.to_degrees(),
            translation_m: error.1,
            elsewhere: scan.place != place,
        })
        .collect();
    wrong.sort_by(|a, b| b.translation_m.total_cmp(&a.translation_m).then_with(|| a.name.cmp(&b.name)));
    let rotation = || errors.iter().map(|e| e.0.to_degrees());
    let translation = || errors.iter().map(|e| e.1 * 1e3);
    ComponentReport {
        component: component.to_owned(),
        scans: scans.len(),
        right: scans.len() - wrong.len(),
        wrong,
        median_rotation_deg: median(rotation()).unwrap_or_default(),
        median_translation_mm: median(translation()).unwrap_or_default(),
        worst_rotation_deg: rotation().fold(0.0, f64::max),
        worst_translation_mm: translation().fold(0.0, f64::max),
    }
}

/// The middle value; the mean of the two middle ones of an even number.
pub(super) fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let upper = *values.get(values.len() / 2)?;
    let lower = *values.get((values.len() - 1) / 2)?;
    Some(f64::midpoint(lower, upper))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluate::PlacedScan;

    fn truth() -> Estimate {
        let mut truth = Estimate::default();
        for index in 0..7 {
            let turn = Rotation3::new(Vector3::new(0.1, 0.7, -0.2) * f64::from(index));
            let model_from_scan = Pose::new(turn, Vector3::new(f64::from(index), 0.5, -f64::from(index % 3)));
            let placed = PlacedScan { model_from_scan, component: "0".to_owned() };
            truth.placed.insert(format!("s{index}.ply"), placed);
        }
        truth
    }

    /// The truth in another frame.
    fn moved(mut estimate: Estimate) -> Estimate {
        let frame = Pose::new(Rotation3::new(Vector3::new(2.0, -0.4, 0.3)), Vector3::new(30.0, -4.0, 2.0));
        for scan in estimate.placed.values_mut() {
            scan.model_from_scan = frame * scan.model_from_scan;
        }
        estimate
    }

    #[test]
    fn the_truth_in_another_frame_is_all_right() {
        let report = against_truth(&moved(truth()), &truth(), Tolerance::default());
        assert_eq!((report.scans, report.registered, report.right, report.wrong), (7, 7, 7, 0));
        assert!(report.median_translation_mm.unwrap() < 1e-6 && report.median_rotation_deg.unwrap() < 1e-6);
        assert!(report.pairs.translation_m.iter().all(|step| step.share == 1.0));
    }

    #[test]
    fn wrong_scans_are_named_and_do_not_tilt_the_others() {
        let mut estimate = moved(truth());
        for name in ["s2.ply", "s5.ply"] {
            let scan = estimate.placed.get_mut(name).unwrap();
            scan.model_from_scan.translation.x += if name == "s2.ply" { 3.0 } else { 1.0 };
        }
        let report = against_truth(&estimate, &truth(), Tolerance::default());
        assert_eq!((report.registered, report.right, report.wrong), (7, 5, 2));
        let wrong = &report.components[0].wrong;
        assert_eq!((wrong[0].name.as_str(), wrong[1].name.as_str()), ("s2.ply", "s5.ply"));
        assert!((wrong[0].translation_m - 3.0).abs() < 1e-9, "{wrong:?}");
        assert!(report.median_translation_mm.unwrap() < 1e-6);
    }

    #[test]
    fn components_are_aligned_apart_and_single_scans_say_nothing() {
        let mut estimate = truth();
        for (index, scan) in estimate.placed.values_mut().enumerate() {
            scan.component = if index < 4 {
                "a"
            } else if index < 6 {
                "b"
            } else {
                "c"
            }
            .to_owned();
        }
        let mut estimate = moved(estimate);
        estimate.placed.get_mut("s4.ply").unwrap().model_from_scan.translation.z += 0.05;
        estimate.placed.insert("stranger.ply".to_owned(), estimate.placed["s0.ply"].clone());
        let report = against_truth(&estimate, &truth(), Tolerance::default());
        assert_eq!((report.registered, report.right, report.unknown), (6, 6, 1));
        assert_eq!(report.components.iter().map(|c| c.scans).collect::<Vec<_>>(), [4, 2]);
        // Two scans 50 mm apart from the truth share the error.
        assert!((report.components[1].worst_translation_mm - 25.0).abs() < 1.0, "{:?}", report.components[1]);
    }

    #[test]
    fn scans_of_another_place_are_wrong_wherever_they_are_put() {
        let mut places = truth();
        for name in ["s0.ply", "s6.ply"] {
            places.placed.get_mut(name).unwrap().component = "next door".to_owned();
        }
        let report = against_truth(&moved(truth()), &places, Tolerance::default());
        assert_eq!((report.registered, report.right, report.wrong), (7, 5, 2));
        assert!(report.components[0].wrong.iter().all(|wrong| wrong.elsewhere), "{report:?}");
        assert_eq!((report.pairs.pairs, report.pairs.connected), (11, 11));
    }

    #[test]
    fn nothing_registered_is_a_report_too() {
        let report = against_truth(&Estimate::default(), &truth(), Tolerance::default());
        assert_eq!((report.scans, report.registered, report.median_rotation_deg), (7, 0, None));
    }
}
