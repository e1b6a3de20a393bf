//! People who stand somewhere else in every scan. Uses the building to find free floor; used by the survey.

use nalgebra::Vector3;

use super::building::Building;
use super::draw::Draw;
use super::furniture::yaw;
use super::scene::Scene;
use super::solid::{Shape, Solid};

/// Farthest a person stands from the sensor, metres.
const REACH: f32 = 6.0;
/// Nearest a person stands to the sensor, metres.
const DISTANCE: f32 = 0.9;

/// Up to `count` people on free floor around a sensor; fewer where there is no room.
pub(super) fn people_around(
    building: &Building,
    sensor: &Vector3<f32>,
    count: usize,
    draw: &mut Draw,
) -> Scene {
    let mut solids = Vec::new();
    for _ in 0..count {
        let place = (0..40).find_map(|_| {
            let (distance, angle) = (draw.between(DISTANCE, REACH), draw.angle());
            let place = [sensor.x + distance * angle.cos(), sensor.y + distance * angle.sin()];
            building.is_free_floor(place, 0.3).then_some(place)
        });
        if let Some([x, y]) = place {
            let (rotation, translation) = (yaw(draw.angle()), Vector3::new(x, y, 0.0));
            solids.extend(person(draw).iter().map(|solid| solid.moved(&rotation, &translation)));
        }
    }
    Scene::new(&solids)
}

/// Someone at the origin who faces -y.
fn person(draw: &mut Draw) -> Vec<Solid> {
    let (height, stride) = (draw.between(1.55, 1.92), draw.between(-0.18, 0.18));
    let [hip, shoulder, head] = [0.5, 0.82, 0.93].map(|share| share * height);
    let mut solids = vec![
        Solid::new(Shape::Ball { radius: 0.11 }, Vector3::new(0.0, 0.0, head)),
        Solid::rod(
            Vector3::new(0.0, 0.0, hip - 0.05),
            Vector3::new(0.0, 0.0, shoulder),
            draw.between(0.14, 0.18),
        ),
        Solid::rod(Vector3::new(-0.15, 0.0, shoulder - 0.05), Vector3::new(0.15, 0.0, shoulder - 0.05), 0.08),
    ];
    for side in [-1.0, 1.0] {
        let foot = Vector3::new(side * 0.1, side * stride, 0.0);
        solids.push(Solid::rod(foot, Vector3::new(side * 0.09, 0.0, hip), 0.07));
        let hand = Vector3::new(side * 0.28, draw.between(-0.4, 0.1), hip + draw.between(0.0, 0.4));
        solids.push(Solid::rod(Vector3::new(side * 0.2, 0.0, shoulder - 0.05), hand, 0.045));
    }
    solids
}
