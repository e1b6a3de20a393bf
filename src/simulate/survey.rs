//! A whole survey: a building, stations in it, and one scan from each, with the truth. The only entry point that most
//! users of the simulator need.

use std::collections::BTreeSet;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::acquire::{Surroundings, acquire};
use super::building::{Building, BuildingError, BuildingOptions};
use super::draw::Draw;
use super::exposure::expose;
use super::people::people_around;
use super::scene::Scene;
use super::sensor::{Sensor, SensorError};
use super::stations::{StationError, choose_stations};
use crate::cloud::PointCloud;
use crate::control::Seed;
use crate::geometry::Pose;

/// What to simulate.
#[derive(Debug, Clone, PartialEq)]
pub struct SurveyOptions {
    /// The building.
    pub building: BuildingOptions,
    /// The sensor at every station.
    pub sensor: Sensor,
    /// Number of scans.
    pub stations: usize,
    /// Least share of its view that a station has in common with an earlier one, 0.02 to 0.9.
    pub least_overlap: f32,
    /// People around the sensor, elsewhere in every scan.
    pub people: usize,
    /// Whether points have the colours of what they lie on, as exposed in each scan.
    pub colored: bool,
    /// Rigs that share the work; each scans its own part of the building.
    pub rigs: usize,
    /// Everything random follows from it.
    pub seed: Seed,
}

impl Default for SurveyOptions {
    fn default() -> Self {
        Self {
            building: BuildingOptions::default(),
            sensor: Sensor::panoramic(36_000),
            stations: 24,
            least_overlap: 0.3,
            people: 0,
            colored: false,
            rigs: 1,
            seed: Seed(0),
        }
    }
}

