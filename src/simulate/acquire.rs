//! One scan: the sensor's rays cast into the scene, and its errors added. Each row of rays draws its own random
//! numbers, so the points do not depend on the number of threads. Used by the survey.

use rayon::prelude::*;

use super::draw::Draw;
use super::echo::{Echo, echo};
use super::fuse::fuse;
use super::motion::Way;
use super::scene::Scene;
use super::sensor::{Raster, Sensor};
use super::solid::Ray;
use crate::cloud::PointCloud;
use crate::control::Seed;
use crate::geometry::{Point, Pose};

/// Cosine of incidence below which a surface returns too little to be measured reliably.
const GRAZING: f32 = 0.15;
/// Share of rays that dark surfaces swallow.
const SWALLOWED: f32 = 0.4;
/// A jump in distance between neighbouring rays that counts as an edge: metres, and share of the distance.
const EDGE: (f32, f32) = (0.08, 0.06);
/// Voxels in which the frames of a moving camera are fused, metres.
const FUSED: f32 = 0.02;

/// What rays are cast into.
pub(super) struct Surroundings<'a> {
    /// Scenes that share a frame.
    pub scenes: &'a [&'a Scene],
    /// Share of the rays at a pane that are reflected.
    pub ghosts: f32,
    /// Whether points have the colours of what they lie on.
    pub colored: bool,
}

/// Casts all rays of a sensor, and of all its frames if it moves.
///
/// `subject` tells this scan from the others of the same seed. Points are in the sensor's frame, at the start if it moves.
pub(super) fn acquire(
    around: &Surroundings<'_>,
    sensor: &Sensor,
    world_from_sensor: &Pose,
    seed: Seed,
    subject: u64,
) -> PointCloud {
    let raster = sensor.raster();
    let way = sensor.motion.map(|motion| {
        let mut draw = Draw::new(seed.derive("simulate.way", u128::from(subject)));
        Way::draw(&motion, &mut draw, |direction| {
            let direction = (world_from_sensor.rotation * direction).cast();
            let ray = Ray { origin: world_from_sensor.translation.cast(), direction };
            let hits = around.scenes.iter().filter_map(|scene| scene.cast(&ray, 0.0, motion.way * 2.0));
            hits.map(|hit| hit.distance).fold(motion.way * 2.0, f32::min)
        })
    });
    let frames = sensor.motion.map_or(1, |motion| if sensor.looks_ahead() { motion.frames } else { 1 });
    let (mut points, mut colors) = (Vec::new(), Vec::new());
    for frame in 0..frames {
        // A camera takes a frame at one moment, a spinning sensor each column at another.
        let moment = |column: usize, columns: usize| {
            if frames > 1 { frame as f64 / (frames - 1) as f64 } else { column as f64 / columns as f64 }
        };
        let cast =
            Cast { around, sensor, raster: &raster, world_from_sensor, way: way.as_ref(), seed, subject };
        for (row_points, row_colors) in cast.frame(frame, moment) {
            points.extend(row_points);
            colors.extend(row_colors);
        }
    }
    if !around.colored {
        colors.clear();
    }
    if frames > 1 {
        fuse(&points, &colors, FUSED)
    } else {
        PointCloud { points, colors, ..PointCloud::default() }
    }
}

/// One sweep over the raster.
struct Cast<'a> {
    around: &'a Surroundings<'a>,
    sensor: &'a Sensor,
    raster: &'a Raster,
    world_from_sensor: &'a Pose,
    way: Option<&'a Way>,
    seed: Seed,
    subject: u64,
}

type Row = (Vec<Point>, Vec<[u8; 3]>);

impl Cast<'_> {
    fn draw(&self, purpose: &str, frame: usize, row: usize) -> Draw {
        let line = (frame * self.raster.rows.len() + row) as u128;
        Draw::new(self.seed.derive(purpose, (u128::from(self.subject) << 32) | line))
    }

    /// Points and colours of all rows; `moment` of a column of so many tells when it was measured.
    fn frame(&self, frame: usize, moment: impl Fn(usize, usize) -> f64 + Sync) -> Vec<Row> {
        let echoes: Vec<Vec<Echo>> = self
            .raster
            .rows
            .par_iter()
            .enumerate()
            .map(|(row, directions)| {
                let mut draw = self.draw("simulate.cast", frame, row);
                let columns = directions.iter().enumerate();
                let rays = columns.map(|(column, direction)| {
                    let pose = match self.way {
                        Some(way) => {
                            *self.world_from_sensor * way.start_from_moment(moment(column, directions.len()))
                        }
                        None => *self.world_from_sensor,
                    };
                    let rotation = pose.rotation.matrix().cast::<f32>();
                    Ray { origin: pose.translation.cast(), direction: rotation * direction }
                });
                rays.map(|ray| echo(self.around, self.sensor, ray, &mut draw)).collect()
            })
            .collect();
        (0..self.raster.rows.len())
            .into_par_iter()
            .map(|row| {
                let mut draw = self.draw("simulate.noise", frame, row);
                let measured = measure(self.sensor, self.raster, &echoes, row, &mut draw);
                let columns = self.raster.rows[row].len();
                measured
                    .into_iter()
                    .map(|(column, point)| {
                        let color = echoes[row][column].color;
                        match self.way {
                            Some(way) => {
                                let pose = way.assumed_start_from_moment(moment(column, columns));
                                (pose.transform_point(point), color)
                            }
                            None => (point, color),
                        }
                    })
                    .unzip()
            })
            .collect()
    }
}

