//! `cairn simulate`: writes a simulated survey as files, with its truth beside. Uses [`crate::simulate`].

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use serde::Serialize;

use crate::cloud::{PlyWriter, PointCloud};
use crate::control::Seed;
use crate::simulate::{BuildingOptions, Hazards, Layout, Noise, Sensor, Survey, SurveyOptions, simulate};

/// Simulate scans of a furnished building, with the true poses beside
#[derive(Debug, Clone, clap::Args)]
pub struct SimulateArgs {
    /// Folder to write: scans/*.ply, and the truth in poses.json, overlaps.json and groups.json
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What kind of building. Several, with commas: unrelated buildings that share the scans, 10 km from each other in poses.json
    #[arg(long, value_enum, value_delimiter = ',', default_value = "office")]
    pub kind: Vec<Kind>,
    /// What scans it
    #[arg(long, value_enum, default_value_t = SensorKind::Panoramic)]
    pub sensor: SensorKind,
    /// Number of scans, of all buildings together
    #[arg(long, default_value_t = 24)]
    pub stations: usize,
    /// Number of rooms of a building, a corridor not counted
    #[arg(long, default_value_t = 6)]
    pub rooms: usize,
    /// Another seed, another building
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// How much furniture: 0 none, 1 usual, 2 packed
    #[arg(long, default_value_t = 1.0)]
    pub density: f32,
    /// Share of the furniture that is moved before the second half of the scans is taken, 0 to 1
    #[arg(long, default_value_t = 0.0)]
    pub moved: f32,
    /// People who stand around the sensor, elsewhere in every scan
    #[arg(long, default_value_t = 0)]
    pub people: usize,
    /// Share of the inner walls and doors that are of glass, 0 to 1; with any there is something to see outside, and panes make ghosts
    #[arg(long, default_value_t = 0.0)]
    pub glass: f32,
    /// Share of the rooms with a mirror, 0 to 1
    #[arg(long, default_value_t = 0.0)]
    pub mirrors: f32,
    /// Share of the windows with blinds and of the rooms with cables, poles and railings, 0 to 1
    #[arg(long, default_value_t = 0.0)]
    pub thin: f32,
    /// Share of the furniture that swallows rays, 0 to 1
    #[arg(long, default_value_t = 0.0)]
    pub dark: f32,
    /// How badly a tripod is levelled: standard deviation of each tilt, degrees
    #[arg(long, default_value_t = 0.7, value_name = "DEGREES")]
    pub tilt: f32,
    /// Give every surface a colour, and every point that of its surface
    #[arg(long)]
    pub color: bool,
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
    /// One large hall with rows of pallet racks, all alike but for what is stored in them
    Warehouse,
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
    /// Twelve frames of a depth camera that moves by 0.4 m, fused in the frame of the first
    Fragment,
    /// A spinning lidar that moves by 0.3 m during its revolution
    MovingLidar,
}

/// What was written.
#[derive(Debug, Serialize)]
struct Report {
    scans: usize,
    points: usize,
    rooms: usize,
}

impl SimulateArgs {
    /// What to simulate, one entry a building.
    fn options(&self) -> Vec<SurveyOptions> {
        let sensor = match self.sensor {
            SensorKind::DepthCamera => Sensor::depth_camera(320, 240),
            SensorKind::Panoramic => Sensor::panoramic(36_000),
            SensorKind::SpinningLidar => Sensor::spinning_lidar(64),
            SensorKind::Fragment => Sensor::fragment(12),
            SensorKind::MovingLidar => Sensor::moving_lidar(64),
        };
        let noise: Noise = sensor.noise.scaled(self.noise);
        let count = self.kind.len();
        let building = |(number, kind): (usize, &Kind)| SurveyOptions {
            building: BuildingOptions {
                layout: match kind {
                    Kind::Office => Layout::Office,
                    Kind::House => Layout::House,
                    Kind::Corridor => Layout::Corridor,
                    Kind::TwinRooms => Layout::TwinRooms,
                    Kind::Hall => Layout::Hall,
                    Kind::Warehouse => Layout::Warehouse,
                },
                rooms: self.rooms,
                density: self.density,
                moved: self.moved,
                hazards: Hazards {
                    glass: self.glass,
                    mirrors: self.mirrors,
                    thin: self.thin,
                    dark: self.dark,
                },
                ..BuildingOptions::default()
            },
            sensor: Sensor { noise, tilt_deg: self.tilt, ..sensor },
            stations: self.stations / count + usize::from(number < self.stations % count),
            least_overlap: self.least_overlap,
            people: self.people,
            colored: self.color,
            seed: building_seed(self.seed, number),
            ..SurveyOptions::default()
        };
        self.kind.iter().enumerate().map(building).collect()
    }
}

/// The first building has the seed that was given, so that it is the same with and without others.
fn building_seed(seed: u64, number: usize) -> Seed {
    Seed(seed.wrapping_add((number as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15)))
}

