//! `cairn simulate`: writes a simulated survey as files, with its truth beside. Uses [`crate::simulate`].

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use serde::Serialize;

use crate::cloud::PlyWriter;
use crate::control::Seed;
use crate::geometry::Point;
use crate::simulate::{BuildingOptions, Layout, Noise, Sensor, Survey, SurveyOptions, simulate};

/// Simulate scans of a furnished building, with the true poses beside
#[derive(Debug, Clone, clap::Args)]
pub struct SimulateArgs {
    /// Folder to write: scans/*.ply, and poses.json with the truth
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What kind of building
    #[arg(long, value_enum, default_value_t = Kind::Office)]
    pub kind: Kind,
    /// What scans it
    #[arg(long, value_enum, default_value_t = SensorKind::Panoramic)]
    pub sensor: SensorKind,
    /// Number of scans
    #[arg(long, default_value_t = 24)]
    pub stations: usize,
    /// Number of rooms, a corridor not counted
    #[arg(long, default_value_t = 6)]
    pub rooms: usize,
    /// Another seed, another building
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// How much furniture: 0 none, 1 usual, 2 packed
    #[arg(long, default_value_t = 1.0)]
    pub density: f32,
    /// People who stand around the sensor, elsewhere in every scan
    #[arg(long, default_value_t = 0)]
    pub people: usize,
    /// Factor on the sensor's noise, dropouts and flying pixels
    #[arg(long, default_value_t = 1.0)]
    pub noise: f32,
    /// Least share of its view that each scan has in common with another
    #[arg(long, default_value_t = 0.3)]
    pub least_overlap: f32,
    /// Replace the scans of an earlier run in the folder
    #[arg(long)]
    pub force: bool,
    /// Print what was written as JSON
    #[arg(long)]
    pub json: bool,
}

/// What kind of building to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Kind {
    /// Rows of work rooms
    Office,
    /// Rows of living rooms
    House,
    /// Rooms along a corridor
    Corridor,
    /// Identical rooms along a corridor
    TwinRooms,
    /// One large, nearly symmetric hall
    Hall,
}

/// What kind of sensor to simulate.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum SensorKind {
    /// 320 x 240 pixels, 58 x 45 degrees, 0.4 to 5 m
    DepthCamera,
    /// 36,000 rays all around, 0.3 to 30 m
    Panoramic,
    /// 64 rings of 1,024 rays, 0.5 to 100 m
    SpinningLidar,
}

/// What was written.
#[derive(Debug, Serialize)]
struct Report {
    scans: usize,
    points: usize,
    rooms: usize,
}

impl SimulateArgs {
    fn options(&self) -> SurveyOptions {
        let layout = match self.kind {
            Kind::Office => Layout::Office,
            Kind::House => Layout::House,
            Kind::Corridor => Layout::Corridor,
            Kind::TwinRooms => Layout::TwinRooms,
            Kind::Hall => Layout::Hall,
        };
        let sensor = match self.sensor {
            SensorKind::DepthCamera => Sensor::depth_camera(320, 240),
            SensorKind::Panoramic => Sensor::panoramic(36_000),
            SensorKind::SpinningLidar => Sensor::spinning_lidar(64),
        };
        let noise: Noise = sensor.noise.scaled(self.noise);
        SurveyOptions {
            building: BuildingOptions {
                layout,
                rooms: self.rooms,
                density: self.density,
                ..BuildingOptions::default()
            },
            sensor: Sensor { noise, ..sensor },
            stations: self.stations,
            least_overlap: self.least_overlap,
            people: self.people,
            seed: Seed(self.seed),
            ..SurveyOptions::default()
        }
    }
}

/// Simulates and writes.
pub fn run(args: &SimulateArgs) -> anyhow::Result<()> {
    let options = args.options();
    options.validate()?;
    prepare_folder(&args.out, args.force)?;
    let survey = simulate(&options)?;
    write_survey(&survey, &args.out)?;
    let report = Report {
        scans: survey.scans.len(),
        points: survey.scans.iter().map(|scan| scan.cloud.len()).sum(),
        rooms: survey.building.rooms.len(),
    };
    if args.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        let Report { scans, points, rooms } = report;
        println!("wrote {scans} scans with {points} points of {rooms} rooms to {}", args.out.display());
    }
    Ok(())
}

