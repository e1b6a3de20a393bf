//! One scan: the sensor's rays cast into the scene, and its errors added. Each row of rays draws its own random
//! numbers, so the points do not depend on the number of threads. Used by the survey.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::draw::Draw;
use super::scene::Scene;
use super::sensor::{Raster, Sensor};
use super::solid::{Hit, Material, Ray};
use crate::cloud::PointCloud;
use crate::control::Seed;
use crate::geometry::Pose;

/// Cosine of incidence above which a pane mirrors much of a ray back to where it came from.
const SQUARE_ON: f32 = 0.97;
/// Cosine of incidence below which a surface returns too little to be measured reliably.
const GRAZING: f32 = 0.15;
/// Share of rays that dark surfaces swallow.
const SWALLOWED: f32 = 0.4;
/// A jump in distance between neighbouring rays that counts as an edge: metres, and share of the distance.
const EDGE: (f32, f32) = (0.08, 0.06);
/// Panes that a ray may pass.
const MOST_PANES: usize = 6;

/// What one ray met, before noise.
#[derive(Debug, Clone, Copy)]
struct Echo {
    /// Infinite when the ray met nothing.
    distance: f32,
    /// Cosine of the angle between the ray and the surface's normal.
    incidence: f32,
    dark: bool,
}

const NOTHING: Echo = Echo { distance: f32::INFINITY, incidence: 1.0, dark: false };

/// Casts all rays of a sensor into scenes that share a frame.
///
/// `subject` tells this scan from the others of the same seed. Points are in the sensor's frame.
pub(super) fn acquire(
    scenes: &[&Scene],
    sensor: &Sensor,
    world_from_sensor: &Pose,
    seed: Seed,
    subject: u64,
) -> PointCloud {
    let raster = sensor.raster();
    let draw = |purpose, row| Draw::new(seed.derive(purpose, (u128::from(subject) << 32) | row as u128));
    let (origin, rotation) =
        (world_from_sensor.translation.cast(), world_from_sensor.rotation.matrix().cast::<f32>());
    let echoes: Vec<Vec<Echo>> = raster
        .rows
        .par_iter()
        .enumerate()
        .map(|(row, directions)| {
            let mut draw = draw("simulate.cast", row);
            let cast =
                |direction| echo(scenes, sensor, Ray { origin, direction: rotation * direction }, &mut draw);
            directions.iter().map(cast).collect()
        })
        .collect();
    let points = (0..raster.rows.len())
        .into_par_iter()
        .map(|row| measure(sensor, &raster, &echoes, row, &mut draw("simulate.noise", row)))
        .collect::<Vec<_>>()
        .concat();
    PointCloud::from_points(points)
}

fn first_hit(scenes: &[&Scene], ray: &Ray, near: f32, far: f32) -> Option<Hit> {
    scenes.iter().fold(None, |best: Option<Hit>, scene| {
        scene.cast(ray, near, best.map_or(far, |hit| hit.distance)).or(best)
    })
}

/// The first surface that returns the ray; panes let most rays pass.
fn echo(scenes: &[&Scene], sensor: &Sensor, ray: Ray, draw: &mut Draw) -> Echo {
    let mut near = 0.0;
    for _ in 0..MOST_PANES {
        let Some(hit) = first_hit(scenes, &ray, near, sensor.range[1]) else { return NOTHING };
        let incidence = -hit.normal.dot(&ray.direction);
        if hit.material != Material::Glass || draw.chance(if incidence > SQUARE_ON { 0.5 } else { 0.03 }) {
            return Echo { distance: hit.distance, incidence, dark: hit.material == Material::Dark };
        }
        // Past the second face of the pane, too.
        near = hit.distance + 0.02;
    }
    NOTHING
}

/// The points that the sensor reports for one row.
fn measure(
    sensor: &Sensor,
    raster: &Raster,
    echoes: &[Vec<Echo>],
    row: usize,
    draw: &mut Draw,
) -> Vec<[f32; 3]> {
    let noise = &sensor.noise;
    let mut points = Vec::with_capacity(echoes[row].len());
    for (column, (direction, echo)) in raster.rows[row].iter().zip(&echoes[row]).enumerate() {
        if !echo.distance.is_finite() {
            continue;
        }
        let grazing = (1.0 - echo.incidence / GRAZING).max(0.0) * 0.8;
        let lost = noise.dropout + grazing + if echo.dark { SWALLOWED } else { 0.0 };
        if draw.chance(lost) {
            continue;
        }
        let mut distance = echo.distance;
        let beside = |other: &&Echo| {
            let jump = (other.distance - distance).abs();
            jump.is_finite() && jump > EDGE.0.max(EDGE.1 * distance)
        };
        if let Some(other) = neighbours(raster, echoes, row, column).iter().flatten().find(beside)
            && draw.chance(noise.mixed)
        {
            distance += draw.between(0.0, 1.0) * (other.distance - distance);
        }
        // A camera's depth is what it measures along z, and its error grows with that.
        let depth = if sensor.looks_ahead() { distance * direction.z } else { distance };
        let measured = distance + noise.sigma(depth) * draw.normal();
        if sensor.range[0] <= measured && measured <= sensor.range[1] {
            let p: Vector3<f32> = direction * measured;
            points.push([p.x, p.y, p.z]);
        }
    }
    points
}