/// Simulates and writes.
pub fn run(args: &SimulateArgs) -> anyhow::Result<()> {
    let options = args.options();
    for building in &options {
        building.validate()?;
    }
    prepare_folder(&args.out, args.force)?;
    let mut surveys = Vec::with_capacity(options.len());
    for building in &options {
        surveys.push(simulate(building)?);
    }
    let survey = surveys.into_iter().reduce(Survey::beside).context("there is no building to simulate")?;
    write_survey(&survey, &args.out)?;
    write_facts(&survey, &args.out)?;
    let report = Report {
        scans: survey.scans.len(),
        points: survey.scans.iter().map(|scan| scan.cloud.len()).sum(),
        rooms: survey.buildings.iter().map(|building| building.rooms.len()).sum(),
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
        write_ply(&scan.cloud, &path).with_context(|| format!("cannot write {}", path.display()))?;
        poses.insert(file, scan.model_from_scan.to_rows());
    }
    write_json(&out.join("poses.json"), &poses)
}

/// Neighbours within this distance make a point one that two scans have in common, metres.
const IN_COMMON: f32 = 0.15;

/// What two scans have in common under the truth.
#[derive(Debug, Serialize)]
struct PairFacts<'a> {
    a: &'a str,
    b: &'a str,
    /// Share of the points of `a` that the sensor of `b` saw, too.
    a_seen_by_b: f64,
    b_seen_by_a: f64,
}

/// Where a scan was taken.
#[derive(Debug, Serialize)]
struct ScanFacts {
    building: usize,
    /// `None` in a doorway.
    room: Option<usize>,
    /// Rooms of a building with the same number are furnished alike.
    furnished_like: Option<u64>,
    /// Furniture may have been moved between two visits.
    visit: usize,
    points: usize,
}

/// Writes what a judge needs to know whether the data decide: `overlaps.json`, the pairs of scans with anything in common, and
/// `groups.json`, the building and room of every scan.
fn write_facts(survey: &Survey, out: &Path) -> anyhow::Result<()> {
    let files: Vec<String> = survey.scans.iter().map(|scan| format!("{}.ply", scan.name)).collect();
    let shared = survey.shared_views(IN_COMMON);
    let pairs: Vec<PairFacts<'_>> = (0..files.len())
        .flat_map(|i| (i + 1..files.len()).map(move |j| (i, j)))
        .map(|(i, j)| PairFacts {
            a: &files[i],
            b: &files[j],
            a_seen_by_b: rounded(shared[i][j]),
            b_seen_by_a: rounded(shared[j][i]),
        })
        .filter(|pair| pair.a_seen_by_b.max(pair.b_seen_by_a) > 0.0)
        .collect();
    let groups: BTreeMap<&str, ScanFacts> = survey
        .scans
        .iter()
        .zip(&files)
        .map(|(scan, file)| {
            let room = survey.room_of(scan);
            let rooms = survey.buildings.get(scan.building).map(|building| &building.rooms);
            let furnished_like = room.and_then(|room| rooms?.get(room)).map(|room| room.identity);
            let facts = ScanFacts {
                building: scan.building,
                room,
                furnished_like,
                visit: scan.visit,
                points: scan.cloud.len(),
            };
            (file.as_str(), facts)
        })
        .collect();
    write_json(&out.join("overlaps.json"), &pairs)?;
    write_json(&out.join("groups.json"), &groups)
}

fn rounded(share: f64) -> f64 {
    (share * 1e4).round() * 1e-4
}

fn write_json(path: &Path, value: &impl Serialize) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(value)?;
    fs::write(path, text + "\n").with_context(|| format!("cannot write {}", path.display()))
}

/// Writes points, and their colours if they have any, as a binary PLY file.
fn write_ply(cloud: &PointCloud, path: &Path) -> io::Result<()> {
    let mut writer = PlyWriter::new(BufWriter::new(File::create(path)?), !cloud.colors.is_empty(), &[])?;
    for (i, point) in cloud.points.iter().enumerate() {
        writer.colored_point(*point, cloud.colors.get(i).copied().unwrap_or_default())?;
    }
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

    #[test]
    fn two_buildings_in_one_folder_are_told_apart_only_by_the_truth() {
        let folder = tempfile::tempdir().unwrap();
        run(&parse(folder.path(), "--kind hall,house --rooms 2 --stations 5 --glass 0.5 --people 1 --color"))
            .unwrap();
        let read = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap();
        let poses: BTreeMap<String, [[f64; 4]; 4]> = serde_json::from_str(&read("poses.json")).unwrap();
        let groups: serde_json::Value = serde_json::from_str(&read("groups.json")).unwrap();
        let overlaps: Vec<serde_json::Value> = serde_json::from_str(&read("overlaps.json")).unwrap();
        let building = |file: &str| groups[file]["building"].as_u64().unwrap();
        assert_eq!(poses.keys().filter(|file| building(file) == 0).count(), 3);
        assert!(poses.iter().all(|(file, pose)| (pose[0][3] > 5000.0) == (building(file) == 1)));
        assert!(overlaps.len() >= 3);
        for pair in overlaps {
            let [a, b] = ["a", "b"].map(|end| pair[end].as_str().unwrap());
            assert_eq!(building(a), building(b));
            let share = pair["a_seen_by_b"].as_f64().unwrap();
            assert!((0.0..=1.0).contains(&share));
            let header = fs::read(folder.path().join("scans").join(a)).unwrap();
            assert!(String::from_utf8_lossy(&header[..300]).contains("uchar red"));
        }
    }
}
