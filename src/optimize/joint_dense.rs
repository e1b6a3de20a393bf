//! Joint dense adjustment: all overlapping pairs of scans at once, surface on surface.
//!
//! Rounds of association and minimisation. Each round asks the caller for correspondences within a gate that shrinks from
//! round to round, then minimises their robust point-to-plane energy with the correspondences fixed. Landmarks may be
//! added with a small weight, and what a pair's planes leave free is held at the round's start, so that scans which share
//! a single plane do not slide along it.

use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::bundle_adjustment::{BundleState, moved};
use super::dense_pair::{Correspondence, Hold, PairTerms, blind_motions, pair_cost};
use super::gauge::Gauge;
use super::landmark_terms::{LandmarkTerms, Track, TrackError};
use super::levenberg_marquardt::{MinimiseError, MinimiseOptions, Problem, Report, minimise};
use super::{BlockSolver, BlockSolverError, BlockSystem, OptionError};
use crate::control::{Control, Stage};
use crate::geometry::{Kernel, Pose};

/// Finds which points of one scan lie on which surface of another. Called from several threads.
pub trait Correspondences: Sync {
    /// Ordered pairs (i, j) of scans: points of j are sought on surfaces of i. List both orders to use both directions.
    fn pairs(&self) -> &[(usize, usize)];

    /// Correspondences of the pair at this index, at a relative pose, no further apart than `gate` metres. Must depend on
    /// nothing else.
    fn associate(&self, pair: usize, i_from_j: &Pose, gate: f64) -> Vec<Correspondence>;
}

/// Gates, kernels and weights.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DenseOptions {
    /// The gate of the first round, metres: about four voxels.
    pub first_gate: f64,
    /// The gate of the last round, metres: about three standard deviations of the points.
    pub final_gate: f64,
    /// Rounds of association; the gates between the first and the last are in geometric progression.
    pub rounds: usize,
    /// Of point-to-plane distances, its scale (metres) that of the last round; earlier ones are wider as their gates are.
    pub kernel: Kernel,
    /// Multiplies the weights of landmark observations: the variance of plane distances over that of keypoints.
    pub landmark_weight: f64,
    /// Of the distance between an observation and its landmark, scale in metres.
    pub landmark_kernel: Kernel,
    /// The share of a motion's displacement along normals below which a pair is blind to it.
    pub blind_share: f64,
    /// The weight of the hold on blind motions, as a share of point-to-point information; zero for no hold.
    pub hold_weight: f64,
    /// Pairs with fewer correspondences are left out of a round.
    pub least_correspondences: usize,
    /// When a round's minimisation stops.
    pub minimise: MinimiseOptions,
}

impl DenseOptions {
    /// The defaults for a first and a last gate in metres.
    #[must_use]
    pub fn with_gates(first_gate: f64, final_gate: f64) -> Self {
        Self {
            first_gate,
            final_gate,
            rounds: 6,
            kernel: Kernel::GemanMcClure(0.5 * final_gate),
            landmark_weight: 0.01,
            landmark_kernel: Kernel::Cauchy(first_gate),
            blind_share: 0.01,
            hold_weight: 0.1,
            least_correspondences: 30,
            minimise: MinimiseOptions {
                max_iterations: 5,
                relative_cost: 1e-4,
                ..MinimiseOptions::default()
            },
        }
    }

    /// Checks gates, scales, weights and tolerances.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::positive("final_gate", self.final_gate)?;
        OptionError::positive("rounds", self.rounds as f64)?;
        OptionError::positive("kernel", self.kernel.scale().unwrap_or(1.0))?;
        OptionError::positive("landmark_kernel", self.landmark_kernel.scale().unwrap_or(1.0))?;
        OptionError::not_negative("landmark_weight", self.landmark_weight)?;
        OptionError::not_negative("blind_share", self.blind_share)?;
        OptionError::not_negative("hold_weight", self.hold_weight)?;
        if self.first_gate.is_nan() || self.first_gate < self.final_gate || self.first_gate.is_infinite() {
            let requirement = "finite and at least final_gate";
            return Err(OptionError { name: "first_gate", value: self.first_gate, requirement });
        }
        self.minimise.validate()
    }

    /// The gate of a round, metres.
    fn gate(&self, round: usize) -> f64 {
        if round + 1 >= self.rounds {
            return self.final_gate;
        }
        let done = round as f64 / (self.rounds - 1) as f64;
        self.first_gate * (self.final_gate / self.first_gate).powf(done)
    }

    fn kernel_at(&self, gate: f64) -> Kernel {
        self.kernel.scale().map_or(self.kernel, |c| self.kernel.with_scale(c * gate / self.final_gate))
    }
}

