//! A hearing: whether what several pairs say alike against a component can be true. Then some of its scans would have to move, together,
//! and would fit the rest no worse where they went. Where alike places were folded onto each other they do; where a place looks alike
//! from both ends, such as a hall, all who see more of it than the pairs that were misled say that the scans belong where they are, or, if
//! it is the component that was misled, that they belong where the voice would have them. Used by `testimony`.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::component::Component;
use super::moves::{Losses, Move};
use super::options::MappingOptions;
use super::voice::Word;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::features::Scan;
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph};
use crate::pairwise::{Counts, centred_difference, icp, look_finely, preference, quick_overlap};

/// What one pair can say for or against a move, at most, in log-odds: what misleads one look misleads others.
const MOST: f64 = 3.0;
/// Points that are looked at to see whether scans would meet at all where they moved to, …
const QUICK_POINTS: usize = 500;
/// … and the share of them that must.
const LEAST_OVERLAP: f64 = 0.02;
/// Pairs that share more than this show what is usual.
const USUAL_OVERLAP: f64 = 0.1;

/// What comes of a hearing.
#[derive(Debug, Clone, PartialEq)]
pub enum Ruling {
    /// The scans fit clearly better where they are.
    Refuted,
    /// These fit the rest better where the voice would have them.
    Moves {
        /// Which.
        scans: BTreeSet<ScanKey>,
        /// By what motion in the frame of the component.
        motion: Pose,
        /// By more than alike places that were folded onto each other ever show.
        clearly: bool,
    },
    /// Most say that these few scans belong where they are, but somebody is sure that they do not.
    Open(BTreeSet<ScanKey>),
    /// Nothing tells which is right.
    Believable,
}

/// All pairs of a component as they are, to be asked what they lose where scans move.
pub struct Hearing<'g> {
    keys: Vec<ScanKey>,
    /// By the places of their scans among the keys; those without fine surfaces have nothing to say.
    pairs: Vec<(usize, usize, Option<Seen<'g>>)>,
    usual: Option<Counts>,
    /// Whether no pair denies what the component makes of its scans, as far as is known.
    undenied: bool,
}

impl<'g> Hearing<'g> {
    /// Looks at every pair with the finest surfaces there are.
    pub fn open(
        graph: &'g ScanGraph,
        component: &Component,
        control: Control<'_>,
    ) -> Result<Self, Cancelled> {
        let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
        let index = |scan: ScanKey| keys.binary_search(&scan).ok();
        let edges: Vec<(usize, usize, &Edge)> =
            graph.edges().filter_map(|edge| Some((index(edge.pair.a)?, index(edge.pair.b)?, edge))).collect();
        let look = |&(i, j, edge): &(usize, usize, &'g Edge)| {
            control.check().map(|()| (i, j, Seen::now(graph, component, edge)))
        };
        let pairs = edges.par_iter().map(look).collect::<Result<Vec<_>, Cancelled>>()?;
        let usual = usual(&pairs);
        Ok(Self { keys, pairs, usual, undenied: false })
    }

    /// Asks less for a refutation if no pair denies what the component makes of its scans.
    #[must_use]
    pub fn asking_less(self, undenied: bool) -> Self {
        Self { undenied, ..self }
    }

