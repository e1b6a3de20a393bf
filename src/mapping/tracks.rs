//! Landmarks and the keypoints that show them. A track continues when a new scan's keypoint matches one of its own, is created
//! from a match of two free keypoints, and two tracks merge when a match links them and every member stays near the common
//! landmark. A scan shows a landmark at most once.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::cloud::ScanKey;
use crate::geometry::Pose;

/// One keypoint of one scan.
pub type KeypointId = (ScanKey, u16);

/// A keypoint that shows a landmark.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct TrackObservation {
    /// Which scan.
    pub scan: ScanKey,
    /// Which of its keypoints.
    pub keypoint: u16,
    /// Where it is, metres, local frame of the scan. Track refinement may have moved it off the keypoint.
    pub point_in_scan: Vector3<f64>,
}

/// A landmark with its observations, at most one a scan, ascending by scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Landmark {
    /// Position in the component's frame, metres.
    pub position: Vector3<f64>,
    /// Who sees it.
    pub observations: Vec<TrackObservation>,
}

/// All tracks of a component.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Tracks {
    landmarks: BTreeMap<u32, Landmark>,
    by_keypoint: BTreeMap<KeypointId, u32>,
    next: u32,
}

/// What linking one match did.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Linked {
    /// A new track of two.
    Created,
    /// A track got longer.
    Continued,
    /// Two tracks became one.
    Merged,
    /// Nothing: already linked, in conflict, or too far apart.
    Refused,
}

/// `q = mean_i (R_i p_i + t_i)`: the landmark that minimises the squared distances to its observations, in closed form because
/// rotations preserve lengths.
#[must_use]
pub fn aggregate(observations: &[TrackObservation], poses: &BTreeMap<ScanKey, Pose>) -> Option<Vector3<f64>> {
    let mut sum = Vector3::zeros();
    let mut count = 0.0;
    for observation in observations {
        sum += poses.get(&observation.scan)?.transform(&observation.point_in_scan);
        count += 1.0;
    }
    (count > 0.0).then(|| sum / count)
}

/// Aggregation with outliers: every observation in turn implies a landmark; the one with most observations within `tolerance`
/// metres wins and is refitted on them. `None` when fewer than `least` agree.
///
/// All observations are tried rather than a random few: tracks are short and the result must not depend on chance.
#[must_use]
pub fn aggregate_robustly(
    observations: &[TrackObservation],
    poses: &BTreeMap<ScanKey, Pose>,
    tolerance: f64,
    least: usize,
) -> Option<Landmark> {
    let seen: Vec<(TrackObservation, Vector3<f64>)> = observations
        .iter()
        .filter_map(|o| Some((*o, poses.get(&o.scan)?.transform(&o.point_in_scan))))
        .collect();
    let near = |centre: &Vector3<f64>| -> Vec<TrackObservation> {
        seen.iter().filter(|(_, at)| (at - centre).norm() < tolerance).map(|(o, _)| *o).collect()
    };
    let mut best: Vec<TrackObservation> = Vec::new();
    for (_, implied) in &seen {
        let inliers = near(implied);
        if inliers.len() > best.len() {
            best = inliers;
        }
    }
    let refitted = near(&aggregate(&best, poses)?);
    let observations = if refitted.len() >= best.len() { refitted } else { best };
    let position = aggregate(&observations, poses)?;
    (observations.len() >= least).then_some(Landmark { position, observations })
}

impl Tracks {
    /// The landmarks, in order of creation.
    #[must_use]
    pub fn iter(&self) -> impl ExactSizeIterator<Item = &Landmark> {
        self.landmarks.values()
    }

    /// Number of landmarks.
    #[must_use]
    pub fn len(&self) -> usize {
        self.landmarks.len()
    }

