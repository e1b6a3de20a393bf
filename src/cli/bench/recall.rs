//! `cairn bench recall`: scenes with known truth through the engine in shuffled order, and figures of all usual kinds.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::Args;

use super::super::register::upward;
use super::super::signals::{INTERRUPTED, cancelled_by_signal};
use super::super::truth::read;
use super::measure::{Rules, measured};
use super::report::{Report, SceneReport, Strategy, Summary};
use super::scene::Scene;
use super::trial::{self, Course};
use super::{markdown, tables};
use crate::control::{CancelToken, Cancelled, Control, Silent};
use crate::evaluate::{Estimate, Tolerance};
use crate::pairwise::{Verifier, shipped_verifier};
use crate::project::Interpretation;

/// Register scenes with known truth, and measure the results.
///
/// A scene is a folder with scans (in `scans`, or in itself), true poses in `poses.json`, and, for the figures of the literature,
/// `3DMatch_gt.log` and `.info`, `3DLoMatch_gt.log` and `.info`. Scans of several unrelated buildings may be mixed: `groups.json`
/// ({file: building}) says so, or the true poses, if buildings lie far from each other there.
///
/// The engine sees scans in shuffled order and never their names. Every strategy works on the scan graph that the engine made.
#[derive(Debug, Clone, Args)]
pub struct RecallArgs {
    /// Folders of scenes
    #[arg(required = true, value_name = "DIR")]
    pub scenes: Vec<PathBuf>,
    /// Who turns the scan graph into poses; several with commas
    #[arg(long, value_enum, value_delimiter = ',', default_value = "incremental")]
    pub strategy: Vec<Strategy>,
    /// Give the engine one scan after the other, as they arrive at a service
    #[arg(long)]
    pub one_at_a_time: bool,
    /// First order and first root of all random choices
    #[arg(long, default_value_t = 0)]
    pub seed: u64,
    /// Runs of each scene, each with the next seed
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=1000))]
    pub seeds: u64,
    /// Against gravity in every scan's own frame, where scans are levelled [default: unknown]
    #[arg(long, value_name = "X,Y,Z", value_parser = upward, allow_hyphen_values = true)]
    pub up: Option<[f64; 3]>,
    /// Weights of the verifier instead of the shipped ones; one for all scenes, or one for each in their order (leave one out)
    #[arg(long, value_name = "FILE")]
    pub verifier: Vec<PathBuf>,
    /// Largest root mean square distance of a registered pair [default without lists of pairs: at most 4 voxels]
    #[arg(long, default_value_t = 0.2, value_name = "METRES")]
    pub tau: f64,
    /// Scans this far from their place in their component are wrong [default: 0.5 m, or 10 voxels where that is less]
    #[arg(long, value_name = "METRES")]
    pub wrong_distance: Option<f64>,
    /// Scans turned this far are wrong
    #[arg(long, default_value_t = 5.0, value_name = "DEGREES")]
    pub wrong_angle: f64,
    /// Threads that compute; they do not change a figure but the times [default: one for each core]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub threads: usize,
    /// Write the poses of every run into this folder, as `cairn evaluate` reads them
    #[arg(long, value_name = "DIR")]
    pub poses: Option<PathBuf>,
    /// Print one JSON object
    #[arg(long, conflicts_with = "markdown")]
    pub json: bool,
    /// Print tables in Markdown, with published figures beside ours
    #[arg(long)]
    pub markdown: bool,
}

/// Runs all scenes in all orders.
///
/// # Errors
/// Names the scene or file that cannot be used.
pub(super) fn run(args: &RecallArgs) -> anyhow::Result<ExitCode> {
    for (option, value) in [
        ("--tau", Some(args.tau)),
        ("--wrong-distance", args.wrong_distance),
        ("--wrong-angle", Some(args.wrong_angle)),
    ] {
        let positive = value.is_none_or(|value| value.is_finite() && value > 0.0);
        ensure!(positive, "{option} must be positive, not {}", value.unwrap_or_default());
    }
    let verifiers = verifiers(&args.verifier, args.scenes.len())?;
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;
    let cancel = cancelled_by_signal()?;
    let report = match pool.install(|| report(args, &verifiers, &cancel)) {
        Ok(report) => report,
        Err(error) if error.is::<Cancelled>() => {
            eprintln!("interrupted");
            return Ok(ExitCode::from(INTERRUPTED));
        }
        Err(error) => return Err(error),
    };
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else if args.markdown {
        print!("{}", markdown::tables(&report));
    } else {
        print!("{}", tables::tables(&report));
    }
    Ok(ExitCode::SUCCESS)
}

