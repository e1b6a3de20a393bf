//! A model of a hall whose pairs say what a test has them say.

use std::sync::Arc;

use super::component::Component;
use super::testimony::Contradiction;
use super::tracks::Tracks;
use crate::cloud::ScanKey;
use crate::features::{PreparedScan, Scan};
use crate::geometry::Pose;
use crate::graph::{ScanGraph, SupportOptions};
use crate::pairwise::test_survey::{Hall, hall};
use crate::pairwise::{Counts, Evidence, Hypothesis, PairKey, PairResult};

/// The hall, all its scans where they belong, and a graph in which every pair knows that.
pub struct Model {
    pub hall: Hall,
    pub component: Component,
    pub graph: ScanGraph,
}

impl Model {
    pub fn new(stations: usize) -> Self {
        let hall = hall(stations);
        let graph = graph(hall.scans.iter().map(|(scan, _)| scan.clone()), &hall.scans);
        let poses = hall.scans.iter().map(|(scan, pose)| (scan.key(), *pose)).collect();
        let component = Component { gauge: ScanKey(1), poses, tracks: Tracks::default() };
        Self { hall, component, graph }
    }

    /// The same without surfaces at half the voxel.
    pub fn coarse(&self) -> ScanGraph {
        let bare = |scan: &Scan| Scan::new(PreparedScan { fine: None, ..scan.prepared.clone() });
        graph(self.hall.scans.iter().map(|(scan, _)| bare(scan)), &self.hall.scans)
    }

    /// The component with some scans at the wrong end of the hall.
    pub fn with_turned(&self, scans: &[u128]) -> Component {
        let mut wrong = self.component.clone();
        for scan in scans {
            let pose = wrong.poses.get_mut(&ScanKey(*scan)).expect("a scan of the hall");
            *pose = self.hall.turned * *pose;
        }
        wrong
    }

    /// A graph whose pairs say this of the pose they have, log-odds and points in free space: by default they are sure, with little in free space. Of
    /// 1,000 points, so many coincide, as far apart as that.
    pub fn graph_where(
        &self,
        said: &[((u128, u128), f64, u32)],
        inliers: u32,
        apart_voxels: f32,
    ) -> ScanGraph {
        let result = |a: u128, b: u128| {
            let (logit, violations) = said
                .iter()
                .find(|(pair, ..)| *pair == (a, b))
                .map_or((8.0, 2), |(_, logit, violations)| (*logit, *violations));
            let apart = apart_voxels * self.hall.resolution as f32;
            let plane_square = inliers as f32 * apart * apart;
            let counts = Counts { points: 1000, inliers, violations, plane_square, ..Counts::default() };
            let evidence =
                Evidence { b_on_a: counts, a_on_b: counts, range_images: 2, ..Evidence::default() };
            let a_from_b = self.contradiction((a, b), true).a_from_b;
            PairResult {
                pair: PairKey::of(ScanKey(a), ScanKey(b)),
                matches: Vec::new(),
                hypotheses: vec![Hypothesis { a_from_b, evidence, logit }],
            }
        };
        let stations = self.hall.scans.len() as u128;
        let pairs = (1..=stations).flat_map(|a| (a + 1..=stations).map(move |b| (a, b)));
        let mut graph = self.graph.clone();
        graph.add_results(pairs.map(|(a, b)| result(a, b)), &SupportOptions::default());
        graph
    }

    /// What a pair contradicts a component by that says that its ends are where they truly are, or that they are not.
    pub fn contradiction(&self, (a, b): (u128, u128), truly: bool) -> Contradiction {
        let (at_a, at_b) = (self.component.poses[&ScanKey(a)], self.component.poses[&ScanKey(b)]);
        let model_from_b = if truly { at_b } else { self.hall.turned * at_b };
        Contradiction {
            pair: PairKey::of(ScanKey(a), ScanKey(b)),
            a_from_b: at_a.inverse() * model_from_b,
            evidence: 4.0,
            angle: std::f64::consts::PI,
            distance: 5.0,
        }
    }
}

fn graph(scans: impl Iterator<Item = Scan>, truth: &[(Scan, Pose)]) -> ScanGraph {
    let mut graph = ScanGraph::new();
    scans.for_each(|scan| graph.add_scan(Arc::new(scan)));
    let pairs = truth.iter().enumerate().flat_map(|(i, b)| truth[..i].iter().map(move |a| (a, b)));
    let results = pairs.map(|((a, model_from_a), (b, model_from_b))| PairResult {
        pair: PairKey::of(a.key(), b.key()),
        matches: Vec::new(),
        hypotheses: vec![Hypothesis {
            a_from_b: model_from_a.inverse() * *model_from_b,
            evidence: Evidence::default(),
            logit: 6.0,
        }],
    });
    let results: Vec<PairResult> = results.collect();
    graph.add_results(results, &SupportOptions::default());
    graph
}
