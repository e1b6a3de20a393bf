//! What one ray brings back: the surface that returns it, through panes and by way of mirrors. Used by [`super::acquire`].

use super::acquire::Surroundings;
use super::draw::Draw;
use super::scene::Scene;
use super::sensor::Sensor;
use super::solid::{Hit, Material, Ray};

/// Cosine of incidence above which a pane mirrors much of a ray back to where it came from.
const SQUARE_ON: f32 = 0.97;
/// Panes and mirrors that a ray may meet.
const MOST_PANES: usize = 6;
/// A ray that was reflected starts this far from the surface, metres.
const STEP: f32 = 1e-3;

/// What one ray met, before noise.
#[derive(Debug, Clone, Copy)]
pub(super) struct Echo {
    /// Length of the ray's whole way, metres; infinite when the ray met nothing.
    pub distance: f32,
    /// Cosine of the angle between the ray and the surface's normal.
    pub incidence: f32,
    pub dark: bool,
    pub color: [u8; 3],
}

const NOTHING: Echo = Echo { distance: f32::INFINITY, incidence: 1.0, dark: false, color: [0; 3] };

fn first_hit(scenes: &[&Scene], ray: &Ray, near: f32, far: f32) -> Option<Hit> {
    scenes.iter().fold(None, |best: Option<Hit>, scene| {
        scene.cast(ray, near, best.map_or(far, |hit| hit.distance)).or(best)
    })
}

/// The first surface that returns the ray; panes let most rays pass and reflect some, mirrors reflect all.
pub(super) fn echo(around: &Surroundings<'_>, sensor: &Sensor, ray: Ray, draw: &mut Draw) -> Echo {
    let (mut ray, mut near, mut travelled) = (ray, 0.0, 0.0);
    for _ in 0..MOST_PANES {
        let Some(hit) = first_hit(around.scenes, &ray, near, sensor.range[1] - travelled) else {
            return NOTHING;
        };
        let incidence = -hit.normal.dot(&ray.direction);
        let glass = hit.material == Material::Glass;
        if hit.material == Material::Mirror || (glass && around.ghosts > 0.0 && draw.chance(around.ghosts)) {
            travelled += hit.distance;
            ray = Ray {
                origin: ray.origin + ray.direction * hit.distance,
                direction: ray.direction + hit.normal * (2.0 * incidence),
            };
            near = STEP;
        } else if !glass || draw.chance(if incidence > SQUARE_ON { 0.5 } else { 0.03 }) {
            let (distance, dark) = (travelled + hit.distance, hit.material == Material::Dark);
            return Echo { distance, incidence, dark, color: hit.color };
        } else {
            // Past the second face of the pane, too.
            near = hit.distance + 0.02;
        }
    }
    NOTHING
}
