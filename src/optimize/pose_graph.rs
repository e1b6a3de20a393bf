//! Pose graph: poses from relative poses of pairs, some of which are wrong.
//!
//! Graduated non-convexity after Yang et al. (2020): the Geman-McClure kernel starts so wide that the energy is nearly
//! convex and narrows to the scale the caller trusts, so that edges which contradict the others lose their pull one by one
//! without a good start being needed.

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use rayon::prelude::*;

use super::bundle_adjustment::moved;
use super::gauge::Gauge;
use super::levenberg_marquardt::{MinimiseError, MinimiseOptions, Problem, Report, minimise};
use super::twist::{adjoint, inverse_left_jacobian, quarters, rotation_vector, skew, twist};
use super::{BlockSystem, OptionError};
use crate::control::Control;
use crate::geometry::{Kernel, Pose};

/// How the disagreement of an edge becomes metres squared.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "edges are few, and a Copy matrix keeps them plain data")]
pub enum EdgeMetric {
    /// `|d|^2 + l^2 |w|^2`: displacement d of the overlap's centroid and rotation vector w times a lever arm l in
    /// metres (the RMS distance of a scan's points from their centroid).
    LeverArm(f64),
    /// `[w; d]^T A [w; d]` with a symmetric positive semidefinite A whose value is in metres squared.
    Full(Matrix6<f64>),
}

impl EdgeMetric {
    fn matrix(&self) -> Matrix6<f64> {
        match self {
            Self::LeverArm(metres) => quarters(
                &(Matrix3::identity() * (metres * metres)),
                &Matrix3::zeros(),
                &Matrix3::zeros(),
                &Matrix3::identity(),
            ),
            Self::Full(matrix) => *matrix,
        }
    }
}

/// A measured relative pose.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseEdge {
    /// A scan.
    pub i: usize,
    /// Another scan.
    pub j: usize,
    /// Maps points of scan j into scan i.
    pub i_from_j: Pose,
    /// The centroid of the overlap in the frame of scan j, metres: where displacement is measured.
    pub centroid_in_j: Vector3<f64>,
    /// How much it counts, at least zero; outside the kernel.
    pub weight: f64,
    /// How its disagreement is measured.
    pub metric: EdgeMetric,
}

/// How far to trust edges and when to stop.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PoseGraphOptions {
    /// The disagreement in metres up to which an edge is believed at the end.
    pub final_scale: f64,
    /// The factor in squared scale from one level to the next, above one.
    pub anneal: f64,
    /// Linear solves at most at each level but the last.
    pub level_iterations: usize,
    /// When the last level stops.
    pub minimise: MinimiseOptions,
}

impl PoseGraphOptions {
    /// The defaults for a final scale in metres.
    #[must_use]
    pub fn with_final_scale(final_scale: f64) -> Self {
        Self { final_scale, anneal: 1.4, level_iterations: 4, minimise: MinimiseOptions::default() }
    }

    /// Checks scale, annealing factor and tolerances.
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::positive("final_scale", self.final_scale)?;
        if self.anneal.is_nan() || self.anneal < 1.01 || self.anneal.is_infinite() {
            let requirement = "at least 1.01 and finite";
            return Err(OptionError { name: "anneal", value: self.anneal, requirement });
        }
        self.minimise.validate()
    }
}

/// The adjusted poses, and which edges they believe.
#[derive(Debug, Clone)]
pub struct PoseGraphAdjustment {
    /// `model_from_scan`, one a scan; held ones bit for bit as they came.
    pub poses: Vec<Pose>,
    /// The final disagreement of each edge, metres.
    pub residuals: Vec<f64>,
    /// The final robust weight of each edge in [0, 1]: 1/4 where the disagreement equals the final scale.
    pub weights: Vec<f64>,
    /// Whether each edge disagrees by at most the final scale.
    pub inliers: Vec<bool>,
    /// Scans held beside the caller's, one for each connected group that had no held scan: its lowest index.
    pub anchors: Vec<usize>,
    /// Scans without any edge, which kept their pose.
    pub unlinked: Vec<usize>,
    /// Scales passed before the last.
    pub levels: usize,
    /// How the minimisation at the final scale went.
    pub report: Report,
}

