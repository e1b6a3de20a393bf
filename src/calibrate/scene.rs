//! Scenes with known truth, before and after their pairs are matched. Used by the fit, which reads matched scenes only.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::label::{Label, LeftOut, TruePair, label, leave_out_lookalikes};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Stage};
use crate::features::{PreparedScan, Scan};
use crate::geometry::Pose;
use crate::pairwise::{FittedScene, PairResult, match_pair_in_full, shipped_verifier};

/// Where a scan truly is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Placed {
    /// Poses of different worlds have nothing to do with each other.
    pub world: usize,
    /// Maps the scan's local frame into its world. Metres.
    pub world_from_local: Pose,
}

/// Prepared scans, all at one resolution, and where they are.
#[derive(Debug, Clone)]
pub struct TrueScene {
    /// Names the scene in reports.
    pub name: String,
    /// Scenes of one place are left out together, since one would teach what the other looks like.
    pub place: String,
    /// Seeds of the surveys that were simulated; none for real scans.
    pub seeds: Vec<u64>,
    /// Whether scans of different worlds are known to share nothing. Otherwise nothing is known of such pairs.
    pub worlds_are_apart: bool,
    /// The scans and their truth.
    pub scans: Vec<(PreparedScan, Placed)>,
}

/// What the fit needs to know of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ScanOutline {
    /// Which scan.
    pub key: ScanKey,
    /// Mean of its points, metres, local frame.
    pub centroid: [f64; 3],
}

/// One pair with its labelled hypotheses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatchedPair {
    /// What matching found; its log-odds are not read.
    pub result: PairResult,
    /// One a hypothesis, in their order.
    pub labels: Vec<Label>,
    /// Share of points on the other's surface under the truth, the larger of both directions; 0 for pairs that are apart.
    pub overlap: f64,
}

/// All pairs of a scene, matched and labelled.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MatchedScene {
    /// See [`TrueScene::name`].
    pub name: String,
    /// See [`TrueScene::place`].
    pub place: String,
    /// See [`TrueScene::seeds`].
    pub seeds: Vec<u64>,
    /// Voxel size, metres.
    pub resolution: f64,
    /// All scans, ascending by key.
    pub scans: Vec<ScanOutline>,
    /// All pairs whose truth is known, ascending.
    pub pairs: Vec<MatchedPair>,
}

/// How much a scene holds.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SceneCounts {
    /// Scans.
    pub scans: usize,
    /// Pairs matched.
    pub pairs: usize,
    /// Of those, pairs that overlap under the truth.
    pub overlapping: usize,
    /// Of those, pairs with a right hypothesis.
    pub found: usize,
    /// Right hypotheses.
    pub right: usize,
    /// Wrong hypotheses.
    pub wrong: usize,
    /// Hypotheses between right and wrong.
    pub borderline: usize,
    /// Wrong hypotheses that nobody could tell from right ones.
    pub lookalike: usize,
    /// Hypotheses near the truth of scans that share nothing.
    pub without_overlap: usize,
}

impl MatchedScene {
    /// Whether its scans were simulated.
    #[must_use]
    pub fn is_simulated(&self) -> bool {
        !self.seeds.is_empty()
    }

    /// What a verifier that was fitted on the scene says of it.
    #[must_use]
    pub fn provenance(&self) -> FittedScene {
        let counts = self.counts();
        FittedScene {
            name: self.name.clone(),
            seeds: self.seeds.clone(),
            scans: counts.scans,
            pairs: counts.pairs,
            right: counts.right,
            wrong: counts.wrong,
            left_out: counts.borderline + counts.lookalike + counts.without_overlap,
        }
    }

    /// How much the scene holds.
    #[must_use]
    pub fn counts(&self) -> SceneCounts {
        let mut counts =
            SceneCounts { scans: self.scans.len(), pairs: self.pairs.len(), ..Default::default() };
        for pair in &self.pairs {
            counts.overlapping += usize::from(pair.overlap >= super::label::LEAST_OVERLAP);
            counts.found += usize::from(pair.labels.contains(&Label::Right));
            for label in &pair.labels {
                *match label {
                    Label::Right => &mut counts.right,
                    Label::Wrong => &mut counts.wrong,
                    Label::LeftOut(LeftOut::Borderline) => &mut counts.borderline,
                    Label::LeftOut(LeftOut::Lookalike) => &mut counts.lookalike,
                    Label::LeftOut(LeftOut::NoOverlap) => &mut counts.without_overlap,
                } += 1;
            }
        }
        counts
    }
}

/// Matches all pairs of a scene as the engine does, in parallel, and labels their hypotheses.
pub fn match_scene(scene: TrueScene, control: Control<'_>) -> Result<MatchedScene, Cancelled> {
    let resolution = scene.scans.first().map_or(0.0, |(scan, _)| scan.resolution);
    let placed: BTreeMap<ScanKey, Placed> = scene.scans.iter().map(|(s, placed)| (s.key, *placed)).collect();
    let mut scans: Vec<Scan> = scene.scans.into_par_iter().map(|(scan, _)| Scan::new(scan)).collect();
    scans.sort_by_key(Scan::key);
    scans.dedup_by_key(|scan| scan.key());
    let outlines = scans.iter().map(|s| ScanOutline { key: s.key(), centroid: s.centroid.into() }).collect();
    let pairs: Vec<(&Scan, &Scan, TruePair)> = scans
        .iter()
        .enumerate()
        .flat_map(|(i, a)| scans[i + 1..].iter().map(move |b| (a, b)))
        .filter_map(|(a, b)| {
            let (at_a, at_b) = (placed.get(&a.key())?, placed.get(&b.key())?);
            let truth = if at_a.world == at_b.world {
                TruePair::Placed(at_a.world_from_local.inverse() * at_b.world_from_local)
            } else if scene.worlds_are_apart {
                TruePair::Apart
            } else {
                return None;
            };
            Some((a, b, truth))
        })
        .collect();
    let verifier = shipped_verifier();
    let done = AtomicUsize::new(0);
    let mut labelled = pairs
        .par_iter()
        .map(|(a, b, truth)| {
            control.check()?;
            let labelled = label(a, b, match_pair_in_full(a, b, &verifier), truth);
            control.report(Stage::Match, 1 + done.fetch_add(1, Ordering::Relaxed), pairs.len());
            Ok(labelled)
        })
        .collect::<Result<Vec<_>, Cancelled>>()?;
    leave_out_lookalikes(&mut labelled, resolution);
    Ok(MatchedScene {
        name: scene.name,
        place: scene.place,
        seeds: scene.seeds,
        resolution,
        scans: outlines,
        pairs: labelled.into_iter().map(|labelled| labelled.pair).collect(),
    })
}
