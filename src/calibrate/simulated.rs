//! The simulated scenes that weights are fitted on: every kind of building seen by every kind of sensor, easy and hard. Used by
//! `cairn calibrate`.

use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::scene::{Placed, TrueScene};
use crate::cloud::{PointCloud, ScanKey};
use crate::control::{Cancelled, Control, Seed, Silent, Stage};
use crate::features::{
    PrepareError, PrepareOptions, SensorPosition, choose_resolution, natural_resolution, prepare,
};
use crate::simulate::{BuildingOptions, Hazards, Layout, Sensor, SurveyError, SurveyOptions, simulate};

/// A scene to simulate.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// Building and sensor, such as `office-panoramic`.
    pub name: String,
    /// One survey, or several of buildings that have nothing to do with each other.
    pub surveys: Vec<SurveyOptions>,
}

/// Why a scene cannot be simulated.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RecipeError {
    /// The simulator refuses.
    #[error("{name}: {source}")]
    Survey {
        /// The scene.
        name: String,
        /// Why.
        source: SurveyError,
    },
    /// A simulated scan cannot be prepared.
    #[error("a scan of {name}: {source}")]
    Scan {
        /// The scene.
        name: String,
        /// Why.
        source: PrepareError,
    },
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// What differs between the scenes.
struct Sketch {
    name: &'static str,
    layout: Layout,
    sensor: Sensor,
    stations: usize,
    rooms: usize,
    density: f32,
    people: usize,
    noise: f32,
    hazards: Hazards,
    least_overlap: f32,
}

impl Sketch {
    fn survey(&self, seed: Seed, most_stations: usize) -> SurveyOptions {
        SurveyOptions {
            building: BuildingOptions {
                layout: self.layout,
                rooms: self.rooms,
                density: self.density,
                hazards: self.hazards,
                ..BuildingOptions::default()
            },
            sensor: Sensor { noise: self.sensor.noise.scaled(self.noise), ..self.sensor },
            stations: self.stations.min(most_stations),
            least_overlap: self.least_overlap,
            people: self.people,
            colored: true,
            seed,
            ..SurveyOptions::default()
        }
    }
}

/// All scenes of one root seed, none with more than `most_stations` scans a building. The survey of place n in the list has the
/// seed `1000 root + n`, so that `cairn simulate` can make it again.
#[must_use]
pub fn recipes(seed: Seed, most_stations: usize) -> Vec<Recipe> {
    let mut next = 0;
    let mut survey = |sketch: &Sketch| {
        next += 1;
        sketch.survey(Seed(seed.0.wrapping_mul(1000).wrapping_add(next)), most_stations)
    };
    let mut recipes: Vec<Recipe> = sketches()
        .iter()
        .map(|sketch| Recipe { name: sketch.name.to_owned(), surveys: vec![survey(sketch)] })
        .collect();
    let two = [
        Sketch { stations: 10, rooms: 4, ..usual("", Layout::Office, Sensor::panoramic(36_000)) },
        Sketch { stations: 10, rooms: 4, ..usual("", Layout::House, Sensor::panoramic(36_000)) },
    ];
    recipes.push(Recipe {
        name: "two-buildings-panoramic".to_owned(),
        surveys: two.iter().map(survey).collect(),
    });
    recipes
}

fn usual(name: &'static str, layout: Layout, sensor: Sensor) -> Sketch {
    Sketch {
        name,
        layout,
        sensor,
        stations: 16,
        rooms: 6,
        density: 1.0,
        people: 0,
        noise: 1.0,
        hazards: Hazards::default(),
        least_overlap: 0.2,
    }
}

