//! A sensor that moves while it takes one scan: where it is at each moment, and where the scan says it was. Used by
//! [`super::acquire`].

use nalgebra::{Rotation3, Unit, Vector3};

use super::draw::Draw;
use crate::geometry::Pose;

/// How a sensor moves during a scan.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Motion {
    /// Moments at which a camera takes a frame; a spinning sensor measures all the time.
    pub frames: usize,
    /// Length of the way, metres.
    pub way: f32,
    /// Turn over the whole way, degrees as in a data sheet.
    pub turn_deg: f32,
    /// Error of the position that the scan assumes at the end of the way, metres; it grows evenly from the start.
    pub drift: f32,
}

/// A smooth way from the first pose of a scan.
pub(super) struct Way {
    direction: Vector3<f64>,
    /// Sideways deflection in the middle of the way.
    bow: Vector3<f64>,
    turn: Vector3<f64>,
    /// Error of position and orientation at the end of the way.
    drift: (Vector3<f64>, Vector3<f64>),
}

impl Way {
    /// Draws a way. It is at most half as long as `room` says is free in its direction, so that it does not lead through walls.
    pub(super) fn draw(motion: &Motion, draw: &mut Draw, room: impl Fn(&Vector3<f64>) -> f32) -> Self {
        let mut vector = || Vector3::new(draw.normal(), draw.normal(), draw.normal()).cast::<f64>();
        let unit = Unit::try_new(vector(), 1e-6).unwrap_or(Vector3::x_axis()).into_inner();
        let length = motion.way.min(0.5 * room(&unit));
        let direction = unit * f64::from(length);
        let bow = vector().normalize() * 0.1 * f64::from(length);
        let turn = vector().normalize() * f64::from(motion.turn_deg.to_radians());
        let drift = f64::from(motion.drift);
        // A camera that is lost by a centimetre is turned by about a quarter of a degree.
        let drift = (vector() * drift, vector() * drift * 0.4);
        Self { direction, bow, turn, drift }
    }

    /// Maps the sensor's frame at a moment, 0 at the start and 1 at the end, into its frame at the start.
    pub(super) fn start_from_moment(&self, moment: f64) -> Pose {
        let bend = (std::f64::consts::PI * moment).sin();
        Pose::new(Rotation3::new(self.turn * moment), self.direction * moment + self.bow * bend)
    }

    /// What the scan takes [`Way::start_from_moment`] for.
    pub(super) fn assumed_start_from_moment(&self, moment: f64) -> Pose {
        let (position, turn) = self.drift;
        Pose::new(Rotation3::new(turn * moment), position * moment) * self.start_from_moment(moment)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;

    #[test]
    fn a_way_starts_at_the_first_pose_and_does_not_lead_through_walls() {
        let motion = Motion { frames: 12, way: 0.4, turn_deg: 20.0, drift: 0.004 };
        for subject in 0..20 {
            let way = Way::draw(&motion, &mut Draw::new(Seed(1).derive("test", subject)), |_| 0.3);
            let (start, end) = (way.start_from_moment(0.0), way.start_from_moment(1.0));
            assert!(start.angle() < 1e-9 && start.translation.norm() < 1e-9);
            assert!((end.angle().to_degrees() - 20.0).abs() < 1e-3);
            assert!(end.translation.norm() < 0.16);
            let (angle, distance) = end.difference(&way.assumed_start_from_moment(1.0));
            assert!(angle < 0.02 && distance > 1e-5 && distance < 0.03, "{angle} {distance}");
        }
    }
}
