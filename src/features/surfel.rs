//! A piece of surface.

use crate::geometry::Point;

/// A point with its normal, side by side as lookups read them: in one line of the cache.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
#[repr(align(32))]
pub struct Surfel {
    /// Metres, local frame.
    pub position: Point,
    /// Unit vector that faces the sensor.
    pub normal: Point,
}

impl Surfel {
    /// Of points (metres) with their normals.
    #[must_use]
    pub fn of_all(points: &[Point], normals: &[Point]) -> Vec<Self> {
        points
            .iter()
            .zip(normals)
            .map(|(position, normal)| Self { position: *position, normal: *normal })
            .collect()
    }
}
