//! Joint dense adjustment: all overlapping pairs of scans at once, surface on surface.
//!
//! Rounds of association and minimisation. Each round asks the caller for correspondences within a gate that shrinks from
//! round to round, then minimises their robust point-to-plane energy with the correspondences fixed. Landmarks may be
//! added with a small weight, and what a pair's planes leave free is held at the round's start, so that scans which share
//! a single plane do not slide along it.

mod options;
mod problem;

use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;

pub use options::DenseOptions;
pub use problem::{Correspondences, DenseError, DenseProblem};

use super::bundle_adjustment::{BundleState, moved};
use super::dense_pair::{Hold, PairTerms, blind_motions};
use super::dense_sums::{Correspondence, cost};
use super::gauge::Gauge;
use super::landmark_terms::LandmarkTerms;
use super::levenberg_marquardt::{MinimiseError, Problem, Report, minimise};
use super::{BlockSolver, BlockSolverError, BlockSystem};
use crate::control::{Control, Stage};
use crate::geometry::{Kernel, Pose};

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
            cost(&pair.correspondences, &i_from_j, self.kernel) + held
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
