//! Scans and the edges between them.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rayon::prelude::*;

use super::base_rate::correction;
use super::cohort::Cohorts;
use super::memo::Memo;
use super::support::{Corrections, SupportOptions, support};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Stage};
use crate::features::{FineSurface, Scan};
use crate::geometry::Pose;
use crate::pairwise::{Hypothesis, PairKey, PairResult, Probe, match_pair, probe};

/// Pairs that are matched before the memory that their close looks took is given back, if it is much.
const BLOCK: usize = 512;
/// Points of finer surfaces that stay in memory from one block of pairs, one join that is weighed or one scan that arrives to the next, at most: those of about 60 rooms. Each takes some
/// 150 bytes, mostly in its lookup grid.
const UNPACKED_POINTS: usize = 2_500_000;

/// A hypothesis with what third scans say of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Supported {
    /// The hypothesis of the pair alone.
    pub hypothesis: Hypothesis,
    /// Sum over third scans of the likelihood of the best path that agrees with it.
    pub support: f64,
    /// Log-odds that the pose is right, with triplets, and as rare as right poses are in the project.
    pub score: f64,
}

/// Corrections are multiples of this, so that one more scan seldom changes what all pairs are worth.
const STEP: f64 = 0.25;

/// A tried pair.
#[derive(Debug, Clone, PartialEq)]
pub struct Edge {
    /// Which pair.
    pub pair: PairKey,
    /// Keypoint numbers (in a, in b) that are mutual nearest neighbours, clearest first.
    pub matches: Vec<(u16, u16)>,
    /// Different poses, the best score first.
    pub hypotheses: Vec<Supported>,
    /// The best score if nothing is corrected.
    pub(super) plain_score: f64,
    /// What its log-odds are raised by for how rare right poses are in the graph, and how alike the places that its scans see.
    pub(super) correction: f64,
}

impl Edge {
    /// The hypotheses as motions from one end to the other: `from` is `a` or `b` of the pair.
    pub fn motions_from(&self, from: ScanKey) -> impl Iterator<Item = (Pose, &Supported)> {
        let forward = from == self.pair.b;
        self.hypotheses.iter().map(move |h| {
            let a_from_b = h.hypothesis.a_from_b;
            (if forward { a_from_b } else { a_from_b.inverse() }, h)
        })
    }

    /// The best score, or negative infinity without hypotheses.
    #[must_use]
    pub fn best_score(&self) -> f64 {
        self.hypotheses.first().map_or(f64::NEG_INFINITY, |h| h.score)
    }
}

/// `ln(1 + e^x)`: about the log-odds x where they are positive, and never below zero.
#[must_use]
pub fn softplus(x: f64) -> f64 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// The most that one pair says for a pose: as much as makes a join firm, and half of what the strictest level asks. Its log-odds may be
/// higher, but the verifier was not fitted on places that look alike from two sides; no pair outweighs several that say otherwise.
const MOST_EVIDENCE: f64 = 4.0;

/// What one pair says for a pose of these log-odds, as evidence that adds up over pairs.
#[must_use]
pub fn evidence(log_odds: f64) -> f64 {
    softplus(log_odds).min(MOST_EVIDENCE)
}

/// All scans of a project and all pairs tried. Iteration is always in ascending order of keys.
#[derive(Debug, Clone, Default)]
pub struct ScanGraph {
    scans: BTreeMap<ScanKey, Arc<Scan>>,
    edges: BTreeMap<PairKey, Edge>,
    neighbors: BTreeMap<ScanKey, BTreeSet<ScanKey>>,
    probes: Memo<Probe>,
    correction: f64,
}

impl ScanGraph {
    /// An empty graph.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a scan without edges. A scan that is there already stays.
    pub fn add_scan(&mut self, scan: Arc<Scan>) {
        self.scans.entry(scan.key()).or_insert(scan);
    }

    /// Takes a scan out with all its edges, and takes back the support that it gave. Returns whether it was there.
    pub fn remove_scan(&mut self, key: ScanKey, options: &SupportOptions) -> bool {
        if self.scans.remove(&key).is_none() {
            return false;
        }
        self.probes.forget(key);
        let around: Vec<ScanKey> = self.neighbors.remove(&key).into_iter().flatten().collect();
        for other in &around {
            self.edges.remove(&PairKey::of(key, *other));
            if let Some(neighbors) = self.neighbors.get_mut(other) {
                neighbors.remove(&key);
            }
        }
        self.refresh_support(&self.edges_within(&around), options);
        true
    }

    /// All scans.
    #[must_use]
    pub fn scans(&self) -> impl ExactSizeIterator<Item = &Arc<Scan>> {
        self.scans.values()
    }

    /// One scan.
    #[must_use]
    pub fn scan(&self, key: ScanKey) -> Option<&Arc<Scan>> {
        self.scans.get(&key)
    }

    /// What the log-odds of all hypotheses are raised by for how rare right ones are here; zero or less.
    #[must_use]
    pub const fn correction(&self) -> f64 {
        self.correction
    }