/// The columns of one row that report a point, with the point in the frame of the sensor at that moment.
fn measure(
    sensor: &Sensor,
    raster: &Raster,
    echoes: &[Vec<Echo>],
    row: usize,
    draw: &mut Draw,
) -> Vec<(usize, Point)> {
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
            points.push((column, (direction * measured).into()));
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
    use crate::simulate::solid::{Material, Solid};
    use nalgebra::Vector3;

    /// A wall 2.5 m to 3 m in front of a camera that stands at the origin and looks along z.
    fn wall() -> Scene {
        Scene::new(&[Solid::between(Vector3::new(-9.0, -9.0, 2.5), Vector3::new(9.0, 9.0, 3.0))])
    }

    fn scan(scene: &Scene, sensor: &Sensor) -> PointCloud {
        seen(scene, sensor, 0.0)
    }

    fn seen(scene: &Scene, sensor: &Sensor, ghosts: f32) -> PointCloud {
        let around = Surroundings { scenes: &[scene], ghosts, colored: true };
        acquire(&around, sensor, &Pose::identity(), Seed(4), 0)
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

    /// A plate of a material at 1 m in front of the wall, tilted by 45 degrees, so that it reflects what is far to the right (+x).
    fn behind_a_plate(material: Material) -> Scene {
        let mut solids = wall().solids().to_vec();
        let tilt =
            *nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), -std::f32::consts::FRAC_PI_4).matrix();
        let plate =
            Solid::between(Vector3::new(-0.5, -0.5, -0.005), Vector3::new(0.5, 0.5, 0.005)).of(material);
        solids.push(plate.moved(&tilt, &Vector3::new(0.0, 0.0, 1.0)));
        for side in [-1.0f32, 1.0] {
            let (near, far) = (side * 3.0, side * 3.2);
            let (low, high) = (near.min(far), near.max(far));
            solids.push(
                Solid::between(Vector3::new(low, -9.0, -9.0), Vector3::new(high, 9.0, 9.0))
                    .painted([9, 8, 7]),
            );
        }
        Scene::new(&solids)
    }

    #[test]
    fn mirrors_show_ghosts_behind_them_and_panes_show_few() {
        let mut camera = Sensor::depth_camera(80, 60);
        camera.noise = Noise { base: 0.0, growth: 0.0, dropout: 0.0, mixed: 0.0 };
        // Through the plate's middle a ray goes 1 m ahead, then 3 m aside: a ghost 4 m away, painted like the side wall.
        let ghosts = |material, share| {
            let cloud = seen(&behind_a_plate(material), &camera, share);
            let middle =
                cloud.points.iter().zip(&cloud.colors).filter(|([x, y, z], _)| (x / z).hypot(y / z) < 0.1);
            let all = middle.clone().count() as f32;
            middle.filter(|([.., z], color)| (3.4..4.8).contains(z) && **color == [9, 8, 7]).count() as f32
                / all
        };
        assert!(ghosts(Material::Mirror, 0.0) > 0.95);
        assert!(ghosts(Material::Matte, 0.5) < 0.01);
        assert!((0.2..0.4).contains(&ghosts(Material::Glass, 0.3)));
        assert!(ghosts(Material::Glass, 0.0) < 0.01);
    }

    #[test]
    fn a_moving_camera_sees_more_than_its_first_frame_and_errs_by_its_drift() {
        let sensor = Sensor::fragment(8);
        let (fused, first) = (scan(&wall(), &sensor), scan(&wall(), &Sensor { motion: None, ..sensor }));
        let wide = |cloud: &PointCloud| {
            cloud.points.iter().map(|[x, y, z]| (x / z).abs().max((y / z).abs())).fold(0.0, f32::max)
        };
        assert!(wide(&fused) > wide(&first) + 0.03, "{} and {}", wide(&fused), wide(&first));
        let mut errors: Vec<f32> = fused.points.iter().map(|p| (p[2] - 2.5).abs()).collect();
        errors.sort_by(f32::total_cmp);
        assert!(errors[errors.len() / 2] < 0.02, "median error {} m", errors[errors.len() / 2]);
    }

    #[test]
    fn a_moving_lidar_maps_its_columns_back_to_its_start() {
        let room =
            |side: f32| Solid::between(Vector3::new(-side, -side, -2.0), Vector3::new(side, side, 2.0));
        let scene = Scene::new(&[room(4.0)]);
        let cloud = scan(&scene, &Sensor::moving_lidar(16));
        let off = cloud
            .points
            .iter()
            .filter(|p| p[0].abs().max(p[1].abs()) - 4.0 > 0.15 || p[2].abs() > 2.15)
            .count();
        assert!(cloud.len() > 10_000 && off * 100 < cloud.len(), "{off} of {}", cloud.len());
    }
}
