//! How a joint dense adjustment weighs surfaces and landmarks, and how its gates and kernels narrow from round to round.

use super::super::{MinimiseOptions, OptionError};
use crate::geometry::Kernel;

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
    pub(super) fn gate(&self, round: usize) -> f64 {
        if round + 1 >= self.rounds {
            return self.final_gate;
        }
        let done = round as f64 / (self.rounds - 1) as f64;
        self.first_gate * (self.final_gate / self.first_gate).powf(done)
    }

    /// The kernel of a round with this gate, metres.
    pub(super) fn kernel_at(&self, gate: f64) -> Kernel {
        self.kernel.scale().map_or(self.kernel, |c| self.kernel.with_scale(c * gate / self.final_gate))
    }
}
