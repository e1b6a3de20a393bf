//! From labelled scenes to the regressions, and what they say of scenes that they did not see.

use std::sync::Arc;

use rayon::prelude::*;

use super::label::Label;
use super::regression::{Example, fit};
use super::scene::{MatchedScene, ScanOutline};
use super::view::View;
use crate::control::{Cancelled, Control, Stage};
use crate::features::{PreparedScan, Scan};
use crate::graph::{ScanGraph, SupportOptions, triplet_features};
use crate::pairwise::{Appearance, Evidence, Logistic, PairResult, Verifier, by_shape, is_looked_at_closely};

/// Places are dealt to so many folds; each is predicted by a fit on the others.
const FOLDS: usize = 5;
/// Views whose graphs teach the regression with triplets.
const GRAPH_VIEWS: [View; 2] = [View::Full, View::Blind];

/// Why no weights can be fitted.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum FitError {
    /// Predictions need places that the fit did not see.
    #[error("a fit needs scenes of at least two places, not {0}")]
    Places(usize),
    /// Without both, nothing tells them apart.
    #[error("the scenes other than {without:?} hold no right or no wrong hypotheses")]
    OneLabel {
        /// Scenes that were held out.
        without: Vec<String>,
    },
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// What a verifier says of one labelled hypothesis.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Prediction {
    /// Index of the scene in the list that was given.
    pub scene: usize,
    /// How it was seen.
    pub view: View,
    /// Whether the pose is right.
    pub right: bool,
    /// Log-odds from the shapes of the pair alone, at half the voxel where it was looked at there.
    pub pair_logit: f64,
    /// Log-odds with triplets.
    pub logit: f64,
}

/// Fitted regressions.
#[derive(Debug, Clone, PartialEq)]
pub struct Fit {
    /// On a pair alone, at the voxel.
    pub pair: Logistic,
    /// On that and what shows at half the voxel; `None` where no two scans have such surfaces, or nothing wrong was looked at there.
    pub detail: Option<Logistic>,
    /// On a pair and what third scans say.
    pub triplet: Logistic,
    /// On colours, beside what a pair says without them; `None` where no two scans have any.
    pub appearance: Option<Logistic>,
    /// Of every labelled hypothesis, by regressions that saw no scene of its place. Those after the first took log-odds of other places from fits that did.
    pub held_out: Vec<Prediction>,
}

impl Fit {
    /// Fits all regressions. Each learns from log-odds of the one before that are out of fold: of scenes that it was fitted on they would be too
    /// good, and the next would trust it too much.
    pub fn of(scenes: &[&MatchedScene], control: Control<'_>) -> Result<Self, FitError> {
        let folds = folds(scenes)?;
        let steps = 3 * folds.len();
        let step = |done| -> Result<(), Cancelled> {
            control.report(Stage::Support, done, steps);
            control.check()
        };
        let names = |fold: &[usize]| fold.iter().map(|s| scenes[*s].name.clone()).collect();
        let learned = |fold: &[usize], examples: &[Vec<Example>]| {
            let others = examples.iter().enumerate().filter(|(s, _)| !fold.contains(s)).map(|(_, e)| e);
            fit(&pooled(others))
        };
        let without = |fold: &[usize], examples: &[Vec<Example>]| {
            learned(fold, examples).ok_or_else(|| FitError::OneLabel { without: names(fold) })
        };
        let of_pairs: Vec<Vec<Example>> = scenes.iter().map(|scene| pair_examples(scene)).collect();
        let mut pairs = Vec::with_capacity(folds.len());
        let mut of_detail: Vec<Vec<Example>> = vec![Vec::new(); scenes.len()];
        for (done, fold) in folds.iter().enumerate() {
            step(done)?;
            let pair = without(fold, &of_pairs)?;
            for s in fold {
                of_detail[*s] = detail_examples(scenes[*s], &pair);
            }
            pairs.push(pair);
        }
        let mut judged: Vec<Vec<Judged>> = vec![Vec::new(); scenes.len()];
        for (done, (fold, pair)) in folds.iter().zip(&pairs).enumerate() {
            step(folds.len() + done)?;
            let detail = learned(fold, &of_detail);
            let fresh: Vec<Vec<Judged>> =
                fold.par_iter().map(|s| hypotheses(scenes[*s], pair, detail.as_ref())).collect();
            for (s, fresh) in fold.iter().zip(fresh) {
                judged[*s] = fresh;
            }
        }
        let of_triplets: Vec<Vec<Example>> = judged.iter().map(|judged| triplet_examples(judged)).collect();
        let mut held_out = Vec::new();
        for (done, fold) in folds.iter().enumerate() {
            step(2 * folds.len() + done)?;
            let triplet = without(fold, &of_triplets)?;
            held_out.extend(fold.iter().flat_map(|s| predictions(*s, &judged[*s], &triplet)));
        }
        held_out.sort_by_key(|p| p.scene);
        let of_colors: Vec<Vec<Example>> = judged.iter().map(|judged| appearance_examples(judged)).collect();
        let fitted = Self {
            pair: without(&[], &of_pairs)?,
            detail: learned(&[], &of_detail),
            triplet: without(&[], &of_triplets)?,
            appearance: learned(&[], &of_colors),
            held_out,
        };
        step(steps)?;
        Ok(fitted)
    }
}

