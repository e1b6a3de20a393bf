//! What pairs say by themselves of where their scans are in a component: which are sure of another pose, and whether they say it with one
//! voice.

use std::collections::BTreeSet;

use super::component::Component;
use super::denial::Denials;
use super::hearing::{Hearing, Ruling};
use super::options::MappingOptions;
use super::voice::{Voice, Word, loudest, one_voice};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::{ScanGraph, evidence};
use crate::pairwise::{PairKey, centred_difference, is_clearly_worse, look_finely};

/// A pair says that much by itself when it counts as a witness: a likelihood of 0.86.
const WITNESS: f64 = 2.0;
/// A pair speaks against a component only if its pose differs by this many times what makes a rival.
pub const CLEARLY_DIFFERENT: f64 = 2.0;
/// A component is contradicted when what is said against it with one voice, beyond a witness's least, comes to this for each witness for
/// it …
const CONTRADICTED_WEIGHT: f64 = 0.03;
/// … and at least to this, …
const CONTRADICTED_LEAST: f64 = 3.0;
/// … by at least this many pairs.
const CONTRADICTED_PAIRS: usize = 2;
/// Voices that are given a hearing; if there are more, the next is believed.
const HEARINGS: usize = 12;

/// A pair of scans in one component whose own evidence is for another pose than the one they have.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Contradiction {
    /// Which pair.
    pub pair: PairKey,
    /// The other pose, between the local frames of the pair's scans.
    pub a_from_b: Pose,
    /// What the pair alone says for the other pose.
    pub evidence: f64,
    /// Angle between the two poses, radians.
    pub angle: f64,
    /// How far apart they put the centroid of the pair's second scan, metres.
    pub distance: f64,
}

/// What pairs say by themselves of a component's poses. Third scans are not asked: where rooms are alike, they repeat what is wrong
/// until it drowns what is right.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Testimony {
    /// Pairs that are sure of the pose they have.
    pub agreeing: usize,
    /// Pairs that are sure of another, the surest first.
    pub contradictions: Vec<Contradiction>,
    /// Of these, what most say alike.
    pub voice: Voice,
    /// What a hearing found of that, if there was one that did not refute it.
    pub ruling: Option<Ruling>,
}

impl Contradiction {
    /// Of a pair whose pose is wrong, without a word of which is right.
    #[must_use]
    pub fn of_pose(pair: PairKey, a_from_b: Pose) -> Self {
        Self { pair, a_from_b, evidence: 0.0, angle: 0.0, distance: 0.0 }
    }
}

impl Testimony {
    /// Asks the pairs that contradict again, with a second look, if several speak with the voice that weighs most. A pair whose scans fit
    /// clearly better where they are than where it would have them is no witness. What is still said with so much weight that the component
    /// could not stand is given a hearing, voice by voice, and ignored where it is refuted. Of the component's scans, `waits` only stand in it.
    pub fn cross_examine(
        &mut self,
        graph: &ScanGraph,
        component: &Component,
        waits: &BTreeSet<ScanKey>,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        if self.voice.pairs < CONTRADICTED_PAIRS {
            return Ok(());
        }
        let mut upheld = Vec::with_capacity(self.contradictions.len());
        for contradiction in &self.contradictions {
            control.check()?;
            if !is_refuted(graph, component, contradiction).unwrap_or(false) {
                upheld.push(*contradiction);
            }
        }
        self.contradictions = upheld;
        self.listen(graph, component, options);
        let mut hearing: Option<Hearing<'_>> = None;
        for _ in 0..HEARINGS {
            if !self.condemns() {
                break;
            }
            let words = Word::both_ways(graph, component, &self.contradictions, options);
            let voice = loudest(&words, options.rival_angle);
            if hearing.is_none() {
                let undenied = Denials::of(graph, component, options).nobody_denies();
                hearing = Some(Hearing::open(graph, component, control)?.asking_less(undenied));
            }
            let ruling = match &hearing {
                Some(hearing) => hearing.hear(&voice, waits, options, control)?,
                None => Ruling::Believable,
            };
            if ruling != Ruling::Refuted {
                self.ruling = Some(ruling);
                break;
            }
            self.contradictions.retain(|c| voice.iter().all(|word| word.pair != c.pair));
            self.listen(graph, component, options);
        }
        Ok(())
    }

    /// Hears what most contradictions say alike.
    fn listen(&mut self, graph: &ScanGraph, component: &Component, options: &MappingOptions) {
        let words = Word::both_ways(graph, component, &self.contradictions, options);
        self.voice = one_voice(&words, options.rival_angle);
    }

    /// Whether too much is said against the component for it to be right. Where all is right, chance says a different thing each time, at
    /// most 0.012 for each witness; where alike rooms were folded onto each other, one voice says 0.04 and more, mostly far more.
    #[must_use]
    pub fn condemns(&self) -> bool {
        self.condemns_by(CONTRADICTED_WEIGHT)
    }