/// What is adjusted, and by what.
#[derive(Clone, Copy)]
pub struct DenseProblem<'a, C> {
    /// `model_from_scan`, one a scan.
    pub poses: &'a [Pose],
    /// Scans that must not move, one flag a scan.
    pub held: &'a [bool],
    /// Surfaces.
    pub surfaces: &'a C,
    /// Landmarks; may be empty.
    pub tracks: &'a [Track],
}

/// One round of association and minimisation.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseRound {
    /// Metres.
    pub gate: f64,
    /// Correspondences used.
    pub correspondences: usize,
    /// Pairs with enough correspondences.
    pub pairs: usize,
    /// Of these, pairs that are blind to at least one relative motion.
    pub blind_pairs: usize,
    /// How the minimisation went.
    pub report: Report,
}

/// The adjusted poses, and how well they are held.
#[derive(Debug, Clone)]
pub struct DenseAdjustment {
    /// `model_from_scan`, one a scan; held ones bit for bit as they came.
    pub poses: Vec<Pose>,
    /// One a track, in the model frame, metres.
    pub landmarks: Vec<Vector3<f64>>,
    /// What each round did.
    pub rounds: Vec<DenseRound>,
    /// Left perturbations of each scan that none of its surfaces in the last round resists, scaled to a weighted sum of
    /// squared point displacements of one square metre; empty for a scan that is held well or has no surface in common.
    pub blind_motions: Vec<Vec<Vector6<f64>>>,
    /// Scans held in the last round beside the caller's, one for each connected group without a held scan.
    pub anchors: Vec<usize>,
    /// Scans that neither a surface nor a landmark tied to any other in the last round.
    pub unlinked: Vec<usize>,
    /// Normal equations of surfaces and landmarks at the end, without the hold.
    system: BlockSystem,
}

impl DenseAdjustment {
    /// The covariances of some scans' left perturbations (rad, m) for plane distances with a standard deviation of one
    /// metre; multiply by their variance. Fails for scans that did not vary, and where the data leave a direction free.
    pub fn covariances(&self, scans: &[usize]) -> Result<Vec<Matrix6<f64>>, BlockSolverError> {
        BlockSolver::new().covariances(&self.system, scans)
    }
}