/// The next ray in the row, and the one beside it in the next row.
fn neighbours(raster: &Raster, echoes: &[Vec<Echo>], row: usize, column: usize) -> [Option<Echo>; 2] {
    let this = &echoes[row];
    let next = this.get(column + 1).or(if raster.wraps { this.first() } else { None }).copied();
    let below = echoes.get(row + 1).filter(|_| raster.rows_touch);
    // Rows of a panoramic scanner differ in length.
    let below = below.and_then(|below| below.get(column * below.len() / this.len())).copied();
    [next, below]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::sensor::Noise;
    use crate::simulate::solid::Solid;

    /// A wall 2.5 m to 3 m in front of a camera that stands at the origin and looks along z.
    fn wall() -> Scene {
        Scene::new(&[Solid::between(Vector3::new(-9.0, -9.0, 2.5), Vector3::new(9.0, 9.0, 3.0))])
    }

    fn scan(scene: &Scene, sensor: &Sensor) -> PointCloud {
        acquire(&[scene], sensor, &Pose::identity(), Seed(4), 0)
    }

    #[test]
    fn noise_has_the_standard_deviation_that_the_sensor_states() {
        let camera = Sensor::depth_camera(160, 120);
        let cloud = scan(&wall(), &camera);
        assert!(cloud.len() > 160 * 120 * 98 / 100);
        let errors: Vec<f64> = cloud
            .points
            .iter()
            .map(|[x, y, z]| (f64::from(*z) - 2.5) / (f64::from(*z) / f64::from(x.hypot(*y).hypot(*z))))
            .collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let deviation = (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
        let expected = f64::from(camera.noise.sigma(2.5));
        assert!(mean.abs() < 0.05 * expected, "mean {mean}");
        assert!((deviation / expected - 1.0).abs() < 0.03, "{deviation} instead of {expected}");
    }

    #[test]
    fn dropouts_are_as_frequent_as_the_sensor_states() {
        let mut camera = Sensor::depth_camera(160, 120);
        camera.noise = Noise { base: 0.0, growth: 0.0, dropout: 0.25, mixed: 0.0 };
        let share = scan(&wall(), &camera).len() as f32 / (160.0 * 120.0);
        assert!((share - 0.75).abs() < 0.01, "{share}");
    }

    #[test]
    fn flying_pixels_appear_between_two_surfaces_only_at_edges() {
        let box_in_front = Solid::between(Vector3::new(-0.3, -0.3, 1.4), Vector3::new(0.3, 0.3, 1.5));
        let mut solids = wall().solids().to_vec();
        solids.push(box_in_front);
        let mut camera = Sensor::depth_camera(160, 120);
        camera.noise = Noise { base: 0.0, growth: 0.0, dropout: 0.0, mixed: 0.5 };
        let cloud = scan(&Scene::new(&solids), &camera);
        let flying = cloud.points.iter().filter(|[_, _, z]| *z > 1.45 && *z < 2.45);
        let mut count = 0;
        for [x, y, z] in flying {
            let edge = (x / z * 1.4).abs().max((y / z * 1.4).abs());
            assert!((edge - 0.3).abs() < 0.03, "a flying pixel at {x} {y} {z}");
            count += 1;
        }
        assert!(count > 50, "{count} flying pixels");
    }

    #[test]
    fn most_rays_pass_a_pane_and_meet_what_is_behind_it() {
        let mut solids = wall().solids().to_vec();
        solids.push(
            Solid::between(Vector3::new(-9.0, -9.0, 1.0), Vector3::new(9.0, 9.0, 1.01)).of(Material::Glass),
        );
        let cloud = scan(&Scene::new(&solids), &Sensor::depth_camera(160, 120));
        let behind = cloud.points.iter().filter(|[_, _, z]| *z > 2.0).count() as f32 / cloud.len() as f32;
        assert!((0.7..0.97).contains(&behind), "{behind}");
    }
}