    /// The same where what is said must come to so much for each witness.
    #[must_use]
    pub fn condemns_by(&self, each: f64) -> bool {
        let weight = self.voice.evidence - WITNESS * self.voice.pairs as f64;
        self.voice.pairs >= CONTRADICTED_PAIRS
            && weight >= (each * self.agreeing as f64).max(CONTRADICTED_LEAST)
    }

    /// The contradictions between scans of a component, the surest first.
    pub fn inside<'t>(&'t self, component: &'t Component) -> impl Iterator<Item = &'t Contradiction> {
        let within = |scan: ScanKey| component.poses.contains_key(&scan);
        self.contradictions.iter().filter(move |c| within(c.pair.a) && within(c.pair.b))
    }
}

/// Asks every pair of a component's scans. Pairs that a client decided about are not asked.
#[must_use]
pub fn testimony(graph: &ScanGraph, component: &Component, options: &MappingOptions) -> Testimony {
    let mut found = Testimony::default();
    for (a, model_from_a) in &component.poses {
        for b in graph.neighbors(*a).filter(|b| b > a) {
            let (Some(model_from_b), Some(edge), Some(scan)) =
                (component.poses.get(&b), graph.edge(*a, b), graph.scan(b))
            else {
                continue;
            };
            if options.decisions.concern(edge.pair) {
                continue;
            }
            let now = model_from_a.inverse() * *model_from_b;
            let reach = options.rival_voxels * scan.prepared.resolution;
            let mut agreeing = 0.0_f64;
            let mut other: Option<Contradiction> = None;
            for h in &edge.hypotheses {
                let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &now, &scan.centroid);
                let said = evidence(h.hypothesis.logit);
                if angle < options.rival_angle && distance < reach {
                    agreeing = agreeing.max(said).max(evidence(h.score));
                } else if (angle > CLEARLY_DIFFERENT * options.rival_angle
                    || distance > CLEARLY_DIFFERENT * reach)
                    && other.is_none_or(|known| said > known.evidence)
                {
                    let a_from_b = h.hypothesis.a_from_b;
                    other =
                        Some(Contradiction { pair: edge.pair, a_from_b, evidence: said, angle, distance });
                }
            }
            match other {
                Some(other) if other.evidence > WITNESS && other.evidence > agreeing => {
                    found.contradictions.push(other);
                }
                _ => found.agreeing += usize::from(agreeing > WITNESS),
            }
        }
    }
    found.contradictions.sort_by(|x, y| y.evidence.total_cmp(&x.evidence).then(x.pair.cmp(&y.pair)));
    found.listen(graph, component, options);
    found
}

/// Whether a second look at a pair speaks clearly for the pose it has, against the one that it is sure of by itself. `None` where the data
/// are too coarse for one.
fn is_refuted(graph: &ScanGraph, component: &Component, contradiction: &Contradiction) -> Option<bool> {
    let PairKey { a, b } = contradiction.pair;
    let now = component.poses.get(&a)?.inverse() * *component.poses.get(&b)?;
    let (a, b) = (graph.scan(a)?, graph.scan(b)?);
    let (here, there) = (look_finely(a, b, &now)?, look_finely(a, b, &contradiction.a_from_b)?);
    Some(is_clearly_worse(&here, &there, a.prepared.resolution / 2.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::test_hall::Model;

    #[test]
    fn what_pairs_say_by_chance_does_not_add_up_but_one_voice_condemns() {
        let said = |evidence: f64| Contradiction {
            pair: PairKey::of(ScanKey(1), ScanKey(2)),
            a_from_b: Pose::identity(),
            evidence,
            angle: 3.0,
            distance: 4.0,
        };
        let contradictions: Vec<Contradiction> = [4.0, 4.0, 3.5, 3.0].map(said).to_vec();
        let voiced = |pairs: usize, evidence: f64| Testimony {
            agreeing: 100,
            contradictions: contradictions.clone(),
            voice: Voice { pairs, evidence },
            ruling: None,
        };
        assert!(!voiced(1, 4.0).condemns());
        assert!(voiced(3, 11.0).condemns());
        // Two that hardly believe it themselves are still chance.
        assert!(!voiced(2, 4.5).condemns());
    }
    #[test]
    fn a_second_look_refutes_pairs_that_a_hall_misleads_and_no_others() {
        let model = Model::new(5);
        let refuted = |component: &Component, said: &[Contradiction]| {
            said.iter().filter(|c| is_refuted(&model.graph, component, c) == Some(true)).count()
        };
        let pairs = [(1, 2), (1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5), (3, 4), (3, 5), (4, 5)];
        let misled: Vec<Contradiction> = pairs.iter().map(|p| model.contradiction(*p, false)).collect();
        let found = refuted(&model.component, &misled);
        assert!(found >= 6, "{found} of 10");
        let of_the_turned = pairs.iter().filter(|(_, b)| *b == 5);
        let right: Vec<Contradiction> = of_the_turned.map(|p| model.contradiction(*p, true)).collect();
        assert_eq!(refuted(&model.with_turned(&[5]), &right), 0);
        assert_eq!(is_refuted(&model.coarse(), &model.component, &misled[0]), None);
    }
}
