//! Reads a folder of real scans with their truth: `poses.json`, or the pair logs of the 3DMatch benchmark.

use std::collections::{BTreeMap, VecDeque};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

use anyhow::{Context, bail, ensure};
use rayon::prelude::*;

use crate::calibrate::{Placed, TrueScene};
use crate::cli::register::inputs::{Input, gather};
use crate::cli::register::source::{Refusal, Source};
use crate::control::{Control, Seed, Silent, Stage};
use crate::evaluate::{Estimate, benchmark_index};
use crate::features::{PrepareOptions, PreparedScan, choose_resolution, natural_resolution, prepare};
use crate::geometry::Pose;
use crate::geometry::pose_text::{LogEntry, parse_log};
use crate::project::Interpretation;

/// Logs of true pairs that a benchmark scene may hold.
const LOGS: [&str; 2] = ["3DMatch_gt.log", "3DLoMatch_gt.log"];

/// A folder and the place it shows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RealScene {
    /// The name of the folder.
    pub name: String,
    /// What other folders of the same place are given with, too.
    pub place: String,
    /// Where it is.
    pub folder: PathBuf,
}

impl RealScene {
    /// Parses `[PLACE=]DIR`.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        let (place, folder) = match text.split_once('=') {
            Some((place, folder)) if !place.contains('/') => (Some(place), PathBuf::from(folder)),
            _ => (None, PathBuf::from(text)),
        };
        ensure!(folder.is_dir(), "{} is no folder", folder.display());
        let real = folder.canonicalize().with_context(|| format!("cannot read {}", folder.display()))?;
        let Some(name) = real.file_name() else { bail!("{} has no name", folder.display()) };
        let name = name.to_string_lossy().into_owned();
        Ok(Self { place: place.map_or_else(|| name.clone(), str::to_owned), name, folder })
    }

    /// As it is given, without the path.
    pub fn label(&self) -> String {
        if self.place == self.name { self.name.clone() } else { format!("{}={}", self.place, self.name) }
    }

    /// Decodes and prepares the scans whose truth is known.
    pub fn read(&self, control: Control<'_>) -> anyhow::Result<TrueScene> {
        let scans = self.folder.join("scans");
        let inputs = gather(&[if scans.is_dir() { scans } else { self.folder.clone() }], None)?;
        let truth = self.truth(&inputs.files)?;
        let known: Vec<(&Input, (usize, Pose))> =
            inputs.files.iter().filter_map(|file| Some((file, *truth.get(&file.name)?))).collect();
        ensure!(known.len() > 1, "{} holds no two scans with known poses", self.folder.display());
        let interpretation = Interpretation::default();
        let read = |file: &Input| {
            Source::read(&file.path, &interpretation, control.cancel).map_err(|r| explain(r, &file.name))
        };
        let natural: Vec<f64> = known
            .par_iter()
            .map(|(file, _)| Ok(natural_resolution(&read(file)?.decoded.cloud.points)))
            .collect::<anyhow::Result<_>>()?;
        let options = PrepareOptions::at(choose_resolution(&natural), Seed(0));
        let done = AtomicUsize::new(0);
        let scans: Vec<(PreparedScan, Placed)> = known
            .par_iter()
            .map(|(file, (world, world_from_scan))| {
                let source = read(file)?;
                let quiet = Control { observer: &Silent, ..control };
                let stance = source.stance(&interpretation);
                let prepared = prepare(source.key, &source.decoded.cloud, stance, &options, quiet)
                    .map_err(|error| explain(error.into(), &file.name))?;
                let world_from_local = *world_from_scan * prepared.local_from_scan().inverse();
                control.report(Stage::Prepare, 1 + done.fetch_add(1, Ordering::Relaxed), known.len());
                Ok((prepared, Placed { world: *world, world_from_local }))
            })
            .collect::<anyhow::Result<_>>()?;
        let (name, place) = (self.name.clone(), self.place.clone());
        Ok(TrueScene { name, place, seeds: Vec::new(), worlds_are_apart: false, scans })
    }

    /// World and pose in it of each file, by its name.
    fn truth(&self, files: &[Input]) -> anyhow::Result<BTreeMap<String, (usize, Pose)>> {
        let text = |path: &Path| {
            std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))
        };
        let poses = self.folder.join("poses.json");
        if poses.exists() {
            let known = Estimate::parse(&text(&poses)?).with_context(|| poses.display().to_string())?;
            let mut worlds: Vec<&str> = known.placed.values().map(|p| p.component.as_str()).collect();
            worlds.sort_unstable();
            worlds.dedup();
            let world = |component: &str| worlds.iter().position(|w| *w == component).unwrap_or_default();
            let placed = known.placed.iter();
            return Ok(placed
                .map(|(name, placed)| (name.clone(), (world(&placed.component), placed.model_from_scan)))
                .collect());
        }
        let mut pairs = Vec::new();
        for log in LOGS.map(|name| self.folder.join(name)).iter().filter(|path| path.exists()) {
            pairs.extend(parse_log(&text(log)?).with_context(|| log.display().to_string())?);
        }
        ensure!(
            !pairs.is_empty(),
            "{} holds no truth: neither poses.json nor a log of true pairs",
            self.folder.display()
        );
        let by_index = chain(&pairs);
        let of = |file: &Input| Some((file.name.clone(), *by_index.get(&benchmark_index(&file.name)?)?));
        Ok(files.iter().filter_map(of).collect())
    }
}

