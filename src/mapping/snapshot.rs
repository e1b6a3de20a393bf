//! A model as plain data: what a version holds, what is stored, and what readers see.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::component::Component;
use super::decision::Decisions;
use super::join::Refusal;
use super::open_join::{OpenJoin, Undone};
use crate::cloud::ScanKey;
use crate::geometry::Pose;

/// Why a scan is in no component. Stored by the order of its variants, so new ones come last.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum WaitingReason {
    /// No other scan is there yet.
    OnlyScan,
    /// No pair with another scan passed verification.
    NoVerifiedPair {
        /// Scans it was matched against.
        tried: usize,
        /// Support of the best candidate pose.
        best_support: f64,
        /// Support that a join needs.
        needed: f64,
    },
    /// Candidate poses exist, but two different ones are about equally good, or a pair is surer of the second than any of the first, or two components
    /// that do not fit each other have about as much for it.
    Ambiguous {
        /// Support of the best candidate pose, or of the place that it had.
        best_support: f64,
        /// Support of the best different pose, or in the other component.
        rival_support: f64,
    },
    /// It was placed, and then too many pairs were sure of other poses: alike places were taken for one. A decision, or a scan that
    /// tells the places apart, helps.
    Contradicted {
        /// Pairs that are sure of another pose.
        against: usize,
        /// Pairs that were sure of this one.
        agreeing: usize,
    },
    /// The best candidate pose puts surfaces where another scan saw free space.
    ViolatesFreeSpace {
        /// Violating share of the points that can be judged.
        violation: f64,
        /// Largest share allowed.
        allowed: f64,
    },
    /// There is support enough for a place, but a client's decision forbids it.
    Forbidden,
    /// What the scans of all pairs that speak for a place share is little more than three planes, which fit in many places; or one weak pair alone speaks for it, and
    /// shows no more than that.
    Indistinct {
        /// Share of the coinciding points that lie beyond the three largest planes, the most of any pair.
        beyond_planes: f64,
        /// The least share.
        needed: f64,
    },
}

/// Where a scan stands in a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ScanOutcome {
    /// In a component.
    Registered(RegisteredScan),
    /// In none.
    Waiting(WaitingReason),
}

/// A scan's place in a component, and how well it is held there.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RegisteredScan {
    /// Index into [`ModelSnapshot::components`].
    pub component: usize,
    /// Maps points of the scan's own frame (metres, file origin) into the component's model frame.
    pub model_from_scan: Pose,
    /// Landmarks that this scan observes.
    pub landmarks: usize,
    /// Other scans of the component that overlap it in a verified edge.
    pub neighbours: usize,
    /// Root mean square distance between its keypoints and their landmarks, metres.
    pub landmark_rms: f64,
}

/// One rigid piece of the model. Frames of different components are unrelated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ComponentSnapshot {
    /// Member scans, ascending by key.
    pub scans: Vec<ScanKey>,
    /// The scan at identity.
    pub gauge: ScanKey,
    /// Landmarks with at least two observations.
    pub landmarks: usize,
    /// Observations of those landmarks.
    pub observations: usize,
    /// Root mean square distance between observations and landmarks, metres.
    pub landmark_rms: f64,
    /// Poses and tracks, to go on from.
    pub(super) component: Component,
}

impl ComponentSnapshot {
    pub(super) fn of(component: &Component) -> Self {
        let mut square = 0.0;
        for landmark in component.tracks.iter() {
            for o in &landmark.observations {
                if let Some(pose) = component.poses.get(&o.scan) {
                    square += (pose.transform(&o.point_in_scan) - landmark.position).norm_squared();
                }
            }
        }
        let observations = component.tracks.observations();
        Self {
            scans: component.poses.keys().copied().collect(),
            gauge: component.gauge,
            landmarks: component.tracks.len(),
            observations,
            landmark_rms: (square / observations.max(1) as f64).sqrt(),
            component: component.clone(),
        }
    }
}

/// An immutable state of the model.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ModelSnapshot {
    /// Voxel size v, metres; 0 for an empty model.
    pub resolution: f64,
    /// Largest first.
    pub components: Vec<ComponentSnapshot>,
    /// Every scan of the model.
    pub scans: BTreeMap<ScanKey, ScanOutcome>,
    /// Joins that were not made although something speaks for them, the best supported first.
    pub open_joins: Vec<OpenJoin>,
    /// Placements that later evidence contradicted, and that this version took back.
    pub undone: Vec<Undone>,
    /// What clients decided, and this model obeys.
    pub decisions: Decisions,
    /// Why waiting scans were refused, to go on from.
    pub(super) refusals: BTreeMap<ScanKey, Refusal>,
    /// Joins since the last refinement, to go on from.
    pub(super) joins_since_refinement: usize,
}

impl ModelSnapshot {
    /// As bytes for a blob.
    pub fn to_bytes(&self) -> Result<Vec<u8>, postcard::Error> {
        postcard::to_stdvec(self)
    }

    /// From the bytes of [`ModelSnapshot::to_bytes`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, postcard::Error> {
        postcard::from_bytes(bytes)
    }
}
