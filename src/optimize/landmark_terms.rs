//! The energy of landmarks seen by several scans, `sum_j sum_i w_ij rho(|R_i p_ij + t_i - q_j|^2)`, with the landmarks
//! `q_j` eliminated exactly. Used by the bundle adjustment and, beside the surfaces, by the dense adjustment.
//!
//! Landmark Hessians are multiples of the identity, `W_j = sum_i w_ij rho'`, so the Schur complement needs no inverse:
//! with `e_i = p'_i - mean(p')` and `J_i = [-[p'_i]x, I]`, `H_ik += w_i (d_ik - w_k / W) J_i^T J_k`, `b_i -= w_i J_i^T e_i`.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

use super::BlockSystem;
use super::chunks::map_parts;
use super::twist::{quarters, skew, twist};
use crate::geometry::{Kernel, Pose};

/// A keypoint of a scan that shows a landmark.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// Index of the scan among the poses.
    pub scan: usize,
    /// The keypoint in the frame of its scan, metres.
    pub point_in_scan: Vector3<f64>,
    /// How much it counts, at least zero.
    pub weight: f64,
}

/// The observations of one landmark.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Track {
    /// At least one.
    pub observations: Vec<Observation>,
    /// The landmark in the model frame (metres) if it must not move, as the long tracks of a local adjustment.
    pub held_landmark: Option<Vector3<f64>>,
}

/// What is wrong with a track.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum TrackError {
    /// No observation.
    #[error("track {track} has no observation")]
    Empty {
        /// Its index.
        track: usize,
    },
    /// An observation of a scan that is not among the poses.
    #[error("track {track} observes scan {scan}, but there are {scans} poses")]
    UnknownScan {
        /// Its index.
        track: usize,
        /// The scan it names.
        scan: usize,
        /// How many there are.
        scans: usize,
    },
    /// A coordinate or weight is not finite, or a weight is negative.
    #[error("track {track} has a coordinate or weight that is negative or not finite")]
    NotFinite {
        /// Its index.
        track: usize,
    },
}

/// Rounds of reweighting when a landmark is placed anew; each lowers its cost.
const PLACING_ROUNDS: usize = 4;

/// All landmark terms of an adjustment.
#[derive(Debug, Clone, Copy)]
pub(super) struct LandmarkTerms<'a> {
    pub tracks: &'a [Track],
    pub kernel: Kernel,
    /// Multiplies every weight.
    pub factor: f64,
}

