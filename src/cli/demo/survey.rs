//! What the demo registers: a simulated building, or the user's own scans; who uploads what, and the truth if it is known.

use std::path::{Path, PathBuf};

use anyhow::Context;
use rand::seq::SliceRandom;

use crate::cli::register::inputs::{Input, gather};
use crate::cli::simulate::write_survey;
use crate::control::Seed;
use crate::evaluate::Estimate;
use crate::simulate::{SurveyOptions, simulate};

/// Rigs that upload at the same time.
pub(super) const RIGS: usize = 2;

/// Scans, and the truth about them.
pub(super) struct DemoSurvey {
    /// What each rig uploads, in this order.
    pub rigs: [Vec<Input>; RIGS],
    /// True poses, if they are known.
    pub truth: Option<Estimate>,
}

impl DemoSurvey {
    /// Simulates a building of several rooms, each rig in its part of it, and writes the scans into a folder `survey` in `dir`.
    pub fn simulated(seed: Seed, stations: usize, dir: &Path) -> anyhow::Result<Self> {
        let folder = dir.join("survey");
        if folder.join("scans").exists() {
            std::fs::remove_dir_all(folder.join("scans"))
                .context("cannot remove the scans of an earlier demo")?;
        }
        let options = SurveyOptions { stations, ..SurveyOptions::demo(seed) };
        let survey = simulate(&SurveyOptions { rigs: RIGS, ..options })?;
        write_survey(&survey, &folder)?;
        let mut rigs = [const { Vec::new() }; RIGS];
        for scan in &survey.scans {
            let name = format!("{}.ply", scan.name);
            let path = folder.join("scans").join(&name);
            if let Some(rig) = rigs.get_mut(scan.rig) {
                rig.push(Input { name, path });
            }
        }
        let truth = read_truth(&folder.join("poses.json"))?;
        Ok(Self { rigs, truth: Some(truth) }.shuffled(seed))
    }

    /// The scans in a folder, or in the folder `scans` in it, dealt out to the rigs. The truth is `poses.json` in that folder or
    /// beside it, if there is one.
    pub fn of_folder(given: &Path, seed: Seed, dir: &Path) -> anyhow::Result<Self> {
        let inner = given.join("scans");
        let folder: PathBuf = if inner.is_dir() { inner } else { given.to_owned() };
        let mut files = gather(std::slice::from_ref(&folder), Some(dir))?.files;
        files.shuffle(&mut seed.derive("demo.deal", 0));
        let half = files.len().div_ceil(RIGS);
        let second = files.split_off(half);
        let beside = [folder.join("poses.json"), folder.join("../poses.json")];
        let truth = beside.iter().find(|path| path.is_file()).map(|path| read_truth(path)).transpose()?;
        Ok(Self { rigs: [files, second], truth })
    }

    /// Number of scans.
    pub fn len(&self) -> usize {
        self.rigs.iter().map(Vec::len).sum()
    }

    fn shuffled(mut self, seed: Seed) -> Self {
        for (index, rig) in (0u128..).zip(&mut self.rigs) {
            rig.shuffle(&mut seed.derive("demo.shuffle", index));
        }
        self
    }
}

fn read_truth(path: &Path) -> anyhow::Result<Estimate> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    Estimate::parse(&text).with_context(|| format!("{}", path.display()))
}
