//! A ray-casting scan simulator with known truth, for tests, calibration and the demo.
//!
//! [`simulate`] draws a furnished [`Building`] from a seed, finds stations in it whose views overlap, and scans it
//! with a depth camera, a panoramic laser scanner or a spinning `LiDAR`, standing or moving: noise, dropouts, flying pixels,
//! occlusion, people who move, and the [`Hazards`] of glass, mirrors, thin structure and dark surfaces. Uses [`crate::geometry`], [`crate::cloud`] and [`crate::control`] only; the same
//! options give the same points at any number of threads.
//!
//! ```
//! use cairn::control::Seed;
//! use cairn::simulate::{BuildingOptions, Sensor, SurveyOptions, simulate};
//!
//! let building = BuildingOptions { rooms: 2, ..BuildingOptions::default() };
//! let sensor = Sensor::panoramic(5_000);
//! let survey = simulate(&SurveyOptions { building, sensor, stations: 3, seed: Seed(7), ..Default::default() })?;
//! let scan = &survey.scans[0];
//! let in_building = scan.model_from_scan.transform_point(scan.cloud.points[0]);
//! assert!(in_building[2] > -0.1 && in_building[2] < 3.1, "between floor and ceiling");
//! # Ok::<(), cairn::simulate::SurveyError>(())
//! ```

mod acquire;
mod building;
mod draw;
mod echo;
mod exposure;
mod facts;
mod footprint;
mod furnish;
mod furniture;
mod fuse;
mod hazards;
mod motion;
mod openings;
mod overlap;
mod people;
mod plan;
mod scene;
mod sensor;
mod solid;
mod stations;
mod suites;
mod survey;
mod walls;

pub use building::{Building, BuildingError, BuildingOptions};
pub use hazards::Hazards;
pub use motion::Motion;
pub use openings::Doorway;
pub use plan::{Layout, Room, RoomKind};
pub use scene::Scene;
pub use sensor::{Noise, Pattern, Sensor, SensorError};
pub use solid::{Hit, Material, Ray, Shape, Solid};
pub use stations::StationError;
pub use survey::{APART, SimulatedScan, Survey, SurveyError, SurveyOptions, simulate};
