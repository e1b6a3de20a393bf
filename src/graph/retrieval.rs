//! Which pairs are worth matching: for each scan the others, the likeliest to overlap it first. Two stages: the global signatures of all
//! scans, compared in microseconds; then a probe of the most similar ones (`pairwise::probe`), a third of a millisecond each, which the
//! graph keeps: the order for a new scan among sixty costs some twenty milliseconds of CPU, and later none.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;

use super::scan_graph::ScanGraph;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::features::SIGNATURE_LEN;
use crate::pairwise::{PairKey, Probe};

/// Scans that are probed for one scan, the most similar ones by signature; the others follow in the order of similarity.
const PROBED: usize = 120;

/// The signatures of a graph's scans, ready to be compared.
pub struct Retrieval<'g> {
    graph: &'g ScanGraph,
    centred: BTreeMap<ScanKey, Vec<f32>>,
}

impl<'g> Retrieval<'g> {
    /// Centres the signatures: what all scans of a project have in common says nothing about pairs.
    #[must_use]
    pub fn new(graph: &'g ScanGraph) -> Self {
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
        Self { graph, centred }
    }

    /// For each scan all others, the likeliest to overlap first, each with how much likelier than the average of those probed (in standard
    /// deviations). Ties by key. Nothing for a scan that is not in the graph. A pair of the scans asked about is probed only once.
    pub fn ranked(
        &self,
        keys: impl IntoIterator<Item = ScanKey>,
        control: Control<'_>,
    ) -> Result<BTreeMap<ScanKey, Vec<(ScanKey, f32)>>, Cancelled> {
        let similar: BTreeMap<ScanKey, Vec<(ScanKey, f32)>> =
            keys.into_iter().map(|key| (key, self.similar(key))).collect();
        let pairs: BTreeSet<PairKey> = similar
            .iter()
            .flat_map(|(key, others)| others.iter().take(PROBED).map(|(other, _)| PairKey::of(*key, *other)))
            .collect();
        let probes: BTreeMap<PairKey, Probe> = pairs
            .into_iter()
            .collect::<Vec<_>>()
            .into_par_iter()
            .filter_map(|pair| match control.check() {
                Ok(()) => self.graph.probe(pair).map(|probe| Ok((pair, probe))),
                Err(cancelled) => Some(Err(cancelled)),
            })
            .collect::<Result<_, Cancelled>>()?;
        Ok(similar.into_iter().map(|(key, others)| (key, ranking(key, others, &probes))).collect())
    }

    /// All other scans, the most similar signature first.
    fn similar(&self, key: ScanKey) -> Vec<(ScanKey, f32)> {
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

/// The probed ones by similarity, consensus and clarity, each measured in its standard deviation; the others behind them.
fn ranking(
    key: ScanKey,
    mut others: Vec<(ScanKey, f32)>,
    probes: &BTreeMap<PairKey, Probe>,
) -> Vec<(ScanKey, f32)> {
    let rest = others.split_off(others.len().min(PROBED));
    let probed: Vec<Probe> = others
        .iter()
        .map(|(other, _)| probes.get(&PairKey::of(key, *other)).copied().unwrap_or_default())
        .collect();
    let similarity = standardised(others.iter().map(|(_, similarity)| *similarity).collect());
    let consensus = standardised(probed.iter().map(|p| p.consensus).collect());
    let clarity = standardised(probed.iter().map(|p| p.clarity).collect());
    for (index, (_, score)) in others.iter_mut().enumerate() {
        *score = similarity[index] + consensus[index] + clarity[index];
    }
    others.sort_by(|x, y| y.1.total_cmp(&x.1).then(x.0.cmp(&y.0)));
    let least = others.last().map_or(0.0, |(_, score)| *score);
    others.extend(rest.into_iter().map(|(other, _)| (other, least)));
    others
}

/// The values with their mean at 0 and their standard deviation at 1, or all at 0 if they are equal.
fn standardised(mut values: Vec<f32>) -> Vec<f32> {
    let count = values.len().max(1) as f32;
    let mean = values.iter().sum::<f32>() / count;
    let deviation = (values.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / count).sqrt();
    for x in &mut values {
        *x = if deviation > 1e-9 { (*x - mean) / deviation } else { 0.0 };
    }
    values
}

/// The pairs of each of `scans` with the `top` scans that are likeliest to overlap it: the union over `scans`.
pub fn retrieve(
    retrieval: &Retrieval<'_>,
    scans: impl IntoIterator<Item = ScanKey>,
    top: usize,
    control: Control<'_>,
) -> Result<BTreeSet<PairKey>, Cancelled> {
    let ranked = retrieval.ranked(scans, control)?;
    let nearest = |(scan, others): (ScanKey, Vec<(ScanKey, f32)>)| {
        others.into_iter().take(top).map(move |(other, _)| PairKey::of(scan, other))
    };
    Ok(ranked.into_iter().flat_map(nearest).collect())
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::control::{CancelToken, Control, Seed, Silent};
    use crate::features::{PrepareOptions, Scan, SensorPosition, prepare};
    use crate::simulate::{Sensor, SurveyOptions, simulate};

    #[test]
    fn scans_that_overlap_are_ranked_before_those_that_do_not() {
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let survey = simulate(&SurveyOptions {
            sensor: Sensor::panoramic(12_000),
            stations: 12,
            seed: Seed(3),
            ..SurveyOptions::default()
        })
        .expect("the options are valid");
        let overlaps = survey.overlaps(0.3);
        let options = PrepareOptions::at(0.15, Seed(0));
        let mut graph = ScanGraph::new();
        for (key, scan) in (0..).zip(&survey.scans) {
            let prepared = prepare(ScanKey(key), &scan.cloud, SensorPosition::default(), &options, control)
                .expect("the scan is large enough");
            graph.add_scan(Arc::new(Scan::new(prepared)));
        }
        let ranked = Retrieval::new(&graph).ranked(graph.scans().map(|s| s.key()), control).unwrap();
        let overlap = |x: ScanKey, y: ScanKey| overlaps[x.0 as usize][y.0 as usize];
        let mean = |part: fn(&[(ScanKey, f32)]) -> Vec<ScanKey>| {
            let all: Vec<f64> = ranked
                .iter()
                .flat_map(|(x, others)| part(others).into_iter().map(|y| overlap(*x, y)))
                .collect();
            all.iter().sum::<f64>() / all.len() as f64
        };
        let first = mean(|others| others[..3].iter().map(|o| o.0).collect());
        let last = mean(|others| others[8..].iter().map(|o| o.0).collect());
        assert!(ranked.values().all(|others| others.len() == 11));
        assert!(first > 2.0 * last, "the first three overlap by {first:.2}, the last three by {last:.2}");
        let pairs = retrieve(&Retrieval::new(&graph), [ScanKey(4)], 3, control).unwrap();
        assert_eq!(pairs.len(), 3);
        assert!(Retrieval::new(&graph).ranked([ScanKey(99)], control).unwrap()[&ScanKey(99)].is_empty());
        token.cancel();
        assert!(Retrieval::new(&graph).ranked([ScanKey(4)], control).is_err());
    }
}
