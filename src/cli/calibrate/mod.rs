//! `cairn calibrate`: fits the verifier's weights on scenes with known truth, and measures them on scenes that they did not see.
//! Reads, writes and prints; what is computed is in [`crate::calibrate`].

mod diagram;
mod real;
mod report;
mod stock;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, bail, ensure};
use clap::Args;

use super::progress::Watch;
use super::signals::{INTERRUPTED, cancelled_by_signal};
use crate::calibrate::simulated::{Recipe, RecipeError, recipes};
use crate::calibrate::{Fit, FitError, MatchedScene, match_scene};
use crate::control::{Cancelled, Control, Seed};
use crate::pairwise::{Provenance, Verifier};
use real::RealScene;
use report::Report;

/// Fit the weights of the verifier on scenes with known truth, and measure how good and how honest they are.
///
/// Simulates scenes of all kinds, reads the real ones that are given, matches all pairs, labels what is found by the truth, and
/// fits. The figures are of scenes that a fit did not see.
#[derive(Debug, Clone, Args)]
pub struct CalibrateArgs {
    /// Real scenes: folders with scans (or scans/ in them) and their truth in `poses.json` or `3DMatch_gt.log`. Folders that show
    /// the same place are given the same PLACE, so that none helps to judge the other
    #[arg(value_name = "[PLACE=]DIR")]
    pub scenes: Vec<String>,
    /// File for the weights
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Scenes to simulate: all, none, or some of them by name
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "all")]
    pub simulated: Vec<String>,
    /// Root of the seeds of simulated scenes
    #[arg(long, default_value_t = 7)]
    pub seed: u64,
    /// Most scans of a simulated building
    #[arg(long, value_name = "N", default_value_t = 44)]
    pub stations: usize,
    /// Fit without this place; may be repeated
    #[arg(long, value_name = "PLACE")]
    pub leave_out: Vec<String>,
    /// For each real place, fit without it and measure on it; also measure a fit on simulated scenes alone
    #[arg(long)]
    pub leave_one_out: bool,
    /// Folder for the weights of --leave-one-out: without-PLACE.json, simulated-only.json
    #[arg(long, value_name = "DIR", requires = "leave_one_out")]
    pub out_dir: Option<PathBuf>,
    /// Measure weights that are there already on all scenes
    #[arg(long, value_name = "FILE")]
    pub judge: Option<PathBuf>,
    /// File for a picture of predicted probability against observed share
    #[arg(long, value_name = "FILE.svg")]
    pub diagram: Option<PathBuf>,
    /// Keep what was matched in this folder, and take from it what an earlier run of the same program matched
    #[arg(long, value_name = "DIR")]
    pub stock: Option<PathBuf>,
    /// Threads that compute; they do not change the result [default: one for each core]
    #[arg(long, value_name = "N", default_value_t = 0, hide_default_value = true)]
    pub threads: usize,
    /// Print the figures as JSON
    #[arg(long)]
    pub json: bool,
    /// Show no progress
    #[arg(long, short)]
    pub quiet: bool,
}

/// Fits, writes and prints.
pub fn run(args: &CalibrateArgs) -> anyhow::Result<ExitCode> {
    let real = args.scenes.iter().map(|text| RealScene::parse(text)).collect::<anyhow::Result<Vec<_>>>()?;
    let recipes = args.recipes()?;
    let command = args.command(&real);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(args.threads).build()?;
    let cancel = cancelled_by_signal()?;
    let watch = Watch::new(args.quiet);
    let control = Control { cancel: &cancel, observer: &watch };
    let result = pool.install(|| {
        let scenes = args.matched(&real, &recipes, control)?;
        args.fit(&scenes, &command, control)
    });
    watch.finish();
    match result {
        Ok(report) if args.json => println!("{}", serde_json::to_string_pretty(&report)?),
        Ok(report) => print!("{report}"),
        Err(error) if was_cancelled(&error) => {
            eprintln!("interrupted; no weights were written");
            return Ok(ExitCode::from(INTERRUPTED));
        }
        Err(error) => return Err(error),
    }
    Ok(ExitCode::SUCCESS)
}

fn was_cancelled(error: &anyhow::Error) -> bool {
    error.is::<Cancelled>()
        || matches!(error.downcast_ref(), Some(FitError::Cancelled(_)))
        || matches!(error.downcast_ref(), Some(RecipeError::Cancelled(_)))
}

impl CalibrateArgs {
    fn recipes(&self) -> anyhow::Result<Vec<Recipe>> {
        let all = recipes(Seed(self.seed), self.stations);
        match self.simulated.iter().map(String::as_str).collect::<Vec<_>>()[..] {
            ["all"] => return Ok(all),
            ["none"] => return Ok(Vec::new()),
            _ => {}
        }
        if let Some(unknown) = self.simulated.iter().find(|name| !all.iter().any(|r| r.name == **name)) {
            let known: Vec<&str> = all.iter().map(|recipe| recipe.name.as_str()).collect();
            bail!("there is no simulated scene {unknown:?}, but there are {}", known.join(", "));
        }
        Ok(all.into_iter().filter(|recipe| self.simulated.contains(&recipe.name)).collect())
    }

