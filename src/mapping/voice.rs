//! Which of the pairs that contradict a component say the same. Where alike places were taken for one, all who see it are for the same
//! motion of the one place away from the other; pairs that are wrong by chance each say something else. Used by `testimony` and `undo`.

use std::collections::BTreeSet;

use nalgebra::Vector3;

use super::component::Component;
use super::options::MappingOptions;
use super::testimony::Contradiction;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::{PairKey, centred_difference};

/// Where a contradicting pair would have one of its scans, were the other to stay.
#[derive(Debug, Clone, Copy)]
pub struct Word {
    /// The pair that says it.
    pub pair: PairKey,
    /// Which of its scans would move.
    pub moves: ScanKey,
    /// From where the scan is to where it would be, in the frame of the component.
    pub motion: Pose,
    /// Centroid of the scan, metres, in the frame of the component.
    centroid: Vector3<f64>,
    /// Motions this far apart at the centroid are different, metres.
    reach: f64,
    evidence: f64,
}

/// Of what was said, that which most evidence is for.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Voice {
    /// Pairs that say the same.
    pub pairs: usize,
    /// Their evidence together.
    pub evidence: f64,
}

impl Word {
    fn new(
        graph: &ScanGraph,
        component: &Component,
        contradiction: &Contradiction,
        moves: ScanKey,
        options: &MappingOptions,
    ) -> Option<Self> {
        let PairKey { a, b } = contradiction.pair;
        let a_from_b = contradiction.a_from_b;
        let (stays, stays_from_moves) = if moves == b { (a, a_from_b) } else { (b, a_from_b.inverse()) };
        let (stays, from_local) = (component.poses.get(&stays)?, component.poses.get(&moves)?);
        let scan = graph.scan(moves)?;
        Some(Self {
            pair: contradiction.pair,
            moves,
            motion: *stays * stays_from_moves * from_local.inverse(),
            centroid: from_local.transform(&scan.centroid),
            reach: options.rival_voxels * scan.prepared.resolution,
            evidence: contradiction.evidence,
        })
    }

    /// How contradictions across a cut would have its side moved.
    #[must_use]
    pub fn on_side(
        graph: &ScanGraph,
        component: &Component,
        side: &BTreeSet<ScanKey>,
        contradictions: &[&Contradiction],
        options: &MappingOptions,
    ) -> Vec<Self> {
        let across = contradictions.iter().filter(|c| side.contains(&c.pair.a) != side.contains(&c.pair.b));
        let moves = |pair: PairKey| if side.contains(&pair.b) { pair.b } else { pair.a };
        across.filter_map(|c| Self::new(graph, component, c, moves(c.pair), options)).collect()
    }

    /// What contradictions say when it is not known which side of what should move: each is told both ways.
    #[must_use]
    pub fn both_ways(
        graph: &ScanGraph,
        component: &Component,
        contradictions: &[Contradiction],
        options: &MappingOptions,
    ) -> Vec<Self> {
        let ways = contradictions.iter().flat_map(|c| [(c, c.pair.a), (c, c.pair.b)]);
        ways.filter_map(|(c, moves)| Self::new(graph, component, c, moves, options)).collect()
    }

    /// The scan of the pair that would stay.
    #[must_use]
    pub fn stays(&self) -> ScanKey {
        if self.pair.a == self.moves { self.pair.b } else { self.pair.a }
    }

    fn agrees(&self, other: &Self, angle: f64) -> bool {
        let (turn, distance) = centred_difference(&self.motion, &other.motion, &self.centroid);
        turn < angle && distance < self.reach
    }
}

/// Of several words, those that agree and weigh most together. A pair counts once, whichever way it is told. `angle` in radians.
#[must_use]
pub fn one_voice(words: &[Word], angle: f64) -> Voice {
    let mut voice = Voice::default();
    for word in loudest(words, angle) {
        voice.pairs += 1;
        voice.evidence += word.evidence;
    }
    voice
}

/// The words of that voice, first the one that the others agree with.
#[must_use]
pub fn loudest(words: &[Word], angle: f64) -> Vec<&Word> {
    let voices = words.iter().map(|x| {
        let mut heard = BTreeSet::from([x.pair]);
        let others = words.iter().filter(|y| x.agrees(y, angle) && heard.insert(y.pair));
        let voice: Vec<&Word> = std::iter::once(x).chain(others).collect();
        (voice.iter().map(|word| word.evidence).sum::<f64>(), voice)
    });
    voices.max_by(|x, y| x.0.total_cmp(&y.0)).map(|(_, voice)| voice).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;

    use super::*;

    fn word(b: u128, motion: Pose, centroid: f64, evidence: f64) -> Word {
        let pair = PairKey::of(ScanKey(1), ScanKey(b));
        Word {
            pair,
            moves: ScanKey(b),
            motion,
            centroid: Vector3::new(centroid, 0.0, 0.0),
            reach: 0.5,
            evidence,
        }
    }

    fn turned(x: f64) -> Pose {
        Pose::new(Rotation3::from_axis_angle(&Vector3::z_axis(), 1.0), Vector3::new(x, 0.0, 0.0))
    }

    #[test]
    fn only_pairs_that_say_the_same_speak_with_one_voice() {
        let mut words = vec![
            word(2, turned(3.0), 7.0, 2.5),
            word(3, turned(3.2), -4.0, 2.6),
            word(4, turned(-1.0), 0.0, 4.0),
        ];
        let voice = one_voice(&words, 0.25);
        assert_eq!(voice.pairs, 2);
        assert!((voice.evidence - 5.1).abs() < 1e-12);
        words[1].motion = words[1].motion.inverse();
        assert_eq!(one_voice(&words, 0.25), Voice { pairs: 1, evidence: 4.0 });
        assert_eq!(one_voice(&[], 0.25), Voice::default());
    }

    #[test]
    fn a_pair_that_is_told_both_ways_is_heard_once() {
        let half =
            Pose::new(Rotation3::from_axis_angle(&Vector3::z_axis(), std::f64::consts::PI), Vector3::zeros());
        // Half a turn is its own inverse.
        let words = [word(2, half, 1.0, 2.5), word(2, half.inverse(), -1.0, 2.5), word(3, half, 1.0, 2.0)];
        assert_eq!(one_voice(&words, 0.25), Voice { pairs: 2, evidence: 4.5 });
    }
}