    /// What becomes of the scans that these words, which agree with the first, would move. Where there are no fine surfaces, nothing tells.
    /// What moves scans to where they fit better comes before what leaves all in doubt, and that before what leaves a few. Scans that wait
    /// (`waits`) stand in the component for what they say; words by which only they would move, or all others, say nothing of the rest.
    pub fn hear(
        &self,
        words: &[&Word],
        waits: &BTreeSet<ScanKey>,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Ruling, Cancelled> {
        let Some(first) = words.first() else { return Ok(Ruling::Believable) };
        let losses = self.losses(&first.motion, options, control)?;
        let index = |scan: ScanKey| self.keys.binary_search(&scan).ok();
        let mut best: Option<Move> = None;
        let (mut open, mut believable) = (None, false);
        for word in words {
            control.check()?;
            let (Some(stays), Some(moves)) = (index(word.stays()), index(word.moves)) else { continue };
            let Some(found) = Move::cheapest(&losses, stays, moves) else { continue };
            if found.is_refuted(self.undenied) || self.is_idle(&found, waits) {
                continue;
            }
            let improved = found.descended(&losses);
            if improved.is_better() && !self.is_idle(&improved, waits) {
                if best.as_ref().is_none_or(|best| improved.lost < best.lost) {
                    best = Some(improved);
                }
            } else if let Some(few) = found.few_in_doubt() {
                open = open.or(Some(few));
            } else {
                believable = true;
            }
        }
        let scans = |indices: Vec<usize>| indices.into_iter().map(|i| self.keys[i]).collect();
        Ok(match (best, open) {
            (Some(best), _) => {
                let clearly = best.is_clearly_better();
                Ruling::Moves { scans: scans(best.side(true)), motion: first.motion, clearly }
            }
            (None, Some(few)) if !believable => Ruling::Open(scans(few)),
            (None, None) if !believable => Ruling::Refuted,
            (None, _) => Ruling::Believable,
        })
    }

    /// Whether only scans that wait would move, or all others.
    fn is_idle(&self, found: &Move, waits: &BTreeSet<ScanKey>) -> bool {
        let of_the_rest = |moving: bool| found.side(moving).iter().any(|i| !waits.contains(&self.keys[*i]));
        !of_the_rest(true) || !of_the_rest(false)
    }

    fn losses(
        &self,
        motion: &Pose,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Losses, Cancelled> {
        let one = |(_, _, seen): &(usize, usize, Option<Seen<'g>>)| {
            control.check()?;
            let loss = seen.as_ref().and_then(|seen| seen.loss(self.usual.as_ref(), motion, options));
            Ok(loss.unwrap_or_default())
        };
        let found = self.pairs.par_iter().map(one).collect::<Result<Vec<Loss>, Cancelled>>()?;
        let mut losses = Losses::none(self.keys.len());
        for ((i, j, seen), loss) in self.pairs.iter().zip(found) {
            losses.set(*i, *j, loss.b_moves);
            losses.set(*j, *i, loss.a_moves);
            if seen.as_ref().is_some_and(|seen| seen.counts.is_some()) {
                losses.tie(*i, *j);
            }
        }
        Ok(losses)
    }
}

/// What a pair loses in log-odds where one of its scans moves and the other stays; nothing where it cannot tell.
#[derive(Debug, Clone, Copy, Default)]
struct Loss {
    b_moves: f64,
    a_moves: f64,
}

/// A pair as it is now.
struct Seen<'g> {
    edge: &'g Edge,
    a: &'g Scan,
    b: &'g Scan,
    model_from_a: Pose,
    model_from_b: Pose,
    /// What a fine look tells; `None` where the scans do not meet.
    counts: Option<Counts>,
}

/// What is usual for pairs that meet: the median of their shares in free space, and of how far apart their surfaces are.
fn usual(pairs: &[(usize, usize, Option<Seen<'_>>)]) -> Option<Counts> {
    let seen = pairs.iter().filter_map(|(_, _, seen)| seen.as_ref()?.counts);
    let counts: Vec<Counts> = seen.filter(|counts| counts.overlap() > USUAL_OVERLAP).collect();
    let median = |of: fn(&Counts) -> f64| {
        let mut sorted = counts.clone();
        sorted.sort_by(|x, y| of(x).total_cmp(&of(y)));
        sorted.get(sorted.len() / 2).copied()
    };
    let square = |counts: &Counts| f64::from(counts.plane_square) / f64::from(counts.inliers.max(1));
    let (violating, apart) = (median(Counts::violation_share)?, median(square)?);
    let plane_square = (square(&apart) * f64::from(violating.inliers)) as f32;
    Some(Counts { plane_square, ..violating })
}

impl<'g> Seen<'g> {
    /// `None` where there are no fine surfaces.
    fn now(graph: &'g ScanGraph, component: &Component, edge: &'g Edge) -> Option<Self> {
        let (a, b) = (graph.scan(edge.pair.a)?, graph.scan(edge.pair.b)?);
        let (model_from_a, model_from_b) =
            (*component.poses.get(&edge.pair.a)?, *component.poses.get(&edge.pair.b)?);
        let seen = Self { edge, a, b, model_from_a, model_from_b, counts: None };
        let now = model_from_a.inverse() * model_from_b;
        let counts = if seen.meet(&now) { Some(look_finely(a, b, &now)?) } else { None };
        Some(Self { counts, ..seen })
    }

    /// Whether the scans share anything at a pose.
    fn meet(&self, a_from_b: &Pose) -> bool {
        let stride = self.b.prepared.points.len().div_ceil(QUICK_POINTS).max(1);
        let least = LEAST_OVERLAP * self.b.prepared.points.len().div_ceil(stride) as f64;
        quick_overlap(self.a, self.b, a_from_b, stride) as f64 >= least
    }

    /// What is lost where either scan moves. Scans that do not meet now may meet then: that costs nothing if they fit as pairs usually do.
    fn loss(&self, usual: Option<&Counts>, motion: &Pose, options: &MappingOptions) -> Option<Loss> {
        let (a, b) = (self.a, self.b);
        let voxel = a.prepared.resolution;
        let apart = |x: &Pose, y: &Pose| {
            let (angle, distance) = centred_difference(x, y, &b.centroid);
            (angle < options.rival_angle && distance < options.rival_voxels * voxel).then_some(distance)
        };
        let near = |x: &Pose, y: &Pose| apart(x, y).is_some();
        let now = self.model_from_a.inverse() * self.model_from_b;
        let least = if self.counts.is_some() { -MOST } else { 0.0 };
        let before = self.counts.as_ref().or(usual)?;
        let lost = |moved: &Pose| {
            // What the pair itself found there is nearer to right than what another pair's pose implies.
            let found = self.edge.hypotheses.iter().map(|h| h.hypothesis.a_from_b);
            let own = found
                .filter_map(|pose| Some((apart(&pose, moved)?, pose)))
                .min_by(|x, y| x.0.total_cmp(&y.0))
                .map(|(_, pose)| pose);
            if own.is_none() && !self.meet(moved) {
                return Some(0.0);
            }
            let there = own.unwrap_or_else(|| icp(a, b, moved));
            if near(&now, &there) || !self.meet(&there) {
                return Some(0.0);
            }
            let worth = preference(before, &look_finely(a, b, &there)?, voxel / 2.0);
            Some(worth.clamp(least, MOST))
        };
        let b_moved = self.model_from_a.inverse() * *motion * self.model_from_b;
        let a_moved = (*motion * self.model_from_a).inverse() * self.model_from_b;
        let b_moves = lost(&b_moved)?;
        // Half a turn is its own inverse.
        let a_moves = if near(&b_moved, &a_moved) { b_moves } else { lost(&a_moved)? };
        Some(Loss { b_moves, a_moves })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::test_hall::Model;
    use crate::mapping::testimony::Contradiction;
    use crate::mapping::voice::loudest;

    #[test]
    fn pairs_that_a_hall_misleads_are_not_believed_and_those_that_see_a_turned_scan_move_it() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let hear = |graph: &ScanGraph, component: &Component, said: &[Contradiction]| {
            let words = Word::both_ways(graph, component, said, &options);
            let voice = loudest(&words, options.rival_angle);
            assert!(voice.len() >= said.len());
            Hearing::open(graph, component, control)?.hear(&voice, &BTreeSet::new(), &options, control)
        };
        let misled = [model.contradiction((1, 4), false), model.contradiction((2, 3), false)];
        assert_eq!(hear(&model.graph, &model.component, &misled), Ok(Ruling::Refuted));
        assert_eq!(
            hear(&model.coarse(), &model.component, &misled),
            Ok(Ruling::Believable),
            "nothing tells the ends apart"
        );
        let wrong = model.with_turned(&[5]);
        let witnesses = [model.contradiction((1, 5), true), model.contradiction((2, 5), true)];
        let Ok(Ruling::Moves { scans, .. }) = hear(&model.graph, &wrong, &witnesses) else {
            panic!("the turned scan is where it does not fit");
        };
        // Half a turn of the one is half a turn of the others.
        let turned = scans.contains(&ScanKey(5));
        assert_eq!(scans.len(), if turned { 1 } else { 5 }, "{scans:?}");
        token.cancel();
        assert_eq!(hear(&model.graph, &wrong, &witnesses), Err(Cancelled));
    }
}
