//! A scene on disk: scans with known truth.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use nalgebra::Vector3;
use serde_json::Value;

use super::super::register::inputs::{Input, gather};
use super::super::register::pipeline::{DistinctScan, measure, prepare_all};
use super::super::truth::{PairList, label, pair_lists, read, read_estimate};
use crate::cloud::ScanKey;
use crate::control::{Control, Seed};
use crate::evaluate::{Estimate, Overlap, SurfaceAtTruth, overlaps};
use crate::features::{PrepareOptions, PreparedScan, choose_resolution, extent};
use crate::project::Interpretation;

/// Files of the truth, of which some look like clouds where they lie among scans.
const BESIDE_SCANS: [&str; 3] = ["log", "info", "json"];
/// Scans share a surface within this many voxels …
const SHARED_VOXELS: f64 = 1.5;
/// … and overlap when they share more than this of their points.
const LEAST_OVERLAP: f64 = 0.1;
/// Scans of which none is nearer than this many extents to a scan of another group are of different places.
const APART_EXTENTS: f64 = 10.0;
/// Scans are wrong from this far on, metres, or from so many voxels where that is less …
const WRONG_METRES: f64 = 0.5;
const WRONG_VOXELS: f64 = 10.0;

/// Scans, and what is known of them.
pub(super) struct Scene {
    /// Name of its folder.
    pub name: String,
    /// All scans, by the hash that the engine knows them by.
    pub scans: BTreeMap<ScanKey, DistinctScan>,
    /// How their files are read.
    pub interpretation: Interpretation,
    /// True poses; the component of each is the place that it is of.
    pub truth: Estimate,
    /// The pairs that benchmarks score, if the scene has such lists.
    pub lists: Vec<PairList>,
    /// Voxel size that suits all scans, metres.
    pub resolution: f64,
    /// Pairs that truly overlap, by name; the frames are the scans' own.
    pub overlapping: BTreeMap<(String, String), Overlap>,
}

impl Scene {
    /// Reads the truth, every scan once, and finds the pairs that overlap.
    pub fn read(folder: &Path, interpretation: Interpretation, control: Control<'_>) -> anyhow::Result<Self> {
        let files = scan_files(folder)?;
        let (scans, unreadable) = measure(&files, &interpretation, control)?;
        if let Some((file, failure)) = unreadable.into_iter().next() {
            bail!("{}: {file}: {}", folder.display(), failure.detail);
        }
        let natural: Vec<f64> = scans.values().map(|scan| scan.natural).collect();
        let resolution = choose_resolution(&natural);
        let options = PrepareOptions::at(resolution, Seed::default());
        let (prepared, _) = prepare_all(&scans, &interpretation, &options, control)?;
        let surfaces: BTreeMap<&str, &PreparedScan> = prepared
            .iter()
            .filter_map(|scan| Some((scans.get(&scan.key)?.names.first()?.as_str(), scan.as_ref())))
            .collect();

        let truth_file = folder.join("poses.json");
        ensure!(truth_file.is_file(), "{} has no poses.json with the true poses", folder.display());
        let told = read_estimate(&truth_file)?;
        let names = scans.values().flat_map(|scan| &scan.names);
        let known = names.filter_map(|name| Some((name.clone(), told.find(name)?.clone())));
        let known = Estimate { placed: known.collect(), unplaced: Vec::new() };
        ensure!(!known.placed.is_empty(), "{} names none of the scans", truth_file.display());
        let truth = tell_places_apart(known, &groups(folder)?, &surfaces);
        let overlapping = overlapping(&truth, &surfaces, resolution, control)?;
        let lists = pair_lists(folder)?;
        Ok(Self { name: label(folder), scans, interpretation, truth, lists, resolution, overlapping })
    }

    /// Half a metre, or ten voxels where that is less: what a wrong placement is scales with small objects, and never exceeds what
    /// is wrong in a building.
    pub fn wrong_distance(&self) -> f64 {
        WRONG_METRES.min(WRONG_VOXELS * self.resolution)
    }

    /// How many places the scans are of.
    pub fn places(&self) -> usize {
        let places: std::collections::BTreeSet<&str> =
            self.truth.placed.values().map(|scan| scan.component.as_str()).collect();
        places.len()
    }
}