    /// Whether there is no landmark.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.landmarks.is_empty()
    }

    /// Number of observations.
    #[must_use]
    pub fn observations(&self) -> usize {
        self.by_keypoint.len()
    }

    /// The landmark that a keypoint shows.
    #[must_use]
    pub fn landmark_of(&self, keypoint: KeypointId) -> Option<&Landmark> {
        self.landmarks.get(self.by_keypoint.get(&keypoint)?)
    }

    /// The identity of the landmark that a keypoint shows; stable until tracks merge.
    #[must_use]
    pub fn landmark_id_of(&self, keypoint: KeypointId) -> Option<u32> {
        self.by_keypoint.get(&keypoint).copied()
    }

    /// Links two matched keypoints of different scans: creates, continues or merges, if all stay within `tolerance` metres of the
    /// landmark.
    pub fn link(
        &mut self,
        x: TrackObservation,
        y: TrackObservation,
        poses: &BTreeMap<ScanKey, Pose>,
        tolerance: f64,
    ) -> Linked {
        let ids = [x, y].map(|o| self.by_keypoint.get(&(o.scan, o.keypoint)).copied());
        let (members, outcome) = match ids {
            [None, None] => (vec![x, y], Linked::Created),
            [Some(track), None] => (self.with_one_more(track, y), Linked::Continued),
            [None, Some(track)] => (self.with_one_more(track, x), Linked::Continued),
            [Some(one), Some(two)] if one == two => return Linked::Refused,
            [Some(one), Some(two)] => {
                let mut members = self.members(one).to_vec();
                members.extend_from_slice(self.members(two));
                (members, Linked::Merged)
            }
        };
        let Some(landmark) = consistent(members, poses, tolerance) else { return Linked::Refused };
        let id = match ids {
            [Some(one), Some(two)] => {
                self.landmarks.remove(&one.max(two));
                one.min(two)
            }
            [Some(track), None] | [None, Some(track)] => track,
            [None, None] => {
                self.next += 1;
                self.next - 1
            }
        };
        for o in &landmark.observations {
            self.by_keypoint.insert((o.scan, o.keypoint), id);
        }
        self.landmarks.insert(id, landmark);
        outcome
    }

    /// Takes a scan's observations out; tracks left with fewer than `least` observations go with them.
    pub fn remove_scan(&mut self, scan: ScanKey, poses: &BTreeMap<ScanKey, Pose>, least: usize) {
        self.rebuild(|landmark| {
            let observations: Vec<_> =
                landmark.observations.iter().filter(|o| o.scan != scan).copied().collect();
            let position = aggregate(&observations, poses)?;
            (observations.len() >= least).then_some(Landmark { position, observations })
        });
    }

    /// Aggregates every track anew at the given poses, drops observations farther than `tolerance` metres and tracks with fewer
    /// than `least` left. Returns how many observations were dropped.
    pub fn filter(&mut self, poses: &BTreeMap<ScanKey, Pose>, tolerance: f64, least: usize) -> usize {
        let before = self.observations();
        self.rebuild(|landmark| aggregate_robustly(&landmark.observations, poses, tolerance, least));
        before - self.observations()
    }

    /// The parts of the tracks that these scans see.
    #[must_use]
    pub fn restricted_to(&self, poses: &BTreeMap<ScanKey, Pose>, least: usize) -> Self {
        let mut part = self.clone();
        part.rebuild(|landmark| {
            let observations: Vec<_> =
                landmark.observations.iter().filter(|o| poses.contains_key(&o.scan)).copied().collect();
            let position = aggregate(&observations, poses)?;
            (observations.len() >= least).then_some(Landmark { position, observations })
        });
        part
    }

    /// Takes over another component's tracks; call with poses that already hold its scans.
    pub fn absorb(&mut self, other: Self, poses: &BTreeMap<ScanKey, Pose>) {
        for landmark in other.landmarks.into_values() {
            let Some(position) = aggregate(&landmark.observations, poses) else { continue };
            let id = self.next;
            self.next += 1;
            for o in &landmark.observations {
                self.by_keypoint.insert((o.scan, o.keypoint), id);
            }
            self.landmarks.insert(id, Landmark { position, observations: landmark.observations });
        }
    }

    /// Replaces every landmark by what `change` makes of it.
    pub fn rebuild(&mut self, change: impl Fn(&Landmark) -> Option<Landmark>) {
        self.landmarks = std::mem::take(&mut self.landmarks)
            .into_iter()
            .filter_map(|(id, landmark)| Some((id, change(&landmark)?)))
            .collect();
        self.by_keypoint = self
            .landmarks
            .iter()
            .flat_map(|(id, landmark)| landmark.observations.iter().map(|o| ((o.scan, o.keypoint), *id)))
            .collect();
    }

    fn members(&self, track: u32) -> &[TrackObservation] {
        self.landmarks.get(&track).map_or(&[], |l| &l.observations)
    }

    fn with_one_more(&self, track: u32, observation: TrackObservation) -> Vec<TrackObservation> {
        let mut members = self.members(track).to_vec();
        members.push(observation);
        members
    }
}

