//! Where the sensor stands and looks. Candidates are drawn in all rooms and doorways; stations are taken from them one
//! by one so that each shares a part of its view with an earlier one (the survey hangs together by construction) and
//! sees as much as possible that few have seen. Uses the building and the sensor; used by the survey.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Rotation3, Vector3};
use rayon::prelude::*;

use super::building::Building;
use super::draw::Draw;
use super::plan::Room;
use super::sensor::{Raster, Sensor};
use super::solid::Ray;
use crate::control::Seed;
use crate::geometry::Pose;

/// Why no stations could be chosen.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum StationError {
    /// A survey of nothing.
    #[error("a survey needs at least one station")]
    None,
    /// An overlap that no or every pair has.
    #[error("the least overlap with an earlier station must lie between 0.02 and 0.9, not {0}")]
    Overlap(f32),
    /// Too little free room: furniture is too dense, rooms too few, or the overlap too large.
    #[error("only {placed} of {wanted} stations could be placed so that each shares {overlap} of its view")]
    NotConnected {
        /// Stations found.
        placed: usize,
        /// Stations asked for.
        wanted: usize,
        /// Least share of the view.
        overlap: f32,
    },
}

/// Free space around a sensor, metres.
const CLEARANCE: f32 = 0.35;
/// The same in a doorway, which is narrow.
const DOORWAY_CLEARANCE: f32 = 0.27;
/// Rays by which a candidate's view is sampled.
const VIEW_RAYS: usize = 2000;
/// Edge of the cells in which views are compared, metres.
const CELL: f32 = 0.5;
/// Share of the view rays that must meet something: a camera does not look out of a window.
const LEAST_RETURNS: f32 = 0.4;
/// Attempts with ever more candidates.
const ATTEMPTS: usize = 3;
/// Closer together, two stations of the same heading see nearly the same, metres.
const SPACING: f32 = 1.5;

/// A pose, and the cells of surface that a sensor there sees.
struct Candidate {
    world_from_sensor: Pose,
    /// Sorted, each cell once.
    seen: Vec<u32>,
}

/// Poses (`world_from_sensor`) of `count` stations, in the order in which they were taken.
pub(super) fn choose_stations(
    building: &Building,
    sensor: &Sensor,
    count: usize,
    overlap: f32,
    seed: Seed,
) -> Result<Vec<Pose>, StationError> {
    if count == 0 {
        return Err(StationError::None);
    }
    if !(0.02..=0.9).contains(&overlap) {
        return Err(StationError::Overlap(overlap));
    }
    let mut placed = 0;
    for attempt in 0..ATTEMPTS {
        let poses = draw_candidates(building, sensor, count << attempt, seed);
        let candidates = look_around(building, sensor, poses);
        let chosen = choose(&candidates, count, overlap, &mut Draw::new(seed.derive("simulate.choose", 0)));
        placed = placed.max(chosen.len());
        let poses: Vec<Pose> = chosen.into_iter().map(|c| candidates[c].world_from_sensor).collect();
        // A few stations cannot be everywhere; enough of them should.
        let missed = count >= 2 * building.rooms.len() && misses_a_room(building, &poses);
        if poses.len() == count && (!missed || attempt + 1 == ATTEMPTS) {
            return Ok(poses);
        }
    }
    Err(StationError::NotConnected { placed, wanted: count, overlap })
}

/// Whether a room has no station inside.
fn misses_a_room(building: &Building, poses: &[Pose]) -> bool {
    building.rooms.iter().any(|room| {
        !poses
            .iter()
            .any(|pose| (0..2).all(|k| (room.low[k]..room.high[k]).contains(&(pose.translation[k] as f32))))
    })
}

/// Poses in and around all doorways, and in rooms in proportion to their area, several times as many as are wanted.
fn draw_candidates(building: &Building, sensor: &Sensor, count: usize, seed: Seed) -> Vec<Pose> {
    let mut draw = Draw::new(seed.derive("simulate.stations", count as u128));
    let headings = if sensor.looks_ahead() { 4 } else { 1 };
    let area = |room: &Room| room.size()[0] * room.size()[1];
    let whole: f32 = building.rooms.iter().map(area).sum();
    let mut poses = Vec::new();
    for doorway in &building.doorways {
        for _ in 0..8 * headings {
            let mut at = doorway.centre.map(|c| c + draw.between(-0.06, 0.06));
            // In the passage, or a step before or behind it: together these link the two rooms.
            at[1 - doorway.axis] += draw.pick([-1.1, -0.7, 0.0, 0.0, 0.7, 1.1]);
            let [x, y] = at;
            let place = Vector3::new(x, y, eye_height(&mut draw));
            if building.is_clear(&place, DOORWAY_CLEARANCE) {
                poses.push(mounted(sensor, place, &mut draw));
            }
        }
    }
    for room in &building.rooms {
        let wanted = (6.0 * count as f32 * area(room) / whole).ceil().max(6.0) as usize;
        for _ in 0..wanted {
            let free = (0..30).find_map(|_| {
                let [x, y] = [0, 1].map(|k| draw.between(room.low[k] + CLEARANCE, room.high[k] - CLEARANCE));
                let place = Vector3::new(x, y, eye_height(&mut draw));
                building.is_clear(&place, CLEARANCE).then_some(place)
            });
            if let Some(place) = free {
                poses.extend((0..headings).map(|_| mounted(sensor, place, &mut draw)));
            }
        }
    }
    poses
}

fn eye_height(draw: &mut Draw) -> f32 {
    draw.between(1.15, 1.75)
}

