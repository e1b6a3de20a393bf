//! A cheap guess at whether two scans overlap, some thirty times cheaper than matching them: a few of their keypoints are matched, and
//! it is counted how clearly and how consistently. Used by `graph::retrieval` to choose the pairs that are worth more.

use super::consensus::{ConsensusOptions, consensus};
use super::matching::{Match, mutual};
use crate::features::{DESCRIPTOR_LEN, PreparedScan, Scan};

/// Keypoints of each scan that are matched, evenly spread over it, and matches kept.
const KEYPOINTS: usize = 256;
const MATCHES: usize = 128;
/// Consensus sets that are grown.
const SEEDS: usize = 3;

/// What a glance at two scans says for their overlap. Symmetrical, and to be compared with other pairs of the same scan.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Probe {
    /// Log of one more than the soft count of matches in the best consensus.
    pub consensus: f32,
    /// Sum over the matches of how clear each is.
    pub clarity: f32,
}

/// Probes two different scans at one resolution, in either order.
#[must_use]
pub fn probe(x: &Scan, y: &Scan) -> Probe {
    let (a, b) = if x.key() < y.key() { (x, y) } else { (y, x) };
    let (in_a, in_b) = (Sample::of(&a.prepared), Sample::of(&b.prepared));
    let matches: Vec<Match> = mutual(&in_a.descriptors, &in_b.descriptors, MATCHES)
        .into_iter()
        .map(|m| Match { a: in_a.keypoints[usize::from(m.a)], b: in_b.keypoints[usize::from(m.b)], ..m })
        .collect();
    let options = ConsensusOptions { seeds: SEEDS, keep: 1, ..ConsensusOptions::default() };
    let agreeing = consensus(a, b, &matches, &options).first().map_or(0.0, |best| best.score);
    Probe { consensus: agreeing.ln_1p() as f32, clarity: matches.iter().map(|m| 1.0 - m.ambiguity).sum() }
}

/// Some keypoints of a scan.
struct Sample {
    /// Their numbers in the scan.
    keypoints: Vec<u16>,
    descriptors: Vec<f32>,
}

impl Sample {
    fn of(scan: &PreparedScan) -> Self {
        let all = scan.keypoints.len();
        let count = all.min(KEYPOINTS);
        let keypoints: Vec<u16> = (0..count).map(|i| (i * all / count) as u16).collect();
        let descriptors = keypoints
            .iter()
            .flat_map(|k| &scan.descriptors[usize::from(*k) * DESCRIPTOR_LEN..][..DESCRIPTOR_LEN])
            .copied()
            .collect();
        Self { keypoints, descriptors }
    }
}
