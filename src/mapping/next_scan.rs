//! Next-scan selection: among the scans that could be registered, first the one that sees most of the model's landmarks, spread
//! most evenly over the scan (Schönberger, Frahm: "Structure-from-Motion Revisited", CVPR 2016, section 4.2, in 3-D).

use std::collections::BTreeSet;

use super::candidates::Candidate;
use super::component::Component;
use crate::cloud::ScanKey;
use crate::geometry::cell_of;
use crate::graph::ScanGraph;
use crate::pairwise::inlier_matches;

/// Cells of the pyramid, in voxels; a finer level weighs twice the coarser one.
const PYRAMID_VOXELS: [f32; 3] = [32.0, 16.0, 8.0];

/// The landmarks of a component that a scan sees, as far as its edges tell.
#[derive(Debug, Clone, Default)]
pub struct VisibleLandmarks {
    /// Keypoints of the scan with at least one landmark, each with the landmark's identity.
    pub keypoints: Vec<(u16, u32)>,
    /// Occupied cells of the pyramid over those keypoints: more and better spread is higher.
    pub score: usize,
}

/// Which landmarks of `component` the scan sees through the edges of its candidate pose.
#[must_use]
pub fn visible_landmarks(
    graph: &ScanGraph,
    component: &Component,
    key: ScanKey,
    candidate: &Candidate,
) -> VisibleLandmarks {
    let Some(scan) = graph.scan(key) else { return VisibleLandmarks::default() };
    let mut seen = BTreeSet::new();
    for member in &candidate.members {
        let (Some(neighbor), Some(edge)) = (graph.scan(member.in_a), graph.edge(member.in_a, key)) else {
            continue;
        };
        let forward = edge.pair.a == member.in_a;
        let (a, b) = if forward { (neighbor, scan) } else { (scan, neighbor) };
        let a_from_b = if forward { member.in_a_from_in_b } else { member.in_a_from_in_b.inverse() };
        for (in_a, in_b) in inlier_matches(a, b, &edge.matches, &a_from_b) {
            let (there, here) = if forward { (in_a, in_b) } else { (in_b, in_a) };
            if let Some(landmark) = component.tracks.landmark_id_of((member.in_a, there)) {
                seen.insert((here, landmark));
            }
        }
    }
    let mut keypoints: Vec<(u16, u32)> = seen.into_iter().collect();
    keypoints.dedup_by_key(|(keypoint, _)| *keypoint);
    let score = PYRAMID_VOXELS
        .iter()
        .enumerate()
        .map(|(level, voxels)| {
            let size = voxels * scan.prepared.resolution as f32;
            let cells: BTreeSet<[i64; 3]> = keypoints
                .iter()
                .map(|(keypoint, _)| {
                    cell_of(&scan.prepared.points[scan.prepared.keypoints[*keypoint as usize] as usize], size)
                })
                .collect();
            cells.len() << level
        })
        .sum();
    VisibleLandmarks { keypoints, score }
}
