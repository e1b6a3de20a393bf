//! `poses.json` and what it says of each file.

use std::collections::BTreeMap;

use serde::Serialize;
use serde_json::{Map, Value};

use super::pipeline::Registration;
use super::source::Failure;
use crate::jobs::reason_of;
use crate::mapping::{ScanOutcome, WaitingReason};
use crate::project::Reason;

/// `poses.json`. Equal scans and settings give equal values, bit for bit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct Poses {
    /// By file name.
    pub scans: BTreeMap<String, PoseEntry>,
}

/// What became of one file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct PoseEntry {
    /// `model_from_scan`: 4x4, row-major, metres.
    pub pose: Option<[[f64; 4]; 4]>,
    /// In whose frame the pose is; 0 is the largest.
    pub component: Option<usize>,
    /// Registered, waiting or failed.
    pub status: Status,
    /// The file with the same content that was taken in its stead.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub duplicate_of: Option<String>,
    /// Why it is not registered: `reason`, a stable word, and the numbers or the `detail` behind it.
    #[serde(flatten)]
    pub why: Map<String, Value>,
}

/// How far a scan came.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(super) enum Status {
    Registered,
    Waiting,
    Failed,
}

impl Poses {
    /// Of every file.
    pub fn of(registration: &Registration) -> Self {
        let mut scans = BTreeMap::new();
        for (name, failure) in &registration.unreadable {
            scans.insert(name.clone(), PoseEntry::failed(failure));
        }
        for (key, scan) in &registration.scans {
            let entry = match (registration.unfit.get(key), registration.snapshot.scans.get(key)) {
                (Some(failure), _) => PoseEntry::failed(failure),
                (None, Some(outcome)) => PoseEntry::of(outcome),
                // The model knows every scan that was handed to it.
                (None, None) => continue,
            };
            let Some((first, others)) = scan.names.split_first() else { continue };
            for other in others {
                scans.insert(other.clone(), PoseEntry { duplicate_of: Some(first.clone()), ..entry.clone() });
            }
            scans.insert(first.clone(), entry);
        }
        Self { scans }
    }
}

impl PoseEntry {
    fn of(outcome: &ScanOutcome) -> Self {
        match outcome {
            ScanOutcome::Registered(scan) => Self {
                pose: Some(scan.model_from_scan.to_rows()),
                component: Some(scan.component),
                status: Status::Registered,
                duplicate_of: None,
                why: Map::new(),
            },
            ScanOutcome::Waiting(reason) => Self::without_pose(Status::Waiting, fields(reason)),
        }
    }

    fn failed(failure: &Failure) -> Self {
        let why = [("reason", failure.reason), ("detail", &failure.detail)];
        Self::without_pose(Status::Failed, why.map(|(k, v)| (k.to_owned(), v.into())).into_iter().collect())
    }

    fn without_pose(status: Status, why: Map<String, Value>) -> Self {
        Self { pose: None, component: None, status, duplicate_of: None, why }
    }

    /// Why it is not registered, for people.
    pub fn because(&self) -> String {
        told(&self.why)
    }
}

/// A reason with its numbers, or the detail that a failure has, for people.
pub(super) fn told(why: &Map<String, Value>) -> String {
    let text = |value: &Value| value.as_str().map_or_else(|| short(value), str::to_owned);
    let number = |name: &str| why.get(name).map_or_else(String::new, short);
    if why.get("reason").is_some_and(|word| word == "contradicted") {
        return format!(
            "contradicted ({} pairs are sure of another pose, {} were of this one; alike places were taken for one)",
            number("against"),
            number("agreeing")
        );
    }
    let others = why.iter().filter(|(name, _)| *name != "reason" && *name != "detail");
    let numbers: Vec<String> =
        others.map(|(name, v)| format!("{} {}", name.replace('_', " "), text(v))).collect();
    match (why.get("detail"), why.get("reason")) {
        (Some(detail), _) => text(detail),
        (None, Some(reason)) if numbers.is_empty() => text(reason),
        (None, Some(reason)) => format!("{} ({})", text(reason), numbers.join(", ")),
        (None, None) => String::new(),
    }
}

/// A number of three digits after the point.
fn short(value: &Value) -> String {
    match value.as_f64() {
        Some(number) if !value.is_u64() => format!("{number:.3}"),
        _ => value.to_string(),
    }
}

/// The engine's reason as fields: the word under `reason`, the numbers by their names.
fn fields(reason: &WaitingReason) -> Map<String, Value> {
    let Reason { reason, numbers: mut fields } = reason_of(reason);
    fields.insert("reason".to_owned(), reason.into());
    fields
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_waiting_scan_has_no_pose_but_a_reason_with_its_numbers() {
        let reason = WaitingReason::NoVerifiedPair { tried: 7, best_support: 0.51234, needed: 1.5 };
        let entry = PoseEntry::of(&ScanOutcome::Waiting(reason));
        let json = serde_json::to_value(&entry).unwrap();
        assert_eq!(json["pose"], Value::Null);
        assert_eq!(json["component"], Value::Null);
        assert_eq!(json["status"], "waiting");
        assert_eq!(json["reason"], "no-verified-pair");
        assert_eq!(json["tried"], 7);
        let text = entry.because();
        assert!(text.starts_with("no-verified-pair (") && text.contains("best support 0.512"), "{text}");
    }

    #[test]
    fn a_contradicted_scan_is_told_in_words() {
        let reason = WaitingReason::Contradicted { against: 5, agreeing: 3 };
        let text = PoseEntry::of(&ScanOutcome::Waiting(reason)).because();
        assert!(text.contains("5 pairs are sure of another pose, 3 were of this one"), "{text}");
    }
}