/// The landmark of these observations if each scan is there once and all lie within the tolerance.
fn consistent(
    mut observations: Vec<TrackObservation>,
    poses: &BTreeMap<ScanKey, Pose>,
    tolerance: f64,
) -> Option<Landmark> {
    observations.sort_by_key(|o| o.scan);
    if observations.windows(2).any(|w| w[0].scan == w[1].scan) {
        return None;
    }
    let position = aggregate(&observations, poses)?;
    let near = |o: &TrackObservation| {
        poses
            .get(&o.scan)
            .is_some_and(|pose| (pose.transform(&o.point_in_scan) - position).norm() < tolerance)
    };
    observations.iter().all(near).then_some(Landmark { position, observations })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn poses() -> BTreeMap<ScanKey, Pose> {
        (1..=5).map(|k| (ScanKey(k), Pose::from_translation(Vector3::new(k as f64, 0.0, 0.0)))).collect()
    }

    /// Scan k's keypoint that shows the model point (0, y, 0) with an error along x.
    fn sees(scan: u128, keypoint: u16, y: f64, error: f64) -> TrackObservation {
        TrackObservation {
            scan: ScanKey(scan),
            keypoint,
            point_in_scan: Vector3::new(-(scan as f64) + error, y, 0.0),
        }
    }

    #[test]
    fn tracks_are_created_continued_and_merged() {
        let poses = poses();
        let mut tracks = Tracks::default();
        assert_eq!(tracks.link(sees(1, 0, 0.0, 0.0), sees(2, 0, 0.0, 0.01), &poses, 0.1), Linked::Created);
        assert_eq!(
            tracks.link(sees(2, 0, 0.0, 0.01), sees(3, 4, 0.0, -0.01), &poses, 0.1),
            Linked::Continued
        );
        assert_eq!(tracks.link(sees(4, 1, 0.0, 0.0), sees(5, 1, 0.0, 0.0), &poses, 0.1), Linked::Created);
        assert_eq!(tracks.link(sees(1, 0, 0.0, 0.0), sees(5, 1, 0.0, 0.0), &poses, 0.1), Linked::Merged);
        assert_eq!((tracks.len(), tracks.observations()), (1, 5));
        assert!(tracks.landmark_of((ScanKey(3), 4)).is_some_and(|l| l.position.norm() < 1e-9));
    }

    #[test]
    fn a_scan_shows_a_landmark_at_most_once_and_far_matches_are_refused() {
        let poses = poses();
        let mut tracks = Tracks::default();
        tracks.link(sees(1, 0, 0.0, 0.0), sees(2, 0, 0.0, 0.0), &poses, 0.1);
        assert_eq!(tracks.link(sees(1, 7, 0.0, 0.0), sees(2, 0, 0.0, 0.0), &poses, 0.1), Linked::Refused);
        assert_eq!(tracks.link(sees(2, 0, 0.0, 0.0), sees(3, 0, 0.5, 0.0), &poses, 0.1), Linked::Refused);
        assert_eq!(tracks.observations(), 2);
    }

    #[test]
    fn robust_aggregation_drops_the_observation_that_disagrees() {
        let poses = poses();
        let observations =
            [sees(1, 0, 0.0, 0.0), sees(2, 0, 0.0, 0.02), sees(3, 0, 0.9, 0.0), sees(4, 0, 0.0, -0.02)];
        let landmark = aggregate_robustly(&observations, &poses, 0.1, 2).expect("three agree");
        assert_eq!(landmark.observations.len(), 3);
        assert!(landmark.position.norm() < 1e-9);
        assert_eq!(aggregate_robustly(&observations[2..3], &poses, 0.1, 2), None);
    }

    #[test]
    fn removing_a_scan_leaves_no_trace_of_it() {
        let poses = poses();
        let mut tracks = Tracks::default();
        tracks.link(sees(1, 0, 0.0, 0.0), sees(2, 0, 0.0, 0.0), &poses, 0.1);
        tracks.link(sees(2, 0, 0.0, 0.0), sees(3, 0, 0.0, 0.0), &poses, 0.1);
        tracks.link(sees(1, 9, 2.0, 0.0), sees(2, 9, 2.0, 0.0), &poses, 0.1);
        tracks.remove_scan(ScanKey(1), &poses, 2);
        assert_eq!((tracks.len(), tracks.observations()), (1, 2));
        assert_eq!(tracks.landmark_id_of((ScanKey(1), 0)), None);
    }
}