impl LandmarkTerms<'_> {
    /// Checks every track once, so that the arithmetic may trust them.
    pub(super) fn validate(&self, scans: usize) -> Result<(), TrackError> {
        for (track, data) in self.tracks.iter().enumerate() {
            if data.observations.is_empty() {
                return Err(TrackError::Empty { track });
            }
            if data.held_landmark.is_some_and(|q| !q.iter().all(|x| x.is_finite())) {
                return Err(TrackError::NotFinite { track });
            }
            for o in &data.observations {
                if o.scan >= scans {
                    return Err(TrackError::UnknownScan { track, scan: o.scan, scans });
                }
                let finite = o.point_in_scan.iter().all(|x| x.is_finite()) && o.weight.is_finite();
                if !finite || o.weight < 0.0 {
                    return Err(TrackError::NotFinite { track });
                }
            }
        }
        Ok(())
    }

    /// Pairs of scans that share a landmark: enough of them to tell what is connected.
    pub(super) fn links(&self) -> impl Iterator<Item = (usize, usize)> {
        let moving = self.tracks.iter().filter(|track| track.held_landmark.is_none());
        moving.flat_map(|track| track.observations.windows(2).map(|two| (two[0].scan, two[1].scan)))
    }

    /// Scans that see a landmark which must not move.
    pub(super) fn tied(&self) -> impl Iterator<Item = usize> {
        let held = self.tracks.iter().filter(|track| track.held_landmark.is_some());
        held.flat_map(|track| track.observations.iter().map(|o| o.scan))
    }

    /// The RMS distance of keypoints from the origins of their scans, metres; 1 if there is none.
    pub(super) fn length(&self) -> f64 {
        let all = self.tracks.iter().flat_map(|track| &track.observations);
        let (sum, count) = all.fold((0.0, 0.0), |(s, n), o| (s + o.point_in_scan.norm_squared(), n + 1.0));
        if sum > 0.0 { f64::sqrt(sum / count) } else { 1.0 }
    }

    /// Landmarks from nothing but the poses: of the positions that single observations imply, and their mean, the one
    /// with the least cost, polished by reweighting.
    pub(super) fn place(&self, poses: &[Pose]) -> Vec<Vector3<f64>> {
        self.for_each_track(|track, _| {
            let points = points_in_model(track, poses);
            let mean = weighted_mean(track, &points, |_| 1.0).unwrap_or(points[0]);
            if self.kernel == Kernel::Squared {
                return mean;
            }
            let implied = std::iter::once(mean).chain(points.iter().copied());
            let costed = implied.map(|q| (self.track_cost(track, &points, &q), q));
            let (_, best) = costed.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, mean));
            (0..PLACING_ROUNDS).fold(best, |q, _| self.reweighted(track, &points, &q))
        })
    }

    /// Landmarks after the poses moved: the minimiser for the weights before the move, then one reweighting.
    pub(super) fn follow(
        &self,
        before: &[Pose],
        after: &[Pose],
        landmarks: &[Vector3<f64>],
    ) -> Vec<Vector3<f64>> {
        self.for_each_track(|track, j| {
            let (old, new) = (points_in_model(track, before), points_in_model(track, after));
            let weight = |k: usize| self.kernel.weight((old[k] - landmarks[j]).norm_squared());
            let moved = weighted_mean(track, &new, weight).unwrap_or(landmarks[j]);
            if self.kernel == Kernel::Squared { moved } else { self.reweighted(track, &new, &moved) }
        })
    }

    /// The energy, metres squared.
    pub(super) fn cost(&self, poses: &[Pose], landmarks: &[Vector3<f64>]) -> f64 {
        let parts = map_parts(self.tracks.len(), |range| {
            let terms = range.map(|j| {
                self.track_cost(&self.tracks[j], &points_in_model(&self.tracks[j], poses), &landmarks[j])
            });
            terms.sum::<f64>()
        });
        parts.into_iter().sum::<f64>() * self.factor
    }

    /// Adds the reduced normal equations to a system, in which held scans have no row.
    pub(super) fn linearise(&self, poses: &[Pose], landmarks: &[Vector3<f64>], system: &mut BlockSystem) {
        let empty = system.empty_like();
        let parts = map_parts(self.tracks.len(), |range| {
            let mut part = empty.clone();
            for j in range {
                self.linearise_track(&self.tracks[j], poses, &landmarks[j], &mut part);
            }
            part
        });
        for part in parts {
            system.merge(part);
        }
    }

    /// The plain RMS distance of a track's observations from its landmark, metres.
    pub(super) fn rms(&self, poses: &[Pose], landmarks: &[Vector3<f64>]) -> Vec<f64> {
        self.for_each_track(|track, j| {
            let points = points_in_model(track, poses);
            let sum: f64 = points.iter().map(|p| (p - landmarks[j]).norm_squared()).sum();
            (sum / points.len() as f64).sqrt()
        })
    }

    fn for_each_track<T: Send>(&self, f: impl Fn(&Track, usize) -> T + Sync) -> Vec<T> {
        let parts =
            map_parts(self.tracks.len(), |range| range.map(|j| f(&self.tracks[j], j)).collect::<Vec<_>>());
        parts.into_iter().flatten().collect()
    }

    fn track_cost(&self, track: &Track, points: &[Vector3<f64>], q: &Vector3<f64>) -> f64 {
        let terms = track.observations.iter().zip(points);
        terms.map(|(o, p)| o.weight * self.kernel.rho((p - q).norm_squared())).sum()
    }

    fn reweighted(&self, track: &Track, points: &[Vector3<f64>], q: &Vector3<f64>) -> Vector3<f64> {
        weighted_mean(track, points, |k| self.kernel.weight((points[k] - q).norm_squared())).unwrap_or(*q)
    }

    fn linearise_track(&self, track: &Track, poses: &[Pose], q: &Vector3<f64>, system: &mut BlockSystem) {
        if track.observations.iter().all(|o| system.slot(o.scan).is_none()) {
            return;
        }
        let points = points_in_model(track, poses);
        let robust = |k: usize| self.kernel.weight((points[k] - q).norm_squared());
        let moving = track.held_landmark.is_none();
        let centre = if moving { weighted_mean(track, &points, robust).unwrap_or(*q) } else { *q };
        let weights: Vec<f64> =
            track.observations.iter().enumerate().map(|(k, o)| self.factor * o.weight * robust(k)).collect();
        let total: f64 = weights.iter().sum();
        if total <= 0.0 {
            return;
        }
        for (a, observed) in track.observations.iter().enumerate() {
            if system.slot(observed.scan).is_none() {
                continue;
            }
            let own = if moving { weights[a] * (1.0 - weights[a] / total) } else { weights[a] };
            system.add(observed.scan, observed.scan, &(gram(&points[a], &points[a]) * own));
            let residual = points[a] - centre;
            system.add_rhs(observed.scan, &(transposed_jacobian_times(&points[a], &residual) * -weights[a]));
            for (b, other) in track.observations.iter().enumerate().skip(a + 1).filter(|_| moving) {
                let cross = gram(&points[a], &points[b]) * (-weights[a] * weights[b] / total);
                if other.scan == observed.scan {
                    system.add(observed.scan, observed.scan, &(cross + cross.transpose()));
                } else {
                    system.add(observed.scan, other.scan, &cross);
                }
            }
        }
    }
}

/// The held landmark, or the weighted mean of a track's points; `None` when all weights are zero.
fn weighted_mean(
    track: &Track,
    points: &[Vector3<f64>],
    weight: impl Fn(usize) -> f64,
) -> Option<Vector3<f64>> {
    if track.held_landmark.is_some() {
        return track.held_landmark;
    }
    let mut sum = Vector3::zeros();
    let mut total = 0.0;
    for (k, (o, p)) in track.observations.iter().zip(points).enumerate() {
        let w = o.weight * weight(k);
        sum += (p - points[0]) * w;
        total += w;
    }
    (total > 0.0).then(|| points[0] + sum / total)
}

fn points_in_model(track: &Track, poses: &[Pose]) -> Vec<Vector3<f64>> {
    track.observations.iter().map(|o| poses[o.scan].transform(&o.point_in_scan)).collect()
}

/// `J_a^T J_b` with `J_p = [-[p]x, I]`.
fn gram(a: &Vector3<f64>, b: &Vector3<f64>) -> Matrix6<f64> {
    let turn = Matrix3::identity() * a.dot(b) - b * a.transpose();
    quarters(&turn, &skew(a), &-skew(b), &Matrix3::identity())
}

/// `J_p^T e`.
fn transposed_jacobian_times(p: &Vector3<f64>, e: &Vector3<f64>) -> Vector6<f64> {
    twist(&p.cross(e), e)
}