fn sketches() -> Vec<Sketch> {
    let panoramic = Sensor::panoramic(36_000);
    let (spinning, moving) = (Sensor::spinning_lidar(64), Sensor::moving_lidar(64));
    let (camera, fragment) = (Sensor::depth_camera(320, 240), Sensor::fragment(12));
    let hard = Hazards { glass: 0.4, mirrors: 0.2, thin: 0.7, dark: 0.3 };
    vec![
        Sketch { stations: 20, least_overlap: 0.1, ..usual("office-panoramic", Layout::Office, panoramic) },
        Sketch { hazards: hard, people: 4, ..usual("office-panoramic-hard", Layout::Office, panoramic) },
        Sketch { people: 2, ..usual("house-panoramic", Layout::House, panoramic) },
        Sketch { hazards: hard, ..usual("corridor-panoramic-hard", Layout::Corridor, panoramic) },
        Sketch { density: 0.3, ..usual("twin-rooms-panoramic", Layout::TwinRooms, panoramic) },
        Sketch { stations: 12, ..usual("hall-panoramic", Layout::Hall, panoramic) },
        Sketch { hazards: hard, people: 2, ..usual("office-spinning-hard", Layout::Office, spinning) },
        usual("house-moving-lidar", Layout::House, moving),
        Sketch { noise: 2.0, ..usual("corridor-spinning", Layout::Corridor, spinning) },
        Sketch { stations: 12, people: 3, ..usual("hall-moving-lidar", Layout::Hall, moving) },
        Sketch { stations: 40, ..usual("house-fragments", Layout::House, fragment) },
        Sketch {
            stations: 32,
            hazards: hard,
            people: 2,
            ..usual("office-fragments-hard", Layout::Office, fragment)
        },
        Sketch { stations: 40, noise: 1.5, ..usual("house-depth-camera", Layout::House, camera) },
        // Few views of few walls: what looks right and is wrong is most common here, and most varied.
        Sketch { stations: 44, ..usual("house-depth-camera-usual", Layout::House, camera) },
        Sketch { stations: 44, rooms: 5, ..usual("house-depth-camera-small", Layout::House, camera) },
        Sketch { stations: 44, rooms: 8, ..usual("house-depth-camera-large", Layout::House, camera) },
        Sketch { stations: 44, density: 0.6, ..usual("house-depth-camera-bare", Layout::House, camera) },
        Sketch {
            stations: 44,
            density: 1.4,
            people: 1,
            hazards: hard,
            ..usual("house-depth-camera-hard", Layout::House, camera)
        },
        Sketch { stations: 36, ..usual("office-depth-camera", Layout::Office, camera) },
        Sketch { stations: 36, ..usual("corridor-depth-camera", Layout::Corridor, camera) },
    ]
}

impl Recipe {
    /// Simulates the scene and prepares its scans.
    pub fn build(&self, control: Control<'_>) -> Result<TrueScene, RecipeError> {
        let mut clouds: Vec<(PointCloud, Placed)> = Vec::new();
        for (world, options) in self.surveys.iter().enumerate() {
            control.check()?;
            let survey = simulate(options)
                .map_err(|source| RecipeError::Survey { name: self.name.clone(), source })?;
            let placed = survey.scans.into_iter().map(|scan| {
                let shift = crate::geometry::Pose::from_translation(scan.cloud.origin.into());
                (scan.cloud, Placed { world, world_from_local: scan.model_from_scan * shift })
            });
            clouds.extend(placed);
        }
        let natural: Vec<f64> =
            clouds.par_iter().map(|(cloud, _)| natural_resolution(&cloud.points)).collect();
        let options = PrepareOptions::at(choose_resolution(&natural), Seed(0));
        let (done, total) = (AtomicUsize::new(0), clouds.len());
        let scans = clouds
            .into_par_iter()
            .map(|(cloud, placed)| {
                let quiet = Control { observer: &Silent, ..control };
                let prepared = prepare(key_of(&cloud), &cloud, SensorPosition::Assumed, &options, quiet);
                control.report(Stage::Prepare, 1 + done.fetch_add(1, Ordering::Relaxed), total);
                match prepared {
                    Ok(prepared) => Ok((prepared, placed)),
                    Err(PrepareError::Cancelled(cancelled)) => Err(RecipeError::Cancelled(cancelled)),
                    Err(source) => Err(RecipeError::Scan { name: self.name.clone(), source }),
                }
            })
            .collect::<Result<Vec<_>, RecipeError>>()?;
        Ok(TrueScene {
            name: self.name.clone(),
            place: self.name.clone(),
            seeds: self.surveys.iter().map(|survey| survey.seed.0).collect(),
            worlds_are_apart: true,
            scans,
        })
    }
}

/// A simulated scan is known by its points.
fn key_of(cloud: &PointCloud) -> ScanKey {
    let mut hasher = blake3::Hasher::new();
    for coordinate in cloud.points.iter().flatten() {
        hasher.update(&coordinate.to_le_bytes());
    }
    ScanKey::of_hash(&hasher.finalize(), &[])
}