/// A sensor at a place, turned any way about the vertical: a camera held by hand, a scanner levelled more or
/// less.
fn mounted(sensor: &Sensor, place: Vector3<f32>, draw: &mut Draw) -> Pose {
    let heading = Rotation3::from_axis_angle(&Vector3::z_axis(), f64::from(draw.angle()));
    let rotation = if sensor.looks_ahead() {
        let pitch = f64::from(draw.between(-12.0, 22.0).to_radians());
        let roll = f64::from(draw.between(-6.0, 6.0).to_radians());
        // Columns: the camera's right, down and forward axes, for a camera that looks along the world's x.
        let ahead = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
        heading
            * Rotation3::from_axis_angle(&Vector3::y_axis(), pitch)
            * Rotation3::from_matrix_unchecked(ahead)
            * Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
    } else {
        let tilt = Vector3::new(draw.normal(), draw.normal(), 0.0)
            .map(|t| f64::from(t.to_radians() * sensor.tilt_deg));
        heading * Rotation3::new(tilt)
    };
    Pose::new(rotation, place.cast())
}

/// Looks along some rays from every pose, and keeps the poses that see enough.
fn look_around(building: &Building, sensor: &Sensor, poses: Vec<Pose>) -> Vec<Candidate> {
    let Raster { rows, .. } = sensor.raster();
    let rays: Vec<Vector3<f32>> = rows.concat();
    let stride = rays.len().div_ceil(VIEW_RAYS);
    // Starting each row elsewhere keeps a stride that divides the row's length from looking along columns only.
    let rays: Vec<_> =
        rays.chunks(stride).enumerate().filter_map(|(i, few)| few.get((i * 7) % few.len())).collect();
    let views: Vec<Vec<[i32; 4]>> = poses
        .par_iter()
        .map(|pose| {
            let rotation = pose.rotation.matrix().cast::<f32>();
            let origin = pose.translation.cast();
            let cells = rays.iter().filter_map(|direction| {
                let ray = Ray { origin, direction: rotation * **direction };
                let hit = building.scene.cast(&ray, sensor.range[0], sensor.range[1])?;
                let p = (ray.origin + ray.direction * hit.distance).map(|x| (x / CELL).floor() as i32);
                let face = hit.normal.iamax() as i32;
                let sign = i32::from(hit.normal[hit.normal.iamax()] > 0.0);
                Some([p.x, p.y, p.z, 2 * face + sign])
            });
            cells.collect()
        })
        .collect();
    let mut numbers: BTreeMap<[i32; 4], u32> = views.iter().flatten().map(|cell| (*cell, 0)).collect();
    numbers.values_mut().enumerate().for_each(|(i, number)| *number = i as u32);
    poses
        .into_iter()
        .zip(views)
        .filter(|(_, view)| view.len() as f32 > LEAST_RETURNS * rays.len() as f32)
        .map(|(world_from_sensor, view)| {
            let mut seen: Vec<u32> = view.iter().filter_map(|cell| numbers.get(cell).copied()).collect();
            seen.sort_unstable();
            seen.dedup();
            Candidate { world_from_sensor, seen }
        })
        .collect()
}

/// Share of the smaller view that the other one sees, too.
fn shared(a: &[u32], b: &[u32]) -> f32 {
    let (small, large) = if a.len() < b.len() { (a, b) } else { (b, a) };
    let common = small.iter().filter(|cell| large.binary_search(cell).is_ok()).count();
    common as f32 / small.len().max(1) as f32
}

/// Indices of up to `count` candidates, each with enough overlap with an earlier one.
fn choose(candidates: &[Candidate], count: usize, overlap: f32, draw: &mut Draw) -> Vec<usize> {
    let cells = candidates.iter().flat_map(|c| &c.seen).max().map_or(0, |last| *last as usize + 1);
    let mut times_seen = vec![0u32; cells];
    let mut link = vec![0.0f32; candidates.len()];
    let mut near = vec![f32::INFINITY; candidates.len()];
    let taste: Vec<f32> = candidates.iter().map(|_| draw.between(0.8, 1.25)).collect();
    let mut chosen: Vec<usize> = Vec::new();
    while chosen.len() < count {
        let first = chosen.is_empty();
        let worth = |c: usize| {
            let gain: f32 = candidates[c]
                .seen
                .iter()
                .map(|&cell| (1.0 + times_seen[cell as usize] as f32).powi(-2))
                .sum();
            gain * taste[c] * (near[c] / SPACING).min(1.0)
        };
        let best = (0..candidates.len())
            .filter(|c| first || (link[*c] >= overlap && !chosen.contains(c)))
            .max_by(|a, b| worth(*a).total_cmp(&worth(*b)));
        let Some(best) = best else { break };
        chosen.push(best);
        for &cell in &candidates[best].seen {
            times_seen[cell as usize] += 1;
        }
        link.par_iter_mut().zip(&mut near).zip(candidates).for_each(|((link, near), candidate)| {
            *link = link.max(shared(&candidate.seen, &candidates[best].seen));
            *near = near.min(apart(&candidate.world_from_sensor, &candidates[best].world_from_sensor));
        });
    }
    chosen
}

/// How far two stations are from seeing the same, in metres: a heading that differs by a radian counts like a metre.
fn apart(a: &Pose, b: &Pose) -> f32 {
    let ahead = |pose: &Pose| pose.rotation * Vector3::z();
    ((a.translation - b.translation).norm() + ahead(a).angle(&ahead(b))) as f32
}
