//! Gravity between components: what their scans say together of where up is. Pairs were judged by it already, but a pair of which one scan
//! does not say where up is could still tip a whole component over. Used by `candidates` and `join`.

use nalgebra::Vector3;

use super::component::Component;
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::is_level;

/// The upward directions of two components, unit vectors in their frames.
#[derive(Debug, Clone, Copy)]
pub struct Gravity {
    in_a: Vector3<f64>,
    in_b: Vector3<f64>,
}

impl Gravity {
    /// `None` unless scans of both say where up is.
    #[must_use]
    pub fn between(graph: &ScanGraph, a: &Component, b: &Component) -> Option<Self> {
        // The smaller first: where it says nothing, the larger is not asked.
        let in_b = upward(graph, b)?;
        Some(Self { in_a: upward(graph, a)?, in_b })
    }

    /// Whether a pose leaves both upright.
    #[must_use]
    pub fn admits(&self, a_from_b: &Pose) -> bool {
        is_level(&self.in_a, &(a_from_b.rotation * self.in_b))
    }
}

/// The mean of the upward directions that a component's scans give, in its frame.
fn upward(graph: &ScanGraph, component: &Component) -> Option<Vector3<f64>> {
    let ups = component
        .poses
        .iter()
        .filter_map(|(key, pose)| Some(pose.rotation * Vector3::from(graph.scan(*key)?.prepared.up?)));
    ups.sum::<Vector3<f64>>().try_normalize(f64::EPSILON)
}
