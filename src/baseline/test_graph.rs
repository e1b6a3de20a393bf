//! Scan graphs with known poses for the tests of this layer. The scans hold almost nothing: baselines only read edges.

use std::sync::Arc;

use nalgebra::{Rotation3, Vector3};

use super::Piece;
use crate::cloud::ScanKey;
use crate::features::{PreparedScan, Scan};
use crate::geometry::Pose;
use crate::graph::{ScanGraph, SupportOptions};
use crate::pairwise::{Evidence, Hypothesis, PairKey, PairResult};

/// Scans in a ring, each linked to its next two.
pub(super) struct TestGraph {
    pub truth: Vec<Pose>,
    pairs: Vec<(usize, usize, Pose, f64)>,
}

impl TestGraph {
    pub fn ring(count: usize) -> Self {
        let truth: Vec<Pose> = (0..count)
            .map(|k| {
                let angle = k as f64 * std::f64::consts::TAU / count as f64;
                let turn = Rotation3::new(Vector3::new(0.1 * angle, -0.2, angle));
                Pose::new(turn, Vector3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 0.2 * angle))
            })
            .collect();
        let mut pairs: Vec<(usize, usize, Pose, f64)> = Vec::new();
        for i in 0..count {
            for step in 1..=2 {
                let j = (i + step) % count;
                let (a, b) = (i.min(j), i.max(j));
                if !pairs.iter().any(|p| (p.0, p.1) == (a, b)) {
                    pairs.push((a, b, truth[a].inverse() * truth[b], 5.0 - step as f64));
                }
            }
        }
        Self { truth, pairs }
    }

    pub fn edges(&self) -> usize {
        self.pairs.len()
    }

    /// Whether an edge joins scans below `split` with others.
    pub fn crosses(&self, edge: usize, split: usize) -> bool {
        (self.pairs[edge].0 < split) != (self.pairs[edge].1 < split)
    }

    /// Makes an edge wrong by a metre and a radian, with this score.
    pub fn spoil(&mut self, edge: usize, score: f64) {
        let wrong = Pose::new(Rotation3::new(Vector3::new(0.6, -0.5, 0.6)), Vector3::new(0.5, 0.6, -0.6));
        self.pairs[edge].2 = self.pairs[edge].2 * wrong;
        self.pairs[edge].3 = score;
    }

    pub fn score(&mut self, edge: usize, score: f64) {
        self.pairs[edge].3 = score;
    }

    /// The graph, with scores that are those of the pairs alone.
    pub fn graph(&self) -> ScanGraph {
        let mut graph = ScanGraph::new();
        for k in 0..self.truth.len() {
            graph.add_scan(Arc::new(Scan::new(scan(k))));
        }
        let results = self.pairs.iter().map(|&(a, b, a_from_b, logit)| PairResult {
            pair: PairKey::of(ScanKey(a as u128), ScanKey(b as u128)),
            matches: Vec::new(),
            hypotheses: vec![Hypothesis { a_from_b, evidence: Evidence::default(), logit }],
        });
        graph.add_results(results, &says_nothing_of_triplets());
        graph
    }
}

/// A regression with triplets that hands on what the pair said.
fn says_nothing_of_triplets() -> SupportOptions {
    let mut options = SupportOptions::default();
    let verifier = Arc::make_mut(&mut options.verifier);
    let triplet = &mut verifier.triplet;
    triplet.mean.fill(0.0);
    triplet.deviation.fill(10.0);
    triplet.weights.fill(0.0);
    triplet.weights[1] = 10.0;
    options
}

fn scan(k: usize) -> PreparedScan {
    PreparedScan {
        resolution: 0.05,
        points: vec![[0.5, 0.0, 1.0], [1.5, 0.5, 1.0]],
        normals: vec![[0.0, 0.0, 1.0]; 2],
        ..PreparedScan::empty(ScanKey(k as u128))
    }
}

/// The largest difference of relative poses from the truth in a piece, radians plus metres.
pub(super) fn worst(piece: &Piece, scene: &TestGraph) -> f64 {
    let mut worst = 0.0_f64;
    for (i, model_from_i) in piece {
        for (j, model_from_j) in piece {
            let truth = scene.truth[i.0 as usize].inverse() * scene.truth[j.0 as usize];
            let (angle, distance) = truth.difference(&(model_from_i.inverse() * *model_from_j));
            worst = worst.max(angle + distance);
        }
    }
    worst
}