/// What a verifier says of the labelled hypotheses of a scene; `scene` is noted in each prediction.
#[must_use]
pub fn judge(verifier: &Verifier, scene: usize, of: &MatchedScene) -> Vec<Prediction> {
    predictions(scene, &hypotheses(of, &verifier.pair, verifier.detail.as_ref()), &verifier.triplet)
}

/// Scenes by fold, dealt so that real and simulated ones spread evenly; a place is in one fold only.
fn folds(scenes: &[&MatchedScene]) -> Result<Vec<Vec<usize>>, FitError> {
    let mut places: Vec<(bool, &str)> = Vec::new();
    for scene in scenes {
        let place = (scene.is_simulated(), scene.place.as_str());
        if !places.contains(&place) {
            places.push(place);
        }
    }
    if places.len() < 2 {
        return Err(FitError::Places(places.len()));
    }
    // Stable: real places first, each kind in the order given.
    places.sort_by_key(|(simulated, _)| *simulated);
    let mut folds = vec![Vec::new(); FOLDS.min(places.len())];
    let count = folds.len();
    for (s, scene) in scenes.iter().enumerate() {
        let rank = places.iter().position(|place| *place == (scene.is_simulated(), scene.place.as_str()));
        folds[rank.unwrap_or_default() % count].push(s);
    }
    Ok(folds)
}

/// Labelled evidence of one scene in all views, weighted by [`share_out`].
fn pair_examples(scene: &MatchedScene) -> Vec<Example> {
    let mut examples = Vec::new();
    for view in View::ALL {
        let evidence = scene.pairs.iter().flat_map(|pair| pair.result.hypotheses.iter().zip(&pair.labels));
        let seen = evidence.filter_map(|(hypothesis, label)| {
            let evidence = view.of(&hypothesis.evidence)?;
            let features = evidence.features(scene.resolution).to_vec();
            Some(Example { features, offset: 0.0, right: label.is_right()?, weight: view.weight() })
        });
        examples.extend(seen);
    }
    share_out(&mut examples);
    examples
}

/// What is to be learned at half the voxel of poses that are looked at there, given what the regression at the voxel, which did not see the scene,
/// says.
fn detail_examples(scene: &MatchedScene, pair: &Logistic) -> Vec<Example> {
    let evidence = scene.pairs.iter().flat_map(|pair| pair.result.hypotheses.iter().zip(&pair.labels));
    let seen = evidence.filter_map(|(hypothesis, label)| {
        let log_odds = pair.logit(&hypothesis.evidence.features(scene.resolution));
        let features = hypothesis.evidence.detail?.features(log_odds, scene.resolution).to_vec();
        is_looked_at_closely(log_odds).then_some(Example {
            features,
            offset: 0.0,
            right: label.is_right()?,
            weight: 1.0,
        })
    });
    let mut examples: Vec<Example> = seen.collect();
    share_out(&mut examples);
    examples
}

/// Examples for the regression with triplets, weighted by [`share_out`].
fn triplet_examples(judged: &[Judged]) -> Vec<Example> {
    let mut examples: Vec<Example> = judged
        .iter()
        .map(|j| Example {
            features: j.features.clone(),
            offset: 0.0,
            right: j.right,
            weight: j.view.weight(),
        })
        .collect();
    share_out(&mut examples);
    examples
}

/// What is to be learned from colours, given what pairs say without them: log-odds that are out of fold.
fn appearance_examples(judged: &[Judged]) -> Vec<Example> {
    let full = judged.iter().filter(|j| j.view == View::Full);
    let colored = full.filter_map(|j| {
        let features = j.appearance?.features().to_vec();
        Some(Example { features, offset: j.features[0], right: j.right, weight: 1.0 })
    });
    let mut examples: Vec<Example> = colored.collect();
    share_out(&mut examples);
    examples
}