/// Why no pose graph was adjusted.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum PoseGraphError {
    /// There is nothing to adjust by.
    #[error("there are no edges")]
    NoEdges,
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
    /// An edge joins a scan to itself or to one that is not among the poses.
    #[error("edge {edge} joins scans {i} and {j} of {scans}")]
    BadEnds {
        /// Its index.
        edge: usize,
        /// One end.
        i: usize,
        /// The other.
        j: usize,
        /// How many scans there are.
        scans: usize,
    },
    /// A number of an edge is not finite, or its weight is negative.
    #[error("edge {edge} has a pose, centroid, metric or weight that is negative or not finite")]
    NotFinite {
        /// Its index.
        edge: usize,
    },
    /// The minimiser failed, or was cancelled.
    #[error(transparent)]
    Minimise(#[from] MinimiseError),
}

/// Minimises `sum_e w_e rho_c(s_e)` over the poses that are not `held`, where `s_e` is the squared disagreement of edge e
/// and c narrows from the largest disagreement to `options.final_scale`.
///
/// Groups of scans without a held scan are anchored at their lowest index.
pub fn adjust_pose_graph(
    poses: &[Pose],
    edges: &[PoseEdge],
    held: &[bool],
    options: &PoseGraphOptions,
    control: Control<'_>,
) -> Result<PoseGraphAdjustment, PoseGraphError> {
    options.validate().map_err(MinimiseError::Option)?;
    validate(poses, edges, held)?;
    let links = edges.iter().filter(|edge| edge.weight > 0.0).map(|edge| (edge.i, edge.j));
    let gauge = Gauge::new(held, links, std::iter::empty());
    let mut problem = GraphProblem { edges, held: &gauge.held, kernel: Kernel::Squared };
    let mut state = poses.to_vec();

    let final_square = options.final_scale.powi(2);
    let worst = problem.squares(&state).into_iter().fold(0.0, f64::max);
    let mut square = (2.0 * worst).min(f64::MAX);
    let mut levels = 0;
    let brief = MinimiseOptions { max_iterations: options.level_iterations, ..options.minimise };
    while square > final_square {
        problem.kernel = Kernel::GemanMcClure(square.sqrt());
        state = minimise(&problem, state, &brief, control)?.state;
        square /= options.anneal;
        levels += 1;
    }
    problem.kernel = Kernel::GemanMcClure(options.final_scale);
    let minimum = minimise(&problem, state, &options.minimise, control)?;

    let squares = problem.squares(&minimum.state);
    Ok(PoseGraphAdjustment {
        poses: minimum.state,
        residuals: squares.iter().map(|s| s.sqrt()).collect(),
        weights: squares.iter().map(|&s| problem.kernel.weight(s)).collect(),
        inliers: squares.iter().map(|&s| s <= final_square).collect(),
        anchors: gauge.anchors,
        unlinked: gauge.unlinked,
        levels,
        report: minimum.report,
    })
}

fn validate(poses: &[Pose], edges: &[PoseEdge], held: &[bool]) -> Result<(), PoseGraphError> {
    let scans = poses.len();
    if edges.is_empty() {
        return Err(PoseGraphError::NoEdges);
    }
    if held.len() != scans {
        return Err(PoseGraphError::HeldMismatch { flags: held.len(), poses: scans });
    }
    if let Some(scan) = poses.iter().position(|pose| !pose.is_finite()) {
        return Err(PoseGraphError::PoseNotFinite { scan });
    }
    for (edge, &PoseEdge { i, j, i_from_j, centroid_in_j, weight, metric }) in edges.iter().enumerate() {
        if i == j || i >= scans || j >= scans {
            return Err(PoseGraphError::BadEnds { edge, i, j, scans });
        }
        let mut numbers = centroid_in_j.iter().chain(std::iter::once(&weight));
        let finite = i_from_j.is_finite() && numbers.all(|x| x.is_finite());
        if !finite || weight < 0.0 || metric.matrix().iter().any(|x| !x.is_finite()) {
            return Err(PoseGraphError::NotFinite { edge });
        }
    }
    Ok(())
}