    /// All edges.
    #[must_use]
    pub fn edges(&self) -> impl ExactSizeIterator<Item = &Edge> {
        self.edges.values()
    }

    /// The edge of a pair, if it was tried.
    #[must_use]
    pub fn edge(&self, x: ScanKey, y: ScanKey) -> Option<&Edge> {
        self.edges.get(&PairKey::of(x, y))
    }

    /// Scans that share a tried pair with `key`.
    pub fn neighbors(&self, key: ScanKey) -> impl Iterator<Item = ScanKey> + '_ {
        self.neighbors.get(&key).into_iter().flatten().copied()
    }

    /// What a probe of two scans tells; `None` if one is not there.
    #[must_use]
    pub fn probe(&self, pair: PairKey) -> Option<Probe> {
        let (a, b) = (self.scans.get(&pair.a)?, self.scans.get(&pair.b)?);
        Some(self.probes.answer(pair, || probe(a, b)))
    }

    /// Matches and verifies the pairs that were not tried yet, in parallel, adds them as edges and renews the support of every
    /// hypothesis that they touch. Returns the new results in ascending order. On `Err` the graph is unchanged. Finer surfaces of few scans stay in
    /// memory, until [`ScanGraph::forget_fine`].
    pub fn try_pairs(
        &mut self,
        pairs: &BTreeSet<PairKey>,
        options: &SupportOptions,
        control: Control<'_>,
    ) -> Result<Vec<PairResult>, Cancelled> {
        let fresh: Vec<(&Arc<Scan>, &Arc<Scan>)> = pairs
            .iter()
            .filter(|pair| !self.edges.contains_key(pair))
            .filter_map(|pair| Some((self.scans.get(&pair.a)?, self.scans.get(&pair.b)?)))
            .collect();
        let matching = control.begin(Stage::Match);
        let done = std::sync::atomic::AtomicUsize::new(0);
        let mut results: Vec<PairResult> = Vec::with_capacity(fresh.len());
        for block in fresh.chunks(BLOCK) {
            let matched: Result<Vec<PairResult>, Cancelled> = block
                .par_iter()
                .map(|(a, b)| {
                    control.check()?;
                    let result = match_pair(a, b, &options.verifier);
                    let finished = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
                    control.report(Stage::Match, finished, fresh.len());
                    Ok(result)
                })
                .collect();
            match matched {
                Ok(matched) => results.extend(matched),
                Err(cancelled) => {
                    self.forget_fine();
                    return Err(cancelled);
                }
            }
            self.forget_fine_of_many();
        }
        drop(matching);
        let _supporting = control.begin(Stage::Support);
        self.add_results(results.iter().cloned(), options);
        Ok(results)
    }

    /// Gives back the memory that close looks took ([`Scan::fine`]).
    pub fn forget_fine(&self) {
        for scan in self.scans.values() {
            scan.forget_fine();
        }
    }

    /// The same where it is much.
    pub fn forget_fine_of_many(&self) {
        self.forget_fine_beyond(UNPACKED_POINTS);
    }

    /// The same where they have more points than this.
    fn forget_fine_beyond(&self, most: usize) {
        let unpacked = self.scans.values().filter(|scan| scan.is_unpacked());
        let points = unpacked.filter_map(|scan| scan.prepared.fine.as_ref()).map(FineSurface::count);
        if points.sum::<usize>() > most {
            self.forget_fine();
        }
    }

    /// Adds results of pairs whose scans are both there.
    pub fn add_results(&mut self, results: impl IntoIterator<Item = PairResult>, options: &SupportOptions) {
        let mut touched = BTreeSet::new();
        for result in results {
            let PairKey { a, b } = result.pair;
            if !self.scans.contains_key(&a) || !self.scans.contains_key(&b) {
                continue;
            }
            let hypotheses = result
                .hypotheses
                .into_iter()
                .map(|hypothesis| Supported { hypothesis, support: 0.0, score: hypothesis.logit })
                .collect();
            let PairResult { pair, matches, .. } = result;
            let edge = Edge { pair, matches, hypotheses, plain_score: f64::NEG_INFINITY, correction: 0.0 };
            self.edges.insert(pair, edge);
            self.neighbors.entry(a).or_default().insert(b);
            self.neighbors.entry(b).or_default().insert(a);
            touched.insert(result.pair);
        }
        self.refresh_support(&self.with_triangles(touched), options);
    }

    /// These edges and those whose support they change: an edge (a, b) is one side of the triangles (a, b, k), so beside its own it changes
    /// that of (a, k) and (b, k).
    fn with_triangles(&self, changed: BTreeSet<PairKey>) -> BTreeSet<PairKey> {
        let mut stale = changed.clone();
        for pair in changed {
            let common = |k: &ScanKey| {
                self.edges.contains_key(&PairKey::of(pair.a, *k))
                    && self.edges.contains_key(&PairKey::of(pair.b, *k))
            };
            for k in self.neighbors(pair.a).filter(|k| *k != pair.b).filter(common) {
                stale.insert(PairKey::of(pair.a, k));
                stale.insert(PairKey::of(pair.b, k));
            }
        }
        stale
    }

    fn edges_within(&self, scans: &[ScanKey]) -> BTreeSet<PairKey> {
        let pairs =
            scans.iter().enumerate().flat_map(|(i, x)| scans[i + 1..].iter().map(|y| PairKey::of(*x, *y)));
        pairs.filter(|pair| self.edges.contains_key(pair)).collect()
    }

    /// Renews the support of these edges, and of those on which they shed another light.
    fn refresh_support(&mut self, stale: &BTreeSet<PairKey>, options: &SupportOptions) {
        let Some(fitted) = options.verifier.share_of_right() else {
            return self.renew_support(stale, options);
        };
        for (pair, values) in self.supports(stale, Corrections::Ignored, options) {
            if let Some(edge) = self.edges.get_mut(&pair) {
                edge.plain_score = values.iter().map(|(_, score)| *score).fold(f64::NEG_INFINITY, f64::max);
            }
        }
        let cohorts = Cohorts::of(self.edges.values());
        let of_pair: BTreeMap<PairKey, f64> =
            self.edges.iter().map(|(pair, edge)| (*pair, cohorts.correction(edge))).collect();
        let before = self.correction;
        self.correction = in_steps(correction(self.edges.values(), &of_pair, fitted));
        let mut corrected = BTreeSet::new();
        for (pair, edge) in &mut self.edges {
            let correction = self.correction + in_steps(of_pair[pair]);
            if correction != edge.correction {
                edge.correction = correction;
                corrected.insert(*pair);
            }
        }
        // What all are worth together counts in every path.
        let renewed = if self.correction == before {
            stale.union(&self.with_triangles(corrected)).copied().collect()
        } else {
            self.edges.keys().copied().collect()
        };
        self.renew_support(&renewed, options);
    }

    /// (support, score) of the hypotheses of these edges.
    fn supports(
        &self,
        pairs: &BTreeSet<PairKey>,
        corrections: Corrections,
        options: &SupportOptions,
    ) -> Vec<(PairKey, Vec<(f64, f64)>)> {
        let edges: Vec<&Edge> = pairs.iter().filter_map(|pair| self.edges.get(pair)).collect();
        edges.par_iter().map(|edge| (edge.pair, support(self, edge, corrections, options))).collect()
    }

    fn renew_support(&mut self, stale: &BTreeSet<PairKey>, options: &SupportOptions) {
        for (pair, values) in self.supports(stale, Corrections::Counted, options) {
            let Some(edge) = self.edges.get_mut(&pair) else { continue };
            for (hypothesis, (support, score)) in edge.hypotheses.iter_mut().zip(values) {
                hypothesis.support = support;
                hypothesis.score = score;
            }
            // Equal scores fall back to the pair's own verdict, so that the order never depends on history.
            edge.hypotheses.sort_by(|x, y| {
                y.score.total_cmp(&x.score).then(y.hypothesis.logit.total_cmp(&x.hypothesis.logit))
            });
        }
    }
}

