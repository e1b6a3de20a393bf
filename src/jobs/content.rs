//! From the engine's snapshot to what readers see.

use std::collections::HashMap;

use super::parameters::content_key;
use super::reason::{reason_of, reason_of_refusal};
use crate::cloud::ScanKey;
use crate::graph::ScanGraph;
use crate::mapping::{self, ModelSnapshot, ScanOutcome};
use crate::project::{
    Component, ContentKey, Edge, ModelContent, OpenJoin, Placement, RivalPose, Scan, ScanId, Standing, Undone,
};

/// The content of a version in the ids that clients know, scans in order of arrival.
pub(super) fn content_of(
    snapshot: &ModelSnapshot,
    by_key: &HashMap<ContentKey, Scan>,
    resolution: f64,
) -> ModelContent {
    // Of a scan that is no longer in the model nothing is told, even if its row is still there.
    let scan = |key: &ScanKey| by_key.get(&content_key(*key)).filter(|_| snapshot.scans.contains_key(key));
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
        open_joins: snapshot.open_joins.iter().filter_map(|open| open_join(open, &scan)).collect(),
        undone: snapshot.undone.iter().map(|undone| undone_of(undone, &scan)).collect(),
        ..ModelContent::default()
    }
}

fn open_join<'a>(open: &mapping::OpenJoin, scan: &impl Fn(&ScanKey) -> Option<&'a Scan>) -> Option<OpenJoin> {
    let pose = |pose: &mapping::RivalPose| RivalPose {
        a_from_b: pose.a_from_b,
        support: pose.support,
        edges: pose.edges,
        violation: pose.violation,
        inliers: pose.inliers,
    };
    Some(OpenJoin {
        scan_a: scan(&open.a)?.id,
        scan_b: scan(&open.b)?.id,
        scans_a: open.scans_a,
        scans_b: open.scans_b,
        reason: reason_of_refusal(&open.refusal),
        poses: open.poses.iter().map(pose).collect(),
    })
}

fn undone_of<'a>(undone: &mapping::Undone, scan: &impl Fn(&ScanKey) -> Option<&'a Scan>) -> Undone {
    let ids = |keys: &[ScanKey]| keys.iter().filter_map(scan).map(|s| s.id).collect();
    Undone {
        scans: ids(&undone.scans),
        evidence: ids(&undone.evidence),
        angle: undone.angle,
        distance: undone.distance,
        support_before: undone.support_before,
        support_elsewhere: undone.support_elsewhere,
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
