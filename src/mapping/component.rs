//! One rigid piece of the model.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::tracks::{TrackObservation, Tracks};
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::{centred_difference, inlier_matches};

use super::options::MappingOptions;

/// Scans with poses in one frame, and the landmarks they share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Component {
    /// The scan at identity.
    pub gauge: ScanKey,
    /// `model_from_local` of every member: maps the local frame of the prepared scan into the component's frame.
    pub poses: BTreeMap<ScanKey, Pose>,
    /// Landmarks.
    pub tracks: Tracks,
}

impl Component {
    /// A scan on its own, at identity.
    #[must_use]
    pub fn single(scan: ScanKey) -> Self {
        Self { gauge: scan, poses: BTreeMap::from([(scan, Pose::identity())]), tracks: Tracks::default() }
    }

    /// Number of scans.
    #[must_use]
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Takes in another component at `self_from_other`, then links the matches of the edges between the two: tracks continue, are
    /// created and merge.
    pub fn absorb(
        &mut self,
        other: Self,
        self_from_other: &Pose,
        graph: &ScanGraph,
        options: &MappingOptions,
    ) {
        let mine: Vec<ScanKey> = self.poses.keys().copied().collect();
        let theirs: Vec<ScanKey> = other.poses.keys().copied().collect();
        for (key, other_from_local) in other.poses {
            self.poses.insert(key, (*self_from_other * other_from_local).renormalised());
        }
        self.tracks.absorb(other.tracks, &self.poses);
        for x in &theirs {
            for y in &mine {
                self.link_edge(*x, *y, graph, options);
            }
        }
    }

    /// Links the matches of one edge that agree with the component's poses. Returns how many links were made.
    pub fn link_edge(
        &mut self,
        x: ScanKey,
        y: ScanKey,
        graph: &ScanGraph,
        options: &MappingOptions,
    ) -> usize {
        let Some(edge) = graph.edge(x, y) else { return 0 };
        let (Some(a), Some(b)) = (graph.scan(edge.pair.a), graph.scan(edge.pair.b)) else { return 0 };
        let (Some(model_from_a), Some(model_from_b)) = (self.poses.get(&a.key()), self.poses.get(&b.key()))
        else {
            return 0;
        };
        let a_from_b = model_from_a.inverse() * *model_from_b;
        let voxel = a.prepared.resolution;
        let verified = edge.hypotheses.iter().any(|h| {
            let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &a_from_b, &b.centroid);
            angle < options.cluster_angle && distance < options.cluster_voxels * voxel
        });
        if !verified {
            return 0;
        }
        let tolerance = options.track_voxels * voxel;
        let mut links = 0;
        for (in_a, in_b) in inlier_matches(a, b, &edge.matches, &a_from_b) {
            let x =
                TrackObservation { scan: a.key(), keypoint: in_a, point_in_scan: a.keypoint(in_a as usize) };
            let y =
                TrackObservation { scan: b.key(), keypoint: in_b, point_in_scan: b.keypoint(in_b as usize) };
            let linked = self.tracks.link(x, y, &self.poses, tolerance);
            links += usize::from(linked != super::tracks::Linked::Refused);
        }
        links
    }

    /// Takes a scan out. If it was the gauge, the least remaining key becomes the gauge and the frame moves with it.
    pub fn remove(&mut self, scan: ScanKey, options: &MappingOptions) {
        if self.poses.remove(&scan).is_none() {
            return;
        }
        self.tracks.remove_scan(scan, &self.poses, options.track_length);
        if self.gauge == scan
            && let Some(first) = self.poses.keys().next().copied()
        {
            self.set_gauge(first);
        }
    }

    /// Takes these scans out as a component of their own, in the same frame until its gauge is set; tracks across are cut.
    #[must_use]
    pub fn split_off(&mut self, side: &BTreeSet<ScanKey>, options: &MappingOptions) -> Option<Self> {
        let (theirs, mine): (BTreeMap<_, _>, BTreeMap<_, _>) =
            std::mem::take(&mut self.poses).into_iter().partition(|(key, _)| side.contains(key));
        let tracks = std::mem::take(&mut self.tracks);
        let part = |poses: BTreeMap<ScanKey, Pose>| -> Option<Self> {
            let gauge = if poses.contains_key(&self.gauge) { self.gauge } else { *poses.keys().next()? };
            let mut part = Self { gauge, tracks: tracks.restricted_to(&poses, options.track_length), poses };
            part.set_gauge(gauge);
            Some(part)
        };
        let (mine, theirs) = (part(mine), part(theirs));
        if let Some(mine) = mine {
            *self = mine;
        }
        theirs
    }

    /// Moves the component's frame so that `gauge` is at identity.
    pub fn set_gauge(&mut self, gauge: ScanKey) {
        let Some(old_from_gauge) = self.poses.get(&gauge) else { return };
        let new_from_old = old_from_gauge.inverse();
        for pose in self.poses.values_mut() {
            *pose = (new_from_old * *pose).renormalised();
        }
        if let Some(pose) = self.poses.get_mut(&gauge) {
            *pose = Pose::identity();
        }
        self.gauge = gauge;
        let poses = &self.poses;
        self.tracks.rebuild(|landmark| {
            let position = super::tracks::aggregate(&landmark.observations, poses)?;
            Some(super::tracks::Landmark { position, observations: landmark.observations.clone() })
        });
    }

    /// Completes tracks: links the matches of every edge inside the component, most verified edges first by key order. Returns the
    /// number of links made.
    pub fn complete_tracks(&mut self, graph: &ScanGraph, options: &MappingOptions) -> usize {
        let members: Vec<ScanKey> = self.poses.keys().copied().collect();
        let mut links = 0;
        for (i, x) in members.iter().enumerate() {
            for y in &members[i + 1..] {
                links += self.link_edge(*x, *y, graph, options);
            }
        }
        links
    }
}