/// Makes the folder, and refuses or clears one that holds something.
fn prepare_folder(out: &Path, force: bool) -> anyhow::Result<()> {
    let scans = out.join("scans");
    fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    let empty = fs::read_dir(out).with_context(|| format!("cannot read {}", out.display()))?.next().is_none();
    if !empty && !force {
        bail!("{} is not empty; give --force to replace the scans in it", out.display());
    }
    fs::create_dir_all(&scans).with_context(|| format!("cannot create {}", scans.display()))?;
    for entry in fs::read_dir(&scans).with_context(|| format!("cannot read {}", scans.display()))? {
        let path = entry?.path();
        // Only what an earlier run wrote: a foreign file in between would spoil the truth, so it stops us.
        ensure!(
            path.extension().is_some_and(|extension| extension == "ply"),
            "{} was not written by a simulation; move it away first",
            path.display()
        );
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(())
}

/// Writes `scans/<name>.ply` and `poses.json`: file name to 4x4 row-major `model_from_scan`.
pub fn write_survey(survey: &Survey, out: &Path) -> anyhow::Result<()> {
    let scans = out.join("scans");
    fs::create_dir_all(&scans).with_context(|| format!("cannot create {}", scans.display()))?;
    let mut poses = BTreeMap::new();
    for scan in &survey.scans {
        let file = format!("{}.ply", scan.name);
        let path = scans.join(&file);
        write_ply(&scan.cloud.points, &path).with_context(|| format!("cannot write {}", path.display()))?;
        poses.insert(file, scan.model_from_scan.to_rows());
    }
    let path = out.join("poses.json");
    let text = serde_json::to_string_pretty(&poses)?;
    fs::write(&path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}

/// Writes bare points as a binary PLY file.
fn write_ply(points: &[Point], path: &Path) -> io::Result<()> {
    let mut writer = PlyWriter::new(BufWriter::new(File::create(path)?), false, &[])?;
    points.iter().try_for_each(|point| writer.point(*point))?;
    writer.finish()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, clap::Parser)]
    struct Line {
        #[command(flatten)]
        args: SimulateArgs,
    }

    fn parse(out: &Path, more: &str) -> SimulateArgs {
        let out = out.to_str().unwrap();
        Line::parse_from(["cairn", "--out", out].into_iter().chain(more.split_whitespace())).args
    }

    #[test]
    fn every_scan_gets_a_file_and_a_true_pose_and_the_seed_decides_their_bytes() {
        let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
        for folder in &folders {
            run(&parse(folder.path(), "--stations 3 --rooms 2 --seed 5 --json")).unwrap();
        }
        let read = |folder: &Path| fs::read_to_string(folder.join("poses.json")).unwrap();
        let poses: BTreeMap<String, [[f64; 4]; 4]> = serde_json::from_str(&read(folders[0].path())).unwrap();
        assert_eq!(poses.len(), 3);
        assert_eq!(read(folders[0].path()), read(folders[1].path()));
        for name in poses.keys() {
            let [a, b] = [0, 1].map(|i| fs::read(folders[i].path().join("scans").join(name)).unwrap());
            assert!(a.starts_with(b"ply\nformat binary_little_endian 1.0\n") && a.len() > 100_000);
            assert_eq!(a, b);
        }
    }

    #[test]
    fn a_folder_that_holds_something_is_kept_unless_forced() {
        let folder = tempfile::tempdir().unwrap();
        let options = "--stations 2 --rooms 1 --kind hall";
        run(&parse(folder.path(), options)).unwrap();
        let again = run(&parse(folder.path(), options)).unwrap_err();
        assert!(again.to_string().contains("not empty"), "{again}");
        run(&parse(folder.path(), &format!("{options} --force --seed 1"))).unwrap();
        assert_eq!(fs::read_dir(folder.path().join("scans")).unwrap().count(), 2);
        fs::write(folder.path().join("scans/notes.txt"), "mine").unwrap();
        assert!(run(&parse(folder.path(), &format!("{options} --force"))).is_err());
        assert!(folder.path().join("scans/notes.txt").exists());
    }
}