/// Why nothing was adjusted.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum DenseError {
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
    /// A pair joins a scan to itself or to one that is not among the poses.
    #[error("pair {pair} joins scans {i} and {j} of {scans}")]
    BadPair {
        /// Its index.
        pair: usize,
        /// One scan.
        i: usize,
        /// The other.
        j: usize,
        /// How many there are.
        scans: usize,
    },
    /// No pair has enough correspondences in the gate, and there are no tracks.
    #[error("no two scans have {least} correspondences within {gate} m, and there are no tracks")]
    NothingInCommon {
        /// The least number.
        least: usize,
        /// Metres.
        gate: f64,
    },
    /// A track is malformed.
    #[error(transparent)]
    Track(#[from] TrackError),
    /// The minimiser failed, or was cancelled.
    #[error(transparent)]
    Minimise(#[from] MinimiseError),
}

/// Minimises `sum_pairs sum_k w_k rho(r_k^2) + landmark_weight * landmark energy + hold` over the poses that are not held,
/// r the distance of a point of scan j from the plane it is associated with in scan i.
///
/// Groups of scans without a held scan or landmark are anchored at their lowest index.
pub fn adjust_dense<C: Correspondences>(
    problem: &DenseProblem<'_, C>,
    options: &DenseOptions,
    control: Control<'_>,
) -> Result<DenseAdjustment, DenseError> {
    options.validate().map_err(MinimiseError::Option)?;
    let landmarks = LandmarkTerms {
        tracks: problem.tracks,
        kernel: options.landmark_kernel,
        factor: options.landmark_weight,
    };
    problem.validate()?;
    landmarks.validate(problem.poses.len())?;
    let mut state = BundleState { poses: problem.poses.to_vec(), landmarks: landmarks.place(problem.poses) };
    let mut rounds = Vec::with_capacity(options.rounds);
    loop {
        let gate = options.gate(rounds.len());
        let mut round = Round::associate(problem.surfaces, &state.poses, gate, options, landmarks, control)?;
        let gauge = round.gauge(problem.held);
        round.held.clone_from(&gauge.held);
        let minimum = minimise(&round, state, &options.minimise, control)?;
        state = minimum.state;
        rounds.push(round.summary(gate, minimum.report));
        control.report(Stage::DenseRefinement, rounds.len(), options.rounds);
        if rounds.len() == options.rounds {
            let blind_motions = round.blind_motions(&state.poses, options.blind_share);
            round.pairs.iter_mut().for_each(|pair| pair.hold = None);
            let (system, _) = round.linearise(&state);
            return Ok(DenseAdjustment {
                poses: state.poses,
                landmarks: state.landmarks,
                rounds,
                blind_motions,
                anchors: gauge.anchors,
                unlinked: gauge.unlinked,
                system,
            });
        }
    }
}

impl<C: Correspondences> DenseProblem<'_, C> {
    fn validate(&self) -> Result<(), DenseError> {
        let scans = self.poses.len();
        if self.held.len() != scans {
            return Err(DenseError::HeldMismatch { flags: self.held.len(), poses: scans });
        }
        if let Some(scan) = self.poses.iter().position(|pose| !pose.is_finite()) {
            return Err(DenseError::PoseNotFinite { scan });
        }
        for (pair, &(i, j)) in self.surfaces.pairs().iter().enumerate() {
            if i == j || i >= scans || j >= scans {
                return Err(DenseError::BadPair { pair, i, j, scans });
            }
        }
        Ok(())
    }
}

/// A pair with its correspondences of this round.
struct RoundPair {
    i: usize,
    j: usize,
    correspondences: Vec<Correspondence>,
    hold: Option<Hold>,
}

impl RoundPair {
    fn i_from_j(&self, poses: &[Pose]) -> Pose {
        poses[self.i].inverse() * poses[self.j]
    }
}

/// The energy of one round.
struct Round<'a> {
    pairs: Vec<RoundPair>,
    landmarks: LandmarkTerms<'a>,
    kernel: Kernel,
    held: Vec<bool>,
    length: f64,
}

impl<'a> Round<'a> {
    fn associate<C: Correspondences>(
        surfaces: &C,
        poses: &[Pose],
        gate: f64,
        options: &DenseOptions,
        landmarks: LandmarkTerms<'a>,
        control: Control<'_>,
    ) -> Result<Self, DenseError> {
        let kernel = options.kernel_at(gate);
        let one = |(pair, &(i, j)): (usize, &(usize, usize))| {
            control.check()?;
            let i_from_j = poses[i].inverse() * poses[j];
            let correspondences = surfaces.associate(pair, &i_from_j, gate);
            let hold = (options.hold_weight > 0.0).then(|| {
                let terms = PairTerms::of(&correspondences, &i_from_j, kernel);
                Hold::of(&terms, &i_from_j, options.blind_share, options.hold_weight)
            });
            Ok(RoundPair { i, j, correspondences, hold })
        };
        let mut pairs: Vec<RoundPair> =
            surfaces.pairs().par_iter().enumerate().map(one).collect::<Result<_, _>>().map_err(
                |cancelled: crate::control::Cancelled| {
                    DenseError::Minimise(MinimiseError::Cancelled(cancelled))
                },
            )?;
        pairs.retain(|pair| pair.correspondences.len() >= options.least_correspondences.max(1));
        if pairs.is_empty() && landmarks.tracks.is_empty() {
            return Err(DenseError::NothingInCommon { least: options.least_correspondences, gate });
        }
        let length = mean_square_radius(&pairs).map_or_else(|| landmarks.length(), f64::sqrt);
        Ok(Self { pairs, landmarks, kernel, held: vec![false; poses.len()], length })
    }

