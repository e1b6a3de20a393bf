//! Bundle adjustment over landmarks, local and global: poses vary, landmarks are eliminated in closed form.

use nalgebra::{Vector3, Vector6};

use super::gauge::Gauge;
use super::landmark_terms::{LandmarkTerms, Track, TrackError};
use super::levenberg_marquardt::{MinimiseError, MinimiseOptions, Problem, Report, minimise};
use super::{BlockSolver, BlockSolverError, BlockSystem, OptionError};
use crate::control::Control;
use crate::geometry::{Kernel, Pose};

/// How landmarks are weighed and when to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundleOptions {
    /// Of the distance between an observation and its landmark; the scale is in metres. A caller that wants a robust
    /// loss first and a plain one then calls twice.
    pub kernel: Kernel,
    /// When to stop.
    pub minimise: MinimiseOptions,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { kernel: Kernel::Squared, minimise: MinimiseOptions::default() }
    }
}

impl BundleOptions {
    /// Checks the kernel's scale and the tolerances.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::positive("kernel", self.kernel.scale().unwrap_or(1.0))?;
        self.minimise.validate()
    }
}

/// The adjusted poses, and where that leaves the landmarks.
#[derive(Debug, Clone)]
pub struct BundleAdjustment {
    /// `model_from_scan`, one a scan; held ones bit for bit as they came.
    pub poses: Vec<Pose>,
    /// One a track, in the model frame, metres.
    pub landmarks: Vec<Vector3<f64>>,
    /// The plain RMS distance of each track's observations from its landmark, metres.
    pub track_rms: Vec<f64>,
    /// Scans held beside the caller's, one for each connected group that had no held scan: its lowest index.
    pub anchors: Vec<usize>,
    /// Scans that share no landmark with any other and therefore kept their pose.
    pub unlinked: Vec<usize>,
    /// How the minimisation went.
    pub report: Report,
    system: BlockSystem,
}

impl BundleAdjustment {
    /// The covariances of some scans' left perturbations (rad, m) for observations with a standard deviation of one
    /// metre along each axis; multiply by the variance of one observation. Fails for scans that did not vary, and where
    /// the landmarks leave a direction free.
    pub fn covariances(&self, scans: &[usize]) -> Result<Vec<nalgebra::Matrix6<f64>>, BlockSolverError> {
        BlockSolver::new().covariances(&self.system, scans)
    }
}

/// Why no bundle was adjusted.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum BundleError {
    /// There is nothing to adjust by.
    #[error("there are no tracks")]
    NoTracks,
    /// One flag a pose is needed.
    #[error("{flags} held flags were given for {poses} poses")]
    HeldMismatch {
        /// Flags.
        flags: usize,
        /// Poses.
        poses: usize,
    },
    /// A pose has an entry that is not finite.
    #[error("the pose of scan {scan} is not finite")]
    PoseNotFinite {
        /// Its index.
        scan: usize,
    },
    /// A track is malformed.
    #[error(transparent)]
    Track(#[from] TrackError),
    /// The minimiser failed, or was cancelled.
    #[error(transparent)]
    Minimise(#[from] MinimiseError),
}

/// Minimises `sum_j sum_i w_ij rho(|R_i p_ij + t_i - q_j|^2)` over the poses that are not `held` and all landmarks `q_j`
/// that are not held.
///
/// For a local adjustment hold all scans but the new one and its most covisible neighbours, and hold the landmarks of
/// tracks that many held scans see. Groups of scans without a held scan or landmark are anchored at their lowest index.
pub fn adjust_bundle(
    poses: &[Pose],
    tracks: &[Track],
    held: &[bool],
    options: &BundleOptions,
    control: Control<'_>,
) -> Result<BundleAdjustment, BundleError> {
    options.validate().map_err(MinimiseError::Option)?;
    let terms = LandmarkTerms { tracks, kernel: options.kernel, factor: 1.0 };
    if tracks.is_empty() {
        return Err(BundleError::NoTracks);
    }
    if held.len() != poses.len() {
        return Err(BundleError::HeldMismatch { flags: held.len(), poses: poses.len() });
    }
    if let Some(scan) = poses.iter().position(|pose| !pose.is_finite()) {
        return Err(BundleError::PoseNotFinite { scan });
    }
    terms.validate(poses.len())?;
    let gauge = Gauge::new(held, terms.links(), terms.tied());
    let problem = BundleProblem { terms, held: &gauge.held };
    let start = BundleState { poses: poses.to_vec(), landmarks: terms.place(poses) };
    let minimum = minimise(&problem, start, &options.minimise, control)?;
    let (system, _) = problem.linearise(&minimum.state);
    let BundleState { poses, landmarks } = minimum.state;
    Ok(BundleAdjustment {
        track_rms: terms.rms(&poses, &landmarks),
        poses,
        landmarks,
        anchors: gauge.anchors,
        unlinked: gauge.unlinked,
        report: minimum.report,
        system,
    })
}

/// The landmark energy as the minimiser sees it.
pub(super) struct BundleProblem<'a> {
    pub terms: LandmarkTerms<'a>,
    pub held: &'a [bool],
}

/// Poses and their landmarks.
#[derive(Debug, Clone)]
pub(super) struct BundleState {
    pub poses: Vec<Pose>,
    pub landmarks: Vec<Vector3<f64>>,
}

impl Problem for BundleProblem<'_> {
    type State = BundleState;

    fn cost(&self, state: &BundleState) -> f64 {
        self.terms.cost(&state.poses, &state.landmarks)
    }

    fn linearise(&self, state: &BundleState) -> (BlockSystem, f64) {
        let mut system = BlockSystem::new(self.held);
        self.terms.linearise(&state.poses, &state.landmarks, &mut system);
        (system, self.cost(state))
    }

    fn step(&self, state: &BundleState, delta: &[Vector6<f64>]) -> BundleState {
        let poses = moved(&state.poses, delta, self.held);
        let landmarks = self.terms.follow(&state.poses, &poses, &state.landmarks);
        BundleState { poses, landmarks }
    }

    fn length(&self) -> f64 {
        self.terms.length()
    }
}

/// All poses perturbed but the held ones.
pub(super) fn moved(poses: &[Pose], delta: &[Vector6<f64>], held: &[bool]) -> Vec<Pose> {
    let steps = poses.iter().zip(delta).zip(held);
    steps.map(|((pose, xi), held)| if *held { *pose } else { pose.perturbed(xi).renormalised() }).collect()
}

#[cfg(test)]
mod tests;