/// One verifier a scene.
fn verifiers(files: &[PathBuf], scenes: usize) -> anyhow::Result<Vec<Arc<Verifier>>> {
    if files.is_empty() {
        return Ok(vec![shipped_verifier(); scenes]);
    }
    ensure!(
        files.len() == 1 || files.len() == scenes,
        "{scenes} scenes need one --verifier or as many, not {}",
        files.len()
    );
    let read = |path: &PathBuf| -> anyhow::Result<Arc<Verifier>> {
        Ok(Arc::new(Verifier::parse(&read(path)?).with_context(|| format!("{}", path.display()))?))
    };
    let given: Vec<Arc<Verifier>> = files.iter().map(read).collect::<anyhow::Result<_>>()?;
    Ok(given.iter().cycle().take(scenes).cloned().collect())
}

fn report(args: &RecallArgs, verifiers: &[Arc<Verifier>], cancel: &CancelToken) -> anyhow::Result<Report> {
    let mut strategies: Vec<Strategy> = Vec::new();
    for strategy in &args.strategy {
        if !strategies.contains(strategy) {
            strategies.push(*strategy);
        }
    }
    let interpretation = Interpretation { up: args.up, ..Interpretation::default() };
    interpretation.validate()?;
    let mut scenes = Vec::with_capacity(args.scenes.len());
    for (folder, verifier) in args.scenes.iter().zip(verifiers) {
        let scene = Scene::read(folder, interpretation, Control { cancel, observer: &Silent })?;
        let wrong_distance = args.wrong_distance.unwrap_or_else(|| scene.wrong_distance());
        let tolerance = Tolerance { rotation_deg: args.wrong_angle, translation_m: wrong_distance };
        let rules = Rules { tau_m: args.tau, tolerance };
        let mut runs = Vec::new();
        for seed in (0..args.seeds).map(|k| args.seed.wrapping_add(k)) {
            eprintln!("{}: {} scans, seed {seed}", scene.name, scene.scans.len());
            let course = Course {
                seed,
                one_at_a_time: args.one_at_a_time,
                verifier: Arc::clone(verifier),
                strategies: strategies.clone(),
            };
            let trial = trial::run(&scene, &course, cancel)?;
            for result in &trial.results {
                if let Some(folder) = &args.poses {
                    let name = format!("{}-{}-{seed}.json", scene.name, result.0.name());
                    write_poses(&result.1, folder, &name)?;
                }
                runs.push(measured(&scene, &trial, result, seed, rules)?);
            }
        }
        scenes.push(SceneReport {
            name: scene.name.clone(),
            verifier: verifier.provenance.to_string(),
            scans: scene.scans.len(),
            places: scene.places(),
            resolution_m: scene.resolution,
            overlapping_pairs: scene.overlapping.len(),
            wrong_distance_m: wrong_distance,
            runs,
        });
    }
    let mean = strategies.iter().filter_map(|strategy| {
        let all = scenes.iter().flat_map(|scene| &scene.runs);
        Summary::of(&all.filter(|run| run.strategy == *strategy).collect::<Vec<_>>())
    });
    Ok(Report {
        one_at_a_time: args.one_at_a_time,
        threads: rayon::current_num_threads(),
        tau_m: args.tau,
        wrong_angle_deg: args.wrong_angle,
        mean: mean.collect(),
        scenes,
    })
}

/// Writes an estimate in the layout of `cairn register`.
fn write_poses(estimate: &Estimate, folder: &Path, name: &str) -> anyhow::Result<()> {
    let placed = estimate.placed.iter().map(|(name, scan)| {
        let entry = serde_json::json!({"pose": scan.model_from_scan.to_rows(), "component": scan.component});
        (name.clone(), entry)
    });
    let unplaced = estimate
        .unplaced
        .iter()
        .map(|name| (name.clone(), serde_json::json!({"pose": null, "component": null})));
    let scans: serde_json::Map<String, serde_json::Value> = placed.chain(unplaced).collect();
    let path = folder.join(name);
    std::fs::create_dir_all(folder)
        .and_then(|()| std::fs::write(&path, serde_json::json!({"scans": scans}).to_string()))
        .with_context(|| format!("cannot write {}", path.display()))
}
