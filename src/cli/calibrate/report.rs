//! The figures of `cairn calibrate`: scenes, quality by scene, reliability; as tables and as JSON.

use std::fmt;
use std::path::Path;

use serde::Serialize;

use crate::calibrate::{Fit, MatchedScene, Prediction, Quality, Reliability, SceneCounts, View, judge};
use crate::pairwise::Verifier;

/// All that is printed.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    scenes: Vec<SceneRow>,
    tables: Vec<Table>,
    #[serde(skip_serializing_if = "Option::is_none")]
    reliability: Option<Reliability>,
}

#[derive(Debug, Serialize)]
struct SceneRow {
    name: String,
    place: String,
    simulated: bool,
    #[serde(flatten)]
    counts: SceneCounts,
}

/// Scenes by one fit.
#[derive(Debug, Serialize)]
struct Table {
    title: String,
    rows: Vec<QualityRow>,
}

#[derive(Debug, Serialize)]
struct QualityRow {
    scene: String,
    pair: Quality,
    with_triplets: Quality,
}

impl QualityRow {
    /// Of a scene seen as it was; `None` without anything right in it.
    fn of(scene: &MatchedScene, predictions: &[&Prediction]) -> Option<Self> {
        let full = || predictions.iter().filter(|p| p.view == View::Full);
        let pair: Vec<(f64, bool)> = full().map(|p| (p.pair_logit, p.right)).collect();
        let with_triplets: Vec<(f64, bool)> = full().map(|p| (p.logit, p.right)).collect();
        Some(Self {
            scene: scene.name.clone(),
            pair: Quality::of(&pair)?,
            with_triplets: Quality::of(&with_triplets)?,
        })
    }
}

impl Report {
    pub fn new(scenes: &[MatchedScene]) -> Self {
        let row = |scene: &MatchedScene| SceneRow {
            name: scene.name.clone(),
            place: scene.place.clone(),
            simulated: scene.is_simulated(),
            counts: scene.counts(),
        };
        Self { scenes: scenes.iter().map(row).collect(), tables: Vec::new(), reliability: None }
    }

    /// Adds what a verifier says of some scenes.
    pub fn judged(&mut self, title: &str, scenes: &[MatchedScene], verifier: &Verifier, which: &[usize]) {
        let rows = which.iter().filter_map(|s| {
            let predictions = judge(verifier, *s, &scenes[*s]);
            QualityRow::of(&scenes[*s], &predictions.iter().collect::<Vec<_>>())
        });
        self.tables.push(Table { title: title.to_owned(), rows: rows.collect() });
    }

    /// Adds what a fit on `kept` says of each scene by the folds without it, and how honest it is.
    pub fn held_out(&mut self, scenes: &[MatchedScene], kept: &[usize], fit: &Fit) {
        let of = |scene: usize| fit.held_out.iter().filter(move |p| p.scene == scene);
        let rows = kept
            .iter()
            .enumerate()
            .filter_map(|(place, s)| QualityRow::of(&scenes[*s], &of(place).collect::<Vec<_>>()));
        self.tables
            .push(Table { title: "each place by the folds without it".to_owned(), rows: rows.collect() });
        // Each scene counts alike.
        let weighted = (0..kept.len()).flat_map(|place| {
            let full: Vec<&Prediction> = of(place).filter(|p| p.view == View::Full).collect();
            let weight = 1.0 / full.len().max(1) as f64;
            full.into_iter().map(move |p| (p.logit, p.right, weight))
        });
        self.reliability = Some(Reliability::of(&weighted.collect::<Vec<_>>()));
    }

    /// How honest the fit is that was last measured.
    pub fn reliability(&self) -> Option<&Reliability> {
        self.reliability.as_ref()
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let width = self.scenes.iter().map(|s| s.name.len()).max().unwrap_or(0).max(5);
        writeln!(
            f,
            "{:width$}  scans  pairs  overlap  found   right   wrong  border  alike  apart",
            "scene"
        )?;
        for SceneRow { name, counts: c, .. } in &self.scenes {
            writeln!(
                f,
                "{name:width$}  {:>5}  {:>5}  {:>7}  {:>5}  {:>6}  {:>6}  {:>6}  {:>5}  {:>5}",
                c.scans,
                c.pairs,
                c.overlapping,
                c.found,
                c.right,
                c.wrong,
                c.borderline,
                c.lookalike,
                c.without_overlap
            )?;
        }
        for Table { title, rows } in &self.tables {
            writeln!(f, "\n{title}: average precision, recall at 99 % precision, log loss")?;
            writeln!(f, "{:width$}   pair alone              with triplets", "scene")?;
            for QualityRow { scene, pair: p, with_triplets: t } in rows {
                let of = |q: &Quality| {
                    format!("{:.3}  {:.3}  {:.4}", q.average_precision, q.recall_at_99, q.log_loss)
                };
                writeln!(f, "{scene:width$}   {}   {}", of(p), of(t))?;
            }
        }
        if let Some(reliability) = &self.reliability {
            writeln!(f, "\npredicted probability against observed share, held out, each scene alike")?;
            writeln!(f, "          bin   count    right   predicted  observed")?;
            for b in &reliability.bins {
                let (low, high) = (b.low, b.high);
                writeln!(
                    f,
                    "  {low:.2} - {high:.2}  {:>6}   {:>6}       {:.3}     {:.3}",
                    b.count, b.right, b.predicted, b.observed
                )?;
            }
            writeln!(f, "expected calibration error {:.4}", reliability.error)?;
        }
        Ok(())
    }
}

/// The last part of a path.
pub(super) fn file_name(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}