fn explain(refusal: Refusal, name: &str) -> anyhow::Error {
    match refusal.failure() {
        Ok(failure) => anyhow::anyhow!("{name}: {}", failure.detail),
        Err(cancelled) => cancelled.into(),
    }
}

/// Poses from relative ones, breadth first from the smallest index of each world, so that chains are short.
fn chain(pairs: &[LogEntry]) -> BTreeMap<u32, (usize, Pose)> {
    let mut next: BTreeMap<u32, Vec<(u32, Pose)>> = BTreeMap::new();
    for pair in pairs {
        next.entry(pair.i).or_default().push((pair.j, pair.i_from_j));
        next.entry(pair.j).or_default().push((pair.i, pair.i_from_j.inverse()));
    }
    let mut placed: BTreeMap<u32, (usize, Pose)> = BTreeMap::new();
    let mut world = 0;
    for &start in next.keys() {
        if placed.contains_key(&start) {
            continue;
        }
        placed.insert(start, (world, Pose::identity()));
        let mut queue = VecDeque::from([(start, Pose::identity())]);
        while let Some((i, world_from_i)) = queue.pop_front() {
            for (j, i_from_j) in next.get(&i).into_iter().flatten() {
                if !placed.contains_key(j) {
                    let world_from_j = world_from_i * *i_from_j;
                    placed.insert(*j, (world, world_from_j));
                    queue.push_back((*j, world_from_j));
                }
            }
        }
        world += 1;
    }
    placed
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn true_pairs_chain_to_worlds() {
        let step =
            |i, j, x| LogEntry { i, j, n: 9, i_from_j: Pose::from_translation(Vector3::new(x, 0.0, 0.0)) };
        let placed = chain(&[step(1, 2, 1.0), step(5, 6, 4.0), step(0, 2, 5.0)]);
        let at = |index: u32| (placed[&index].0, placed[&index].1.translation.x);
        assert_eq!([0, 1, 2, 5, 6].map(at), [(0, 0.0), (0, 4.0), (0, 5.0), (1, 0.0), (1, 4.0)]);
    }

    #[test]
    fn a_folder_may_be_given_with_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let scene = folder.path().join("kitchen-2");
        std::fs::create_dir(&scene).unwrap();
        let text = scene.to_str().unwrap();
        let [plain, placed] =
            [text.to_owned(), format!("kitchen={text}")].map(|t| RealScene::parse(&t).unwrap());
        assert_eq!((plain.name.as_str(), plain.place.as_str()), ("kitchen-2", "kitchen-2"));
        assert_eq!((placed.name.as_str(), placed.place.as_str()), ("kitchen-2", "kitchen"));
        assert!(RealScene::parse("no/such/folder").is_err());
        let error = placed.truth(&[]).unwrap_err();
        assert!(error.to_string().contains("holds no truth"), "{error}");
    }
}