fn in_steps(correction: f64) -> f64 {
    (correction / STEP).round() * STEP
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Observer, Progress, Silent};
    use crate::pairwise::test_survey::hall;

    /// Cancels once anything is done.
    struct Impatient(CancelToken);

    impl Observer for Impatient {
        fn progress(&self, progress: Progress) {
            if progress.done > 0 {
                self.0.cancel();
            }
        }
    }

    /// A hall of three scans, and all its pairs.
    fn three() -> (ScanGraph, BTreeSet<PairKey>) {
        let mut graph = ScanGraph::new();
        for (scan, _) in hall(3).scans {
            graph.add_scan(Arc::new(scan));
        }
        let pair = |a, b| PairKey::of(ScanKey(a), ScanKey(b));
        (graph, [pair(1, 2), pair(1, 3), pair(2, 3)].into())
    }

    fn unpacked(graph: &ScanGraph) -> usize {
        graph.scans.values().filter(|scan| scan.is_unpacked()).count()
    }

    #[test]
    fn finer_surfaces_stay_after_matching_and_go_when_it_is_cancelled() {
        let (mut graph, pairs) = three();
        let options = SupportOptions::default();
        let token = CancelToken::new();
        let impatient = Impatient(token.clone());
        let control = Control { cancel: &token, observer: &impatient };
        // By one thread, which looks whether it is cancelled before the second pair.
        let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
        assert!(alone.install(|| graph.try_pairs(&pairs, &options, control)).is_err());
        assert_eq!((unpacked(&graph), graph.edges().count()), (0, 0));
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let found = graph.try_pairs(&pairs, &options, control).expect("nobody cancels");
        assert_eq!((unpacked(&graph), found.len()), (3, 3), "all are likely, so all are looked at closely");
        graph.forget_fine_of_many();
        assert_eq!(unpacked(&graph), 3, "three are not many");
        let points =
            graph.scans().map(|scan| scan.prepared.fine.as_ref().map_or(0, FineSurface::count)).sum();
        graph.forget_fine_beyond(points);
        assert_eq!(unpacked(&graph), 3);
        graph.forget_fine_beyond(points - 1);
        assert_eq!(unpacked(&graph), 0);
    }
}