    fn gauge(&self, held: &[bool]) -> Gauge {
        let surfaces = self.pairs.iter().map(|pair| (pair.i, pair.j));
        if self.landmarks.factor > 0.0 {
            Gauge::new(held, surfaces.chain(self.landmarks.links()), self.landmarks.tied())
        } else {
            Gauge::new(held, surfaces, std::iter::empty())
        }
    }

    fn summary(&self, gate: f64, report: Report) -> DenseRound {
        let blind = |pair: &&RoundPair| pair.hold.is_some_and(|hold| hold.motions > 0);
        DenseRound {
            gate,
            correspondences: self.pairs.iter().map(|pair| pair.correspondences.len()).sum(),
            pairs: self.pairs.len(),
            blind_pairs: self.pairs.iter().filter(blind).count(),
            report,
        }
    }

    /// The terms of every pair in the model frame, in the order of the pairs.
    fn terms(&self, poses: &[Pose]) -> Vec<PairTerms> {
        let one = |pair: &RoundPair| {
            let i_from_j = pair.i_from_j(poses);
            let mut terms = PairTerms::of(&pair.correspondences, &i_from_j, self.kernel);
            if let Some(hold) = &pair.hold {
                hold.add_to(&mut terms, &i_from_j);
            }
            terms.in_model(&poses[pair.i])
        };
        self.pairs.par_iter().map(one).collect()
    }

    fn blind_motions(&self, poses: &[Pose], share: f64) -> Vec<Vec<Vector6<f64>>> {
        let one = |pair: &RoundPair| {
            PairTerms::of(&pair.correspondences, &pair.i_from_j(poses), self.kernel).in_model(&poses[pair.i])
        };
        let terms: Vec<PairTerms> = self.pairs.par_iter().map(one).collect();
        let mut sums = vec![(Matrix6::zeros(), Matrix6::zeros()); poses.len()];
        for (pair, terms) in self.pairs.iter().zip(&terms) {
            for scan in [pair.i, pair.j] {
                sums[scan].0 += terms.information;
                sums[scan].1 += terms.point_information;
            }
        }
        sums.iter().map(|(h, d)| blind_motions(h, d, share).unwrap_or_default()).collect()
    }
}

/// The mean squared distance of matched points from the origin of their scan, metres squared.
fn mean_square_radius(pairs: &[RoundPair]) -> Option<f64> {
    let points = pairs.iter().flat_map(|pair| &pair.correspondences).map(|c| c.point_in_j);
    let square = |p: [f32; 3]| p.iter().map(|&x| f64::from(x).powi(2)).sum::<f64>();
    let (sum, count) = points.fold((0.0, 0.0), |(s, n), p| (s + square(p), n + 1.0));
    (sum > 0.0).then(|| sum / count)
}

impl Problem for Round<'_> {
    type State = BundleState;

    fn cost(&self, state: &BundleState) -> f64 {
        let one = |pair: &RoundPair| {
            let i_from_j = pair.i_from_j(&state.poses);
            let held = pair.hold.map_or(0.0, |hold| hold.cost(&i_from_j));
            pair_cost(&pair.correspondences, &i_from_j, self.kernel) + held
        };
        let pairs: Vec<f64> = self.pairs.par_iter().map(one).collect();
        pairs.into_iter().sum::<f64>() + self.landmarks.cost(&state.poses, &state.landmarks)
    }

    fn linearise(&self, state: &BundleState) -> (BlockSystem, f64) {
        let mut system = BlockSystem::new(&self.held);
        let mut cost = 0.0;
        for (pair, terms) in self.pairs.iter().zip(self.terms(&state.poses)) {
            system.add_relative(pair.i, pair.j, &terms.information, &terms.rhs);
            cost += terms.cost;
        }
        if self.landmarks.factor > 0.0 {
            self.landmarks.linearise(&state.poses, &state.landmarks, &mut system);
        }
        (system, cost + self.landmarks.cost(&state.poses, &state.landmarks))
    }

    fn step(&self, state: &BundleState, delta: &[Vector6<f64>]) -> BundleState {
        let poses = moved(&state.poses, delta, &self.held);
        let landmarks = self.landmarks.follow(&state.poses, &poses, &state.landmarks);
        BundleState { poses, landmarks }
    }

    fn length(&self) -> f64 {
        self.length
    }
}

#[cfg(test)]
mod tests;
