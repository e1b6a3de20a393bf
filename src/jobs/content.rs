//! From the engine's snapshot to what readers see.

use std::collections::HashMap;

use serde_json::Value;

use super::parameters::content_key;
use crate::cloud::ScanKey;
use crate::graph::ScanGraph;
use crate::mapping::{ModelSnapshot, ScanOutcome, WaitingReason};
use crate::project::{Component, ContentKey, Edge, ModelContent, Placement, Reason, Scan, ScanId, Standing};

/// The content of a version in the ids that clients know, scans in order of arrival.
pub(super) fn content_of(
    snapshot: &ModelSnapshot,
    by_key: &HashMap<ContentKey, Scan>,
    resolution: f64,
) -> ModelContent {
    let scan = |key: &ScanKey| by_key.get(&content_key(*key));
    let in_order = |mut scans: Vec<&Scan>| -> Vec<ScanId> {
        scans.sort_by_key(|s| s.arrival);
        scans.into_iter().map(|s| s.id).collect()
    };
    let mut scans: Vec<(&Scan, Standing)> =
        snapshot.scans.iter().filter_map(|(key, outcome)| Some((scan(key)?, standing(outcome)))).collect();
    scans.sort_by_key(|(s, _)| s.arrival);
    let components = snapshot
        .components
        .iter()
        .filter_map(|c| {
            Some(Component {
                scans: in_order(c.scans.iter().filter_map(scan).collect()),
                gauge: scan(&c.gauge)?.id,
                landmarks: c.landmarks,
                observations: c.observations,
                landmark_rms: c.landmark_rms,
            })
        })
        .collect();
    ModelContent {
        resolution,
        components,
        scans: scans.into_iter().map(|(s, standing)| (s.id, standing)).collect(),
        edges: Vec::new(),
    }
}

/// The verified edges between scans of one component, in order of arrival.
pub(super) fn edges_of(
    graph: &ScanGraph,
    content: &ModelContent,
    by_key: &HashMap<ContentKey, Scan>,
) -> Vec<Edge> {
    let component: HashMap<ScanId, usize> =
        content.placed(None).map(|(scan, place)| (scan, place.component)).collect();
    let mut edges: Vec<((u64, u64), Edge)> = graph
        .edges()
        .filter_map(|edge| {
            let best = edge.hypotheses.first().filter(|h| h.score > 0.0)?;
            let mut ends = [by_key.get(&content_key(edge.pair.a))?, by_key.get(&content_key(edge.pair.b))?];
            ends.sort_by_key(|s| s.arrival);
            let [a, b] = ends;
            if component.get(&a.id)? != component.get(&b.id)? {
                return None;
            }
            let evidence = &best.hypothesis.evidence;
            let edge = Edge {
                a: a.id,
                b: b.id,
                inliers: evidence.match_inliers as usize,
                overlap: evidence.both().overlap(),
                score: best.score,
            };
            Some(((a.arrival, b.arrival), edge))
        })
        .collect();
    edges.sort_by_key(|(order, _)| *order);
    edges.into_iter().map(|(_, edge)| edge).collect()
}

fn standing(outcome: &ScanOutcome) -> Standing {
    match outcome {
        ScanOutcome::Registered(r) => Standing::Registered(Placement {
            component: r.component,
            model_from_scan: r.model_from_scan,
            landmarks: r.landmarks,
            neighbours: r.neighbours,
            landmark_rms: r.landmark_rms,
        }),
        ScanOutcome::Waiting(reason) => Standing::Waiting(reason_of(reason)),
    }
}

/// The engine's reason as a word and numbers. Its own serialisation is the word, or the word with the numbers.
fn reason_of(reason: &WaitingReason) -> Reason {
    let unknown = Reason { reason: "unknown".to_owned(), numbers: serde_json::Map::new() };
    match serde_json::to_value(reason) {
        Ok(Value::String(reason)) => Reason { reason, numbers: serde_json::Map::new() },
        Ok(Value::Object(object)) => match object.into_iter().next() {
            Some((reason, Value::Object(numbers))) => Reason { reason, numbers },
            _ => unknown,
        },
        _ => unknown,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reason_keeps_its_word_and_its_numbers() {
        let reason = reason_of(&WaitingReason::Ambiguous { best_support: 3.0, rival_support: 2.5 });
        assert_eq!(reason.reason, "ambiguous");
        assert_eq!(reason.numbers.get("rival_support"), Some(&Value::from(2.5)));
        assert_eq!(reason_of(&WaitingReason::OnlyScan).reason, "only-scan");
    }
}