/// Scales the weights of a scene so that they sum to the root of the number of its examples: scenes that count alike would let a
/// hall of twelve scans say as much as sixty fragments, and examples that count alike would let one scene say most.
fn share_out(examples: &mut [Example]) {
    let total: f64 = examples.iter().map(|e| e.weight).sum();
    let scale = (examples.len() as f64).sqrt() / total.max(f64::MIN_POSITIVE);
    for example in examples {
        example.weight *= scale;
    }
}

/// All examples together, their weights scaled to a mean of 1.
fn pooled<'e>(scenes: impl Iterator<Item = &'e Vec<Example>>) -> Vec<Example> {
    let mut all: Vec<Example> = scenes.flatten().cloned().collect();
    let mean = all.iter().map(|e| e.weight).sum::<f64>() / all.len().max(1) as f64;
    for example in &mut all {
        example.weight /= mean;
    }
    all
}

/// A labelled hypothesis within its scan graph.
#[derive(Debug, Clone)]
struct Judged {
    view: View,
    right: bool,
    /// Of the regression with triplets; the first of them is the pair's log-odds.
    features: Vec<f64>,
    /// How colours agree ([`Evidence::appearance`]).
    appearance: Option<Appearance>,
}

fn predictions(scene: usize, judged: &[Judged], triplet: &Logistic) -> Vec<Prediction> {
    let of = |j: &Judged| Prediction {
        scene,
        view: j.view,
        right: j.right,
        pair_logit: j.features[0],
        logit: triplet.logit(&j.features),
    };
    judged.iter().map(of).collect()
}

/// Builds the scan graph of a scene in each view and takes the features of every labelled hypothesis.
fn hypotheses(scene: &MatchedScene, pair: &Logistic, detail: Option<&Logistic>) -> Vec<Judged> {
    let options = SupportOptions::default();
    let mut judged = Vec::new();
    for view in GRAPH_VIEWS {
        let differs = |evidence: &Evidence| view.of(evidence).is_some();
        if !scene.pairs.iter().flat_map(|p| &p.result.hypotheses).any(|h| differs(&h.evidence)) {
            continue;
        }
        let mut graph = ScanGraph::new();
        for scan in &scene.scans {
            graph.add_scan(Arc::new(outline(scan, scene.resolution)));
        }
        let results = scene.pairs.iter().map(|p| seen(&p.result, view, pair, detail, scene.resolution));
        graph.add_results(results, &options);
        for matched in &scene.pairs {
            let Some(edge) = graph.edge(matched.result.pair.a, matched.result.pair.b) else { continue };
            let features = triplet_features(&graph, edge, &options);
            // The graph sorts hypotheses by their scores.
            for (supported, features) in edge.hypotheses.iter().zip(features) {
                let pose = &supported.hypothesis.a_from_b;
                let found = matched.result.hypotheses.iter().position(|h| h.a_from_b == *pose);
                let label = found.and_then(|h| matched.labels.get(h)).and_then(|label| label.is_right());
                if let Some(right) = label
                    && differs(&supported.hypothesis.evidence)
                {
                    let appearance = supported.hypothesis.evidence.appearance;
                    judged.push(Judged { view, right, features: features.to_vec(), appearance });
                }
            }
        }
    }
    judged
}

/// A pair's result as this view and these regressions have it.
fn seen(
    result: &PairResult,
    view: View,
    pair: &Logistic,
    detail: Option<&Logistic>,
    voxel: f64,
) -> PairResult {
    let mut result = PairResult { matches: Vec::new(), ..result.clone() };
    for hypothesis in &mut result.hypotheses {
        let evidence = view.of(&hypothesis.evidence).unwrap_or(hypothesis.evidence);
        hypothesis.logit = by_shape(pair, detail, &evidence, voxel);
    }
    result.hypotheses.sort_by(|x, y| y.logit.total_cmp(&x.logit));
    result
}

/// As much of a scan as the scan graph reads.
fn outline(scan: &ScanOutline, resolution: f64) -> Scan {
    let mut outline = Scan::new(PreparedScan { resolution, ..PreparedScan::empty(scan.key) });
    outline.centroid = scan.centroid.into();
    outline
}

impl Label {
    /// Whether it is right, if anything is to be learned from it.
    fn is_right(self) -> Option<bool> {
        match self {
            Self::Right => Some(true),
            Self::Wrong => Some(false),
            Self::LeftOut(_) => None,
        }
    }
}