/// Why a survey cannot be simulated.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum SurveyError {
    /// See [`BuildingError`].
    #[error(transparent)]
    Building(#[from] BuildingError),
    /// See [`SensorError`].
    #[error(transparent)]
    Sensor(#[from] SensorError),
    /// See [`StationError`].
    #[error(transparent)]
    Stations(#[from] StationError),
    /// Nobody to carry the sensor.
    #[error("a survey needs at least one rig")]
    NoRig,
}

impl SurveyOptions {
    /// What the demo shows: an office of six furnished rooms, two rigs, 24 scans by a panoramic scanner.
    #[must_use]
    pub fn demo(seed: Seed) -> Self {
        Self { rigs: 2, seed, ..Self::default() }
    }

    /// Checks every value that can be checked without building anything.
    pub fn validate(&self) -> Result<(), SurveyError> {
        self.building.validate()?;
        self.sensor.validate()?;
        if self.stations == 0 {
            return Err(StationError::None.into());
        }
        if self.rigs == 0 {
            return Err(SurveyError::NoRig);
        }
        Ok(())
    }
}

/// One scan and the truth about it.
#[derive(Debug, Clone, PartialEq)]
pub struct SimulatedScan {
    /// Says nothing about where or when the scan was taken.
    pub name: String,
    /// In the sensor's frame, with the sensor at the origin.
    pub cloud: PointCloud,
    /// The true pose of the sensor; the model frame is the building's.
    pub model_from_scan: Pose,
    /// Which rig took it, from 0.
    pub rig: usize,
    /// Which of the survey's buildings it shows.
    pub building: usize,
    /// At which visit it was taken, from 0; furniture may have been moved between two.
    pub visit: usize,
}

/// A simulated survey.
#[derive(Debug, Clone)]
pub struct Survey {
    /// The buildings that were scanned, each in its own frame; usually one. The second one stands [`APART`] metres from the first
    /// along x in the model frame, and so on.
    pub buildings: Vec<Building>,
    /// The scans, sorted by their meaningless names.
    pub scans: Vec<SimulatedScan>,
}

/// Unrelated buildings are this far from each other in the model frame, metres: hundreds of times as far as any of them is wide.
pub const APART: f64 = 10_000.0;

/// Simulates a survey: the same for the same options, at any number of threads of the ambient rayon pool.
pub fn simulate(options: &SurveyOptions) -> Result<Survey, SurveyError> {
    options.validate()?;
    let seed = options.seed;
    let building = Building::new(&options.building, seed)?;
    let poses = choose_stations(&building, &options.sensor, options.stations, options.least_overlap, seed)?;
    let rigs = assign_rigs(&building, &poses, options.rigs);
    let names = draw_names(poses.len(), &mut Draw::new(seed.derive("simulate.names", 0)));
    let stations = poses.len();
    let mut scans: Vec<SimulatedScan> = poses
        .into_par_iter()
        .zip(rigs)
        .zip(names)
        .enumerate()
        .map(|(station, ((model_from_scan, rig), name))| {
            let mut draw = Draw::new(seed.derive("simulate.people", station as u128));
            let visit = usize::from(building.later.is_some() && 2 * station >= stations);
            let eye: Vector3<f32> = model_from_scan.translation.cast();
            let people: Scene = people_around(&building, &eye, options.people, &mut draw);
            let around = Surroundings {
                scenes: &[building.scene_at(visit), &people],
                ghosts: options.building.hazards.ghosts(),
                colored: options.colored,
            };
            let mut cloud = acquire(&around, &options.sensor, &model_from_scan, seed, station as u64);
            expose(&mut cloud.colors, &mut Draw::new(seed.derive("simulate.exposure", station as u128)));
            SimulatedScan { name, cloud, model_from_scan, rig, building: 0, visit }
        })
        .collect();
    scans.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(Survey { buildings: vec![building], scans })
}

/// Cuts the stations into equal parts along the longer side of the building.
fn assign_rigs(building: &Building, poses: &[Pose], rigs: usize) -> Vec<usize> {
    let (low, high) = building.scene.bounds();
    let axis = usize::from(high.y - low.y > high.x - low.x);
    let mut order: Vec<usize> = (0..poses.len()).collect();
    order.sort_by(|a, b| poses[*a].translation[axis].total_cmp(&poses[*b].translation[axis]));
    let mut rig_of = vec![0; poses.len()];
    for (rank, station) in order.into_iter().enumerate() {
        rig_of[station] = rank * rigs / poses.len();
    }
    rig_of
}

fn draw_names(count: usize, draw: &mut Draw) -> Vec<String> {
    let mut names = BTreeSet::new();
    while names.len() < count {
        names.insert(format!("scan-{:06x}", draw.count(0, 0xff_ffff)));
    }
    let mut names: Vec<String> = names.into_iter().collect();
    draw.shuffle(&mut names);
    names
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::overlap::Neighbourhood;
    use crate::simulate::plan::Layout;
    use crate::simulate::solid::Ray;

    fn small(layout: Layout, sensor: Sensor, stations: usize) -> SurveyOptions {
        let building = BuildingOptions { layout, rooms: 4, ..BuildingOptions::default() };
        SurveyOptions { building, sensor, stations, seed: Seed(9), ..SurveyOptions::default() }
    }

    /// Whether links of at least `least` overlap in either direction join all scans.
    fn is_connected(overlaps: &[Vec<f64>], least: f64) -> bool {
        let mut reached = vec![false; overlaps.len()];
        let mut open = vec![0];
        while let Some(i) = open.pop() {
            if !std::mem::replace(&mut reached[i], true) {
                open.extend((0..overlaps.len()).filter(|&j| overlaps[i][j].max(overlaps[j][i]) >= least));
            }
        }
        reached.iter().all(|&r| r)
    }

    /// From a point to the plane through the points of a flat neighbourhood.
    fn distance_to_plane(index: &Neighbourhood, point: Vector3<f32>) -> Option<f32> {
        let near: Vec<_> = index.around(&point).collect();
        let mean = near.iter().copied().sum::<Vector3<f32>>() / near.len().max(1) as f32;
        let spread =
            near.iter().map(|p| *p - mean).map(|d| d * d.transpose()).sum::<nalgebra::Matrix3<f32>>();
        let eigen = (spread / near.len().max(1) as f32).symmetric_eigen();
        let least = eigen.eigenvalues.imin();
        let flat = near.len() >= 8 && eigen.eigenvalues[least] < 0.006f32.powi(2);
        flat.then(|| (point - mean).dot(&eigen.eigenvectors.column(least)).abs())
    }

    #[test]
    fn the_truth_maps_scans_onto_each_other_at_noise_level() {
        let survey = simulate(&small(Layout::Office, Sensor::panoramic(60_000), 6)).unwrap();
        let overlaps = survey.overlaps(0.1);
        let mut pairs = 0;
        for (i, of) in survey.scans.iter().enumerate() {
            for (j, with) in survey.scans.iter().enumerate() {
                if i == j || overlaps[i][j] < 0.6 {
                    continue;
                }
                let index = Neighbourhood::new(&with.cloud, &with.model_from_scan, 0.1);
                let mut distances: Vec<f32> = of
                    .cloud
                    .points
                    .iter()
                    .step_by(7)
                    .filter_map(|p| distance_to_plane(&index, of.model_from_scan.transform_point(*p).into()))
                    .collect();
                distances.sort_by(f32::total_cmp);
                let median = distances[distances.len() / 2];
                // 0.67 sigma is the median of a normal error; the plane errs, too.
                assert!(median < 1.2 * Sensor::panoramic(1).noise.sigma(4.0), "median {median} m");
                pairs += 1;
            }
        }
        assert!(pairs > 2, "only {pairs} pairs overlap");
    }

    #[test]
    fn a_survey_is_the_same_at_one_and_two_threads() {
        let mut options = small(Layout::House, Sensor::panoramic(4000), 5);
        options.people = 2;
        let run = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| simulate(&options)).unwrap().scans
        };
        let (one, two) = (run(1), run(2));
        assert_eq!(one, two);
        options.seed = Seed(10);
        assert_ne!(one, simulate(&options).unwrap().scans);
    }

    #[test]
    fn the_scans_of_every_layout_and_sensor_hang_together() {
        for (layout, sensor, stations) in [
            (Layout::Office, Sensor::panoramic(20_000), 12),
            (Layout::House, Sensor::panoramic(20_000), 12),
            (Layout::Corridor, Sensor::panoramic(20_000), 12),
            (Layout::TwinRooms, Sensor::spinning_lidar(64), 10),
            (Layout::Hall, Sensor::spinning_lidar(64), 6),
            (Layout::Warehouse, Sensor::panoramic(20_000), 8),
            (Layout::House, Sensor::depth_camera(160, 120), 30),
        ] {
            let survey = simulate(&small(layout, sensor, stations)).unwrap();
            assert_eq!(survey.scans.len(), stations);
            assert!(is_connected(&survey.overlaps(0.15), 0.2), "{layout:?} falls apart");
            for scan in &survey.scans {
                assert!(scan.cloud.len() > 3000, "{layout:?}: {} points", scan.cloud.len());
                let nearest =
                    scan.cloud.points.iter().map(|[x, y, z]| x.hypot(*y).hypot(*z)).fold(9.0, f32::min);
                assert!(nearest > 0.2, "{layout:?}: a point {nearest} m from the sensor");
            }
        }
    }

    #[test]
    fn two_stations_a_room_leave_no_room_out() {
        for seed in 0..12 {
            let options = SurveyOptions {
                seed: Seed(seed),
                sensor: Sensor::panoramic(3000),
                ..SurveyOptions::demo(Seed(0))
            };
            let survey = simulate(&options).unwrap();
            for room in &survey.buildings[0].rooms {
                let inside = |scan: &SimulatedScan| {
                    (0..2).all(|k| {
                        (room.low[k]..room.high[k]).contains(&(scan.model_from_scan.translation[k] as f32))
                    })
                };
                assert!(survey.scans.iter().any(inside), "seed {seed}: nobody stood in {room:?}");
            }
        }
    }

    #[test]
    fn names_are_unique_and_say_nothing_about_the_order() {
        let names = draw_names(400, &mut Draw::new(Seed(1).derive("test", 0)));
        let unique: BTreeSet<_> = names.iter().collect();
        assert_eq!(unique.len(), names.len());
        let rising = names.windows(2).filter(|pair| pair[0] < pair[1]).count();
        assert!((150..250).contains(&rising), "{rising} of 399 rise");
    }

    #[test]
    fn rigs_share_the_scans_evenly_and_each_has_its_part_of_the_building() {
        let mut options = small(Layout::Office, Sensor::panoramic(2000), 9);
        options.rigs = 2;
        let survey = simulate(&options).unwrap();
        let of_rig = |rig| survey.scans.iter().filter(move |scan| scan.rig == rig);
        assert_eq!((of_rig(0).count(), of_rig(1).count()), (5, 4));
        let (low, high) = survey.buildings[0].scene.bounds();
        let axis = usize::from(high.y - low.y > high.x - low.x);
        let end = of_rig(0).map(|scan| scan.model_from_scan.translation[axis]).fold(f64::MIN, f64::max);
        assert!(of_rig(1).all(|scan| scan.model_from_scan.translation[axis] >= end));
    }

    #[test]
    fn buildings_beside_each_other_keep_their_scans_apart_and_mix_their_names() {
        let options = small(Layout::Hall, Sensor::panoramic(3000), 3);
        let one = simulate(&options).unwrap();
        let both = one.clone().beside(one.clone());
        assert_eq!((both.buildings.len(), both.scans.len()), (2, 6));
        let names: BTreeSet<&String> = both.scans.iter().map(|scan| &scan.name).collect();
        assert_eq!(names.len(), 6, "names of both are unique");
        assert!(both.scans.is_sorted_by(|a, b| a.name < b.name));
        let second: Vec<_> = both.scans.iter().filter(|scan| scan.building == 1).collect();
        assert_eq!(second.len(), 3);
        assert!(second.iter().all(|scan| scan.model_from_scan.translation.x > 0.9 * APART));
        let third = both.clone().beside(one);
        assert_eq!(third.scans.iter().map(|scan| scan.building).max(), Some(2));
        for (i, row) in both.overlaps(0.15).iter().enumerate() {
            for (j, share) in row.iter().enumerate() {
                assert!(both.scans[i].building == both.scans[j].building || *share == 0.0);
            }
        }
    }

    #[test]
    fn people_are_in_one_scan_and_gone_in_another() {
        let mut options = small(Layout::Hall, Sensor::panoramic(8000), 3);
        let empty = simulate(&options).unwrap();
        options.people = 4;
        let busy = simulate(&options).unwrap();
        for (without, with) in empty.scans.iter().zip(&busy.scans) {
            assert_eq!(without.model_from_scan, with.model_from_scan);
            assert_ne!(without.cloud, with.cloud);
        }
    }

    #[test]
    fn furniture_that_was_moved_is_elsewhere_in_half_of_the_scans_and_walls_are_not() {
        let mut options = small(Layout::Office, Sensor::panoramic(8000), 6);
        options.building.moved = 0.5;
        let moved = simulate(&options).unwrap();
        assert_eq!(moved.scans.iter().filter(|scan| scan.visit == 1).count(), 3);
        let building = &moved.buildings[0];
        for scan in &moved.scans {
            let (eye, rotation) = (scan.model_from_scan.translation, scan.model_from_scan.rotation);
            // How far a scan's points lie from what its rays would meet at the other visit.
            let elsewhere = scan.cloud.points.iter().filter(|point| {
                let ray = rotation * Vector3::from(**point).cast::<f64>();
                let ray = Ray { origin: eye.cast(), direction: ray.normalize().cast() };
                let met = building.scene_at(1 - scan.visit).cast(&ray, 0.0, 100.0);
                met.is_none_or(|hit| (hit.distance - Vector3::from(**point).norm()).abs() > 0.1)
            });
            let share = elsewhere.count() as f32 / scan.cloud.len() as f32;
            assert!((0.03..0.6).contains(&share), "{share} of {} has changed", scan.name);
        }
        options.building.moved = 1.1;
        assert!(matches!(
            simulate(&options),
            Err(SurveyError::Building(BuildingError::Share("moved furniture", _)))
        ));
    }

    #[test]
    fn a_survey_without_rigs_or_stations_is_refused() {
        let usual = SurveyOptions::default();
        let no_rig = SurveyOptions { rigs: 0, ..usual.clone() };
        assert_eq!(simulate(&no_rig).map(|_| ()), Err(SurveyError::NoRig));
        let no_station = SurveyOptions { stations: 0, ..usual };
        assert_eq!(simulate(&no_station).map(|_| ()), Err(SurveyError::Stations(StationError::None)));
    }
}