    /// The part of the command line that decides the weights, without the paths of this machine.
    fn command(&self, real: &[RealScene]) -> String {
        let Self { seed, stations, .. } = self;
        let simulated = self.simulated.join(",");
        let mut words =
            vec![format!("cairn calibrate --simulated {simulated} --seed {seed} --stations {stations}")];
        words.extend(self.leave_out.iter().map(|place| format!("--leave-out {place}")));
        words.extend(real.iter().map(RealScene::label));
        words.join(" ")
    }

    /// All scenes, matched and labelled: the real ones first.
    fn matched(
        &self,
        real: &[RealScene],
        recipes: &[Recipe],
        control: Control<'_>,
    ) -> anyhow::Result<Vec<MatchedScene>> {
        let mut scenes = Vec::with_capacity(real.len() + recipes.len());
        let total = scenes.capacity();
        for scene in real {
            self.announce(&scene.name, scenes.len(), total);
            let matched = || Ok(match_scene(scene.read(control)?, control)?);
            scenes.push(stock::stocked(self.stock.as_deref(), &scene.label(), matched)?);
        }
        for recipe in recipes {
            self.announce(&recipe.name, scenes.len(), total);
            let matched = || Ok(match_scene(recipe.build(control)?, control)?);
            scenes.push(stock::stocked(self.stock.as_deref(), &format!("{recipe:?}"), matched)?);
        }
        Ok(scenes)
    }

    fn announce(&self, name: &str, done: usize, total: usize) {
        if !self.quiet {
            eprintln!("scene {} of {total}: {name}", done + 1);
        }
    }

    fn fit(&self, scenes: &[MatchedScene], command: &str, control: Control<'_>) -> anyhow::Result<Report> {
        let mut report = Report::new(scenes);
        if let Some(path) = &self.judge {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
            let verifier = Verifier::parse(&text).with_context(|| path.display().to_string())?;
            let all: Vec<usize> = (0..scenes.len()).collect();
            report.judged(&format!("by {}", report::file_name(path)), scenes, &verifier, &all);
        }
        if self.leave_one_out {
            self.leave_each_out(scenes, command, &mut report, control)?;
        }
        if self.out.is_none() && self.diagram.is_none() {
            return Ok(report);
        }
        let kept = without(scenes, &self.leave_out)?;
        let fit = Fit::of(&kept.iter().map(|s| &scenes[*s]).collect::<Vec<_>>(), control)?;
        report.held_out(scenes, &kept, &fit);
        if let Some(path) = &self.diagram {
            write(path, &diagram::svg(report.reliability()))?;
        }
        if let Some(path) = &self.out {
            write(path, &text(&verifier(scenes, &kept, &fit, command))?)?;
        }
        Ok(report)
    }

    fn leave_each_out(
        &self,
        scenes: &[MatchedScene],
        command: &str,
        report: &mut Report,
        control: Control<'_>,
    ) -> anyhow::Result<()> {
        let real: Vec<usize> = (0..scenes.len()).filter(|s| !scenes[*s].is_simulated()).collect();
        ensure!(!real.is_empty(), "--leave-one-out needs real scenes");
        let places: BTreeSet<&str> = real.iter().map(|s| scenes[*s].place.as_str()).collect();
        let mut fits: Vec<(String, String, Vec<usize>, Vec<usize>)> = places
            .iter()
            .map(|place| {
                let (held_out, kept) = (0..scenes.len()).partition(|s| scenes[*s].place == **place);
                (format!("without-{place}"), format!("{command} --leave-out {place}"), kept, held_out)
            })
            .collect();
        let simulated: Vec<usize> = (0..scenes.len()).filter(|s| scenes[*s].is_simulated()).collect();
        if simulated.len() > 1 {
            fits.push(("simulated-only".to_owned(), self.command(&[]), simulated, real));
        }
        if let Some(folder) = &self.out_dir {
            std::fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
        }
        for (name, command, kept, held_out) in fits {
            let fit = Fit::of(&kept.iter().map(|s| &scenes[*s]).collect::<Vec<_>>(), control)?;
            let verifier = verifier(scenes, &kept, &fit, &command);
            report.judged(&name, scenes, &verifier, &held_out);
            if let Some(folder) = &self.out_dir {
                write(&folder.join(format!("{name}.json")), &text(&verifier)?)?;
            }
        }
        Ok(())
    }
}

/// Indices of the scenes of other places.
fn without(scenes: &[MatchedScene], places: &[String]) -> anyhow::Result<Vec<usize>> {
    if let Some(unknown) = places.iter().find(|place| !scenes.iter().any(|s| s.place == **place)) {
        bail!("there is no place {unknown:?} to leave out");
    }
    Ok((0..scenes.len()).filter(|s| !places.contains(&scenes[*s].place)).collect())
}

fn verifier(scenes: &[MatchedScene], kept: &[usize], fit: &Fit, command: &str) -> Verifier {
    let provenance = Provenance {
        program: concat!("cairn ", env!("CARGO_PKG_VERSION")).to_owned(),
        command: command.to_owned(),
        scenes: kept.iter().map(|s| scenes[*s].provenance()).collect(),
    };
    Verifier {
        provenance,
        pair: fit.pair.clone(),
        triplet: fit.triplet.clone(),
        detail: fit.detail.clone(),
        appearance: fit.appearance.clone(),
    }
}

/// A verifier as one line of JSON.
fn text(verifier: &Verifier) -> anyhow::Result<String> {
    Ok(serde_json::to_string(verifier)? + "\n")
}

fn write(path: &Path, text: &str) -> anyhow::Result<()> {
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