/// The graph's energy at one scale of the kernel.
struct GraphProblem<'a> {
    edges: &'a [PoseEdge],
    held: &'a [bool],
    kernel: Kernel,
}

impl PoseEdge {
    /// `[w; d]`: the rotation vector of `predicted measured^-1` and the displacement of the centroid, both in frame i.
    fn residual(&self, i_from_j: &Pose) -> Vector6<f64> {
        let predicted_from_measured = *i_from_j * self.i_from_j.inverse();
        let displacement =
            i_from_j.transform(&self.centroid_in_j) - self.i_from_j.transform(&self.centroid_in_j);
        twist(&rotation_vector(&predicted_from_measured), &displacement)
    }

    /// The derivative of [`PoseEdge::residual`] by a left perturbation of the predicted `i_from_j`.
    fn jacobian(&self, i_from_j: &Pose, residual: &Vector6<f64>) -> Matrix6<f64> {
        let w: Vector3<f64> = residual.fixed_rows::<3>(0).into();
        let centroid_in_i = i_from_j.transform(&self.centroid_in_j);
        let turn = inverse_left_jacobian(&w);
        quarters(&turn, &Matrix3::zeros(), &-skew(&centroid_in_i), &Matrix3::identity())
    }
}

fn i_from_j(poses: &[Pose], edge: &PoseEdge) -> Pose {
    poses[edge.i].inverse() * poses[edge.j]
}

impl GraphProblem<'_> {
    /// The squared disagreement of every edge, metres squared.
    fn squares(&self, poses: &[Pose]) -> Vec<f64> {
        let square = |edge: &PoseEdge| {
            let residual = edge.residual(&i_from_j(poses, edge));
            residual.dot(&(edge.metric.matrix() * residual)).max(0.0)
        };
        self.edges.par_iter().map(square).collect()
    }
}

impl Problem for GraphProblem<'_> {
    type State = Vec<Pose>;

    fn cost(&self, poses: &Vec<Pose>) -> f64 {
        self.edges.iter().zip(self.squares(poses)).map(|(edge, s)| edge.weight * self.kernel.rho(s)).sum()
    }

    fn linearise(&self, poses: &Vec<Pose>) -> (BlockSystem, f64) {
        let term = |edge: &PoseEdge| {
            let relative = i_from_j(poses, edge);
            let residual = edge.residual(&relative);
            // A perturbation of pose j in the model frame, seen as one of i_from_j; that of pose i is its negative.
            let jacobian = edge.jacobian(&relative, &residual) * adjoint(&poses[edge.i].inverse());
            let metric = edge.metric.matrix();
            let weight = edge.weight * self.kernel.weight(residual.dot(&(metric * residual)).max(0.0));
            let weighted = jacobian.transpose() * metric * weight;
            (weighted * jacobian, -(weighted * residual))
        };
        let terms: Vec<_> = self.edges.par_iter().map(term).collect();
        let mut system = BlockSystem::new(self.held);
        for (edge, (information, rhs)) in self.edges.iter().zip(&terms) {
            system.add_relative(edge.i, edge.j, information, rhs);
        }
        (system, self.cost(poses))
    }

    fn step(&self, poses: &Vec<Pose>, delta: &[Vector6<f64>]) -> Vec<Pose> {
        moved(poses, delta, self.held)
    }

    fn length(&self) -> f64 {
        let squares: f64 = self.edges.iter().map(|edge| edge.i_from_j.translation.norm_squared()).sum();
        let length = (squares / self.edges.len() as f64).sqrt();
        if length > 0.0 { length } else { 1.0 }
    }
}

#[cfg(test)]
mod tests;
