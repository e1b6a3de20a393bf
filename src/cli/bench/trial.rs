//! One run of the engine on one scene in one order, timed, and the other strategies on the scan graph that it made.

use std::collections::BTreeMap;
use std::sync::Arc;

use anyhow::ensure;
use rand::seq::SliceRandom;

use super::super::progress::{Moment, Seconds};
use super::super::register::pipeline::prepare_all;
use super::clock::StageClock;
use super::memory;
use super::report::{Stages, Strategy};
use super::scene::Scene;
use crate::baseline::{GlobalOptions, Piece, global, spanning_tree};
use crate::cloud::ScanKey;
use crate::control::{CancelToken, Control, Seed};
use crate::evaluate::{Estimate, PlacedScan};
use crate::features::{PrepareOptions, PreparedScan, choose_resolution};
use crate::graph::SupportOptions;
use crate::jobs::DECIDING_SCANS;
use crate::mapping::{LiveModel, MappingOptions, ModelSnapshot, ScanOutcome};
use crate::pairwise::Verifier;

/// How a run goes.
#[derive(Debug, Clone)]
pub(super) struct Course {
    /// Root of the order and of the engine's random choices.
    pub seed: u64,
    /// Whether the scans arrive one after the other.
    pub one_at_a_time: bool,
    /// The weights of the verifier.
    pub verifier: Arc<Verifier>,
    /// Whose poses are wanted.
    pub strategies: Vec<Strategy>,
}

/// What came of a run.
pub(super) struct Trial {
    /// The engine's model, with the scan graph.
    pub model: LiveModel,
    /// The engine's settings.
    pub options: MappingOptions,
    /// Poses, and what they took beside what all strategies share.
    pub results: Vec<(Strategy, Estimate, Stages)>,
    /// The longest that one of several steps took.
    pub longest_step_s: Option<f64>,
    /// The peak of memory.
    pub peak_memory_bytes: Option<u64>,
}

/// Runs the engine in the ambient thread pool.
pub(super) fn run(scene: &Scene, course: &Course, cancel: &CancelToken) -> anyhow::Result<Trial> {
    memory::forget_peak();
    let seed = Seed(course.seed);
    let mut order: Vec<ScanKey> = scene.scans.keys().copied().collect();
    order.shuffle(&mut seed.derive("bench.order", 0));
    let resolution = if course.one_at_a_time {
        // As the service does: the first scans to arrive decide.
        let natural: Vec<f64> =
            order.iter().take(DECIDING_SCANS as usize).map(|key| scene.scans[key].natural).collect();
        choose_resolution(&natural)
    } else {
        scene.resolution
    };

    let clock = StageClock::start();
    let control = Control { cancel, observer: &clock };
    let begun = Moment::now();
    let settings = PrepareOptions::at(resolution, seed);
    let (prepared, unfit) = prepare_all(&scene.scans, &scene.interpretation, &settings, control)?;
    let prepare = begun.until(&Moment::now());
    ensure!(!prepared.is_empty(), "{}: none of the {} scans can be registered", scene.name, unfit.len());
    let mut by_key: BTreeMap<ScanKey, Arc<PreparedScan>> =
        prepared.into_iter().map(|scan| (scan.key, scan)).collect();
    let scans: Vec<Arc<PreparedScan>> = order.iter().filter_map(|key| by_key.remove(key)).collect();

    let support = SupportOptions { verifier: Arc::clone(&course.verifier), ..SupportOptions::default() };
    let options = MappingOptions { seed, support, ..MappingOptions::default() };
    let mut model = LiveModel::new(options.clone());
    let before = clock.outside();
    let mut longest_step_s = None;
    if course.one_at_a_time {
        for scan in scans {
            let begun = Moment::now();
            model.register(vec![scan], control)?;
            let step = begun.until(&Moment::now()).wall;
            longest_step_s = Some(longest_step_s.map_or(step, |longest: f64| longest.max(step)));
        }
    } else {
        model.register(scans, control)?;
    }
    let shared = Stages {
        prepare,
        matching: clock.of(&[crate::control::Stage::Match]),
        support: clock.of(&[crate::control::Stage::Support]),
        ..Stages::default()
    };
    let grown = Stages {
        map: less(clock.outside(), before),
        refine: clock.of(&[
            crate::control::Stage::BundleAdjustment,
            crate::control::Stage::TrackRefinement,
            crate::control::Stage::DenseRefinement,
        ]),
        ..shared
    };
    let mut results = Vec::with_capacity(course.strategies.len());
    for &strategy in &course.strategies {
        let begun = Moment::now();
        let estimate = match strategy {
            Strategy::Incremental => {
                results.push((strategy, of_model(&model.snapshot(), scene), grown));
                continue;
            }
            Strategy::Mst => of_pieces(&spanning_tree(model.graph(), 0.0), scene),
            Strategy::Global => of_pieces(&global(model.graph(), &GlobalOptions::default(), control)?, scene),
        };
        let map = begun.until(&Moment::now());
        results.push((strategy, estimate, Stages { map, ..shared }));
    }
    Ok(Trial { model, options, results, longest_step_s, peak_memory_bytes: memory::peak_bytes() })
}

fn less(all: Seconds, part: Seconds) -> Seconds {
    Seconds { wall: all.wall - part.wall, cpu: all.cpu - part.cpu }
}

fn of_model(snapshot: &ModelSnapshot, scene: &Scene) -> Estimate {
    let placed = snapshot.scans.iter().filter_map(|(key, outcome)| match outcome {
        ScanOutcome::Registered(place) => Some((*key, place.model_from_scan, place.component)),
        ScanOutcome::Waiting(_) => None,
    });
    estimate(placed, scene)
}

fn of_pieces(pieces: &[Piece], scene: &Scene) -> Estimate {
    let placed = pieces
        .iter()
        .enumerate()
        .flat_map(|(index, piece)| piece.iter().map(move |(key, pose)| (*key, *pose, index)));
    estimate(placed, scene)
}

/// Poses by file name; files of equal content have equal poses.
fn estimate(
    placed: impl Iterator<Item = (ScanKey, crate::geometry::Pose, usize)>,
    scene: &Scene,
) -> Estimate {
    let mut estimate = Estimate::default();
    for (key, model_from_scan, component) in placed {
        for name in scene.scans.get(&key).into_iter().flat_map(|scan| &scan.names) {
            let placed = PlacedScan { model_from_scan, component: component.to_string() };
            estimate.placed.insert(name.clone(), placed);
        }
    }
    for name in scene.scans.values().flat_map(|scan| &scan.names) {
        if !estimate.placed.contains_key(name) {
            estimate.unplaced.push(name.clone());
        }
    }
    estimate
}
