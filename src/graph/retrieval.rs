//! Which pairs are worth matching: per scan the most similar scans by global signature, then the union over scans.

use std::collections::{BTreeMap, BTreeSet};

use crate::cloud::ScanKey;
use crate::features::SIGNATURE_LEN;
use crate::pairwise::PairKey;

use super::scan_graph::ScanGraph;

/// Signatures of all scans, centred on their mean, ready to be compared.
pub struct Retrieval {
    centred: BTreeMap<ScanKey, Vec<f32>>,
}

impl Retrieval {
    /// Centres the signatures: what all scans of a project have in common says nothing about pairs.
    #[must_use]
    pub fn new(graph: &ScanGraph) -> Self {
        let count = graph.scans().len().max(1) as f32;
        let mut mean = vec![0.0_f32; SIGNATURE_LEN];
        for scan in graph.scans() {
            for (total, x) in mean.iter_mut().zip(&scan.prepared.signature) {
                *total += x / count;
            }
        }
        let centred = graph
            .scans()
            .map(|scan| {
                let offset: Vec<f32> =
                    scan.prepared.signature.iter().zip(&mean).map(|(x, m)| x - m).collect();
                let norm = offset.iter().map(|x| x * x).sum::<f32>().sqrt().max(1e-12);
                (scan.key(), offset.iter().map(|x| x / norm).collect())
            })
            .collect();
        Self { centred }
    }

    /// All other scans, the most similar first; ties by key.
    #[must_use]
    pub fn ranked(&self, key: ScanKey) -> Vec<(ScanKey, f32)> {
        let Some(me) = self.centred.get(&key) else { return Vec::new() };
        let mut others: Vec<(ScanKey, f32)> = self
            .centred
            .iter()
            .filter(|(other, _)| **other != key)
            .map(|(other, signature)| (*other, signature.iter().zip(me).map(|(x, y)| x * y).sum()))
            .collect();
        others.sort_by(|x, y| y.1.total_cmp(&x.1).then(x.0.cmp(&y.0)));
        others
    }
}

/// The pairs of each of `scans` with its `top` most similar scans: the union over `scans`.
#[must_use]
pub fn retrieve(
    retrieval: &Retrieval,
    scans: impl IntoIterator<Item = ScanKey>,
    top: usize,
) -> BTreeSet<PairKey> {
    scans
        .into_iter()
        .flat_map(|scan| {
            retrieval.ranked(scan).into_iter().take(top).map(move |(other, _)| PairKey::of(scan, other))
        })
        .collect()
}