/// The scans in `scans`, or in the folder itself without the files that belong to the truth.
fn scan_files(folder: &Path) -> anyhow::Result<Vec<Input>> {
    let inner = folder.join("scans");
    let inside = if inner.is_dir() { inner } else { folder.to_owned() };
    let of_truth = |input: &Input| {
        let extension = input.path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        BESIDE_SCANS.contains(&extension)
    };
    let files: Vec<Input> =
        gather(&[inside], None)?.files.into_iter().filter(|file| !of_truth(file)).collect();
    ensure!(!files.is_empty(), "{} holds no scans", folder.display());
    Ok(files)
}

/// `groups.json`: the place of each scan, as a text or number or as `building` of an object. Empty without that file.
fn groups(folder: &Path) -> anyhow::Result<BTreeMap<String, String>> {
    let path: PathBuf = folder.join("groups.json");
    if !path.is_file() {
        return Ok(BTreeMap::new());
    }
    let entries: BTreeMap<String, Value> =
        serde_json::from_str(&read(&path)?).with_context(|| format!("{}", path.display()))?;
    Ok(entries
        .into_iter()
        .map(|(name, entry)| {
            let group = entry.get("building").unwrap_or(&entry).to_string();
            (name, group)
        })
        .collect())
}

/// Makes the component of each true pose its place: what the truth and `groups.json` say, and where scans of one group lie far from
/// each other, each cluster.
fn tell_places_apart(
    mut truth: Estimate,
    groups: &BTreeMap<String, String>,
    surfaces: &BTreeMap<&str, &PreparedScan>,
) -> Estimate {
    for (name, scan) in &mut truth.placed {
        if let Some(group) = groups.get(name) {
            scan.component = format!("{} {group}", scan.component);
        }
    }
    let mut extents: Vec<f64> = surfaces.values().map(|scan| extent(&scan.points)).collect();
    extents.sort_by(f64::total_cmp);
    let apart = APART_EXTENTS * extents.get(extents.len() / 2).copied().unwrap_or(f64::INFINITY);
    let mut found: Vec<(String, String, Vector3<f64>)> = truth
        .placed
        .iter()
        .map(|(name, scan)| {
            let middle_in_scan = surfaces.get(name.as_str()).map_or_else(Vector3::zeros, |prepared| {
                let sum: Vector3<f64> = prepared.points.iter().map(|p| Vector3::from(*p).cast::<f64>()).sum();
                sum / prepared.points.len().max(1) as f64 + Vector3::from(prepared.origin)
            });
            (name.clone(), scan.component.clone(), scan.model_from_scan.transform(&middle_in_scan))
        })
        .collect();
    let mut place = 0;
    while let Some(first) = found.pop() {
        place += 1;
        let mut open = vec![first];
        while let Some((name, group, position)) = open.pop() {
            let near = |other: &(String, String, Vector3<f64>)| {
                other.1 == group && (other.2 - position).norm() <= apart
            };
            open.extend(found.extract_if(.., |other| near(other)));
            if let Some(scan) = truth.placed.get_mut(&name) {
                scan.component = format!("place {place}");
            }
        }
    }
    truth
}

/// Every pair that truly overlaps.
fn overlapping(
    truth: &Estimate,
    surfaces: &BTreeMap<&str, &PreparedScan>,
    resolution: f64,
    control: Control<'_>,
) -> anyhow::Result<BTreeMap<(String, String), Overlap>> {
    let mut groups: Vec<&str> = Vec::new();
    let (mut names, mut at_truth) = (Vec::new(), Vec::new());
    for (name, prepared) in surfaces {
        let Some(scan) = truth.find(name) else { continue };
        let group = groups.iter().position(|group| *group == scan.component).unwrap_or_else(|| {
            groups.push(&scan.component);
            groups.len() - 1
        });
        names.push((*name, prepared.origin));
        at_truth.push(SurfaceAtTruth {
            points: &prepared.points,
            normals: &prepared.normals,
            truth_from_points: scan.model_from_scan * prepared.local_from_scan().inverse(),
            group,
        });
    }
    let found = overlaps(&at_truth, SHARED_VOXELS * resolution, LEAST_OVERLAP, control)?;
    Ok(found
        .into_iter()
        .map(|mut overlap| {
            let ((i, _), (j, origin)) = (names[overlap.i], names[overlap.j]);
            overlap.mean_in_j += Vector3::from(origin);
            ((i.to_owned(), j.to_owned()), overlap)
        })
        .collect())
}
