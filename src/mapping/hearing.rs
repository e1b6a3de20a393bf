//! A hearing: whether what several pairs say alike against a component can be true. Then some of its scans would have to move, together,
//! and would fit the rest no worse where they went. Where alike places were folded onto each other they do; where a place looks alike
//! from both ends, such as a hall, all who see more of it than the pairs that were misled say that the scans belong where they are, or, if
//! it is the component that was misled, that they belong where the voice would have them. Used by `testimony`.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::component::Component;
use super::cuts::least_cut;
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
/// The scans stay if the pairs between those that would move and the rest are for that by these log-odds together, …
const DECISIVE: f64 = 4.0;
/// … by as much each on average, as pairs that can tell two places apart are (those of halls by 1.3 and more; where identical rooms were folded
/// onto each other, pairs differ, by 0.7 on average), …
const LEAST_MEAN: f64 = 1.0;
/// … and if none of them is as sure of the move. The pairs that show a fold mostly are by all that one can say; those that a hall misleads
/// waver at a second look.
const SURE: f64 = 2.0;
/// Somebody may be sure of the move where the others outweigh it this much together …
const OVERWHELMING: f64 = 20.0;
/// … and this much on average.
const OVERWHELMING_MEAN: f64 = 1.5;
/// A change of what is lost that is smaller is rounding.
const ROUNDING: f64 = 1e-9;
/// What parting two scans that meet costs where nothing else is said of it.
const TIE: f64 = 1e-3;
/// Of how few scans it may be left open whether they belong where they are: that is no question of alike places, but of them …
const FEW_SCANS: usize = 2;
/// … as long as the rest are this many times as many.
const REST: usize = 6;
/// Scans belong where the voice would have them if the same is said for the move, by as much on average: in near-symmetric halls it is 1.2.
/// Identical rooms come near to that, so it must settle the matter (`undo`). …
const BETTER_MEAN: f64 = 1.0;
/// … Where chunks of a warehouse were turned it is 2.0 and more, and as much together as is overwhelming: that is clear, whatever else is said.
const CLEAR_MEAN: f64 = 1.6;
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
        Ok(Self { keys, pairs, usual })
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
            if found.is_refuted() || self.is_idle(&found, waits) {
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
        let n = self.keys.len();
        let mut losses = Losses { n, lost: vec![0.0; n * n], tie: vec![0.0; n * n] };
        for ((i, j, seen), loss) in self.pairs.iter().zip(found) {
            losses.lost[i * n + j] = loss.b_moves;
            losses.lost[j * n + i] = loss.a_moves;
            let tie = if seen.as_ref().is_some_and(|seen| seen.counts.is_some()) { TIE } else { 0.0 };
            losses.tie[i * n + j] = tie;
            losses.tie[j * n + i] = tie;
        }
        Ok(losses)
    }
}

/// What pairs lose in log-odds where scans move, at `i * n + j` where j moves and i stays.
#[derive(Debug, Clone)]
struct Losses {
    n: usize,
    lost: Vec<f64>,
    /// Next to nothing where scans meet, so that those of which nothing is said stay with those that they meet.
    tie: Vec<f64>,
}

impl Losses {
    fn at(&self, stays: usize, moves: usize) -> f64 {
        let at = stays * self.n + moves;
        self.lost[at] + self.tie[at]
    }

    /// By how much more is lost when a scan changes sides.
    fn change(&self, moves: &[bool], k: usize) -> f64 {
        let others = (0..self.n).filter(|i| *i != k);
        let with = |i: usize| match (moves[i], moves[k]) {
            (false, false) => self.at(i, k),
            (true, false) => -self.at(k, i),
            (false, true) => -self.at(i, k),
            (true, true) => self.at(k, i),
        };
        others.map(with).sum()
    }
}

/// Scans that move, and what the pairs between them and the rest say of it.
#[derive(Debug, Clone, PartialEq)]
struct Move {
    /// The scan that the word leaves where it is, and the one that it moves.
    word: (usize, usize),
    /// By scan, whether it moves.
    moves: Vec<bool>,
    /// Pairs that can tell.
    pairs: usize,
    /// Log-odds that they lose together.
    lost: f64,
    /// The most that one of them gains.
    gained: f64,
}

impl Move {
    /// The scans that move along with `moves`, and not with `stays`, as it costs least. What pairs gain is left out of the choice, as cuts are
    /// exact only then.
    fn cheapest(losses: &Losses, stays: usize, moves: usize) -> Option<Self> {
        let n = losses.n;
        let mut spare: Vec<f64> =
            losses.lost.iter().zip(&losses.tie).map(|(loss, tie)| loss.max(0.0) + tie).collect();
        let (staying, _) = least_cut(&mut spare, n, stays, moves)?;
        let word = (stays, moves);
        let mut moves = vec![true; n];
        for i in staying {
            moves[i] = false;
        }
        Some(Self::of(word, moves, losses))
    }

    fn of(word: (usize, usize), moves: Vec<bool>, losses: &Losses) -> Self {
        let n = moves.len();
        let across = (0..n * n).filter(|at| !moves[at / n] && moves[at % n]).map(|at| losses.lost[at]);
        let said: Vec<f64> = across.filter(|loss| *loss != 0.0).collect();
        Self {
            word,
            moves,
            pairs: said.len(),
            lost: said.iter().sum(),
            gained: -said.iter().copied().fold(0.0, f64::min),
        }
    }

    /// The move that is reached from this one by changing the side of one scan at a time, as long as less is lost. Beside what it costs, what pairs
    /// gain decides here which scans belong together.
    fn descended(&self, losses: &Losses) -> Self {
        let mut moves = self.moves.clone();
        loop {
            let free = (0..moves.len()).filter(|k| *k != self.word.0 && *k != self.word.1);
            let best = free
                .map(|k| (losses.change(&moves, k), k))
                .min_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
            match best {
                // Every change makes it less, so no division comes twice.
                Some((change, k)) if change < -ROUNDING => moves[k] = !moves[k],
                _ => return Self::of(self.word, moves, losses),
            }
        }
    }

    /// Whether the scans stay.
    fn is_refuted(&self) -> bool {
        let overwhelming = self.lost >= OVERWHELMING && self.lost >= OVERWHELMING_MEAN * self.pairs as f64;
        self.lost >= DECISIVE && self.leans_to_stay() && (self.gained < SURE || overwhelming)
    }

    fn leans_to_stay(&self) -> bool {
        self.pairs > 0 && self.lost >= LEAST_MEAN * self.pairs as f64
    }

    /// Whether the scans fit better where they would go.
    fn is_better(&self) -> bool {
        self.lost <= -DECISIVE && self.lost <= -BETTER_MEAN * self.pairs as f64
    }

    fn is_clearly_better(&self) -> bool {
        self.lost <= -OVERWHELMING && self.lost <= -CLEAR_MEAN * self.pairs as f64
    }

    /// The few scans on one side, if it is more likely than not that they belong where they are.
    fn few_in_doubt(&self) -> Option<Vec<usize>> {
        let moving = self.moves.iter().filter(|moves| **moves).count();
        let staying = self.moves.len() - moving;
        let few = moving.min(staying);
        let only_they = few <= FEW_SCANS && REST * few <= moving.max(staying);
        (only_they && self.leans_to_stay()).then(|| self.side(moving <= staying))
    }

    fn side(&self, moving: bool) -> Vec<usize> {
        (0..self.moves.len()).filter(|i| self.moves[*i] == moving).collect()
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

    fn losses(n: usize, lost: impl Fn(usize, usize) -> f64) -> Losses {
        let pairs = (0..n * n).map(|at| (at / n, at % n));
        let lost = pairs.map(|(i, j)| if i == j { 0.0 } else { lost(i, j) }).collect();
        Losses { n, lost, tie: vec![0.0; n * n] }
    }

    /// What moving scans `from..n` loses with each pair across, the rest being held by 30; `witness` between the first and the last.
    fn cheapest(n: usize, from: usize, across: f64, witness: f64) -> Move {
        let losses = losses(n, |i, j| match (i, j) {
            (0, j) if j == n - 1 => witness,
            _ if (i < from) == (j < from) => 30.0,
            _ => across,
        });
        Move::cheapest(&losses, 0, n - 1).expect("there is a cut")
    }

    #[test]
    fn a_change_of_sides_changes_what_is_lost_by_as_much_as_it_says() {
        // Different both ways, and of either sign.
        let losses = losses(5, |i, j| ((7 * i + 3 * j) % 11) as f64 - 4.5);
        for sides in 0..32_usize {
            let moves: Vec<bool> = (0..5).map(|i| sides >> i & 1 == 1).collect();
            let lost = |moves: &[bool]| Move::of((0, 1), moves.to_vec(), &losses).lost;
            for k in 0..5 {
                let mut changed = moves.clone();
                changed[k] = !changed[k];
                assert_eq!(lost(&changed) - lost(&moves), losses.change(&moves, k));
            }
        }
    }

    #[test]
    fn scans_of_which_nothing_is_said_stay_with_those_that_they_meet() {
        // A chain of four; only the ends have something to say.
        let mut losses = losses(4, |i, j| if (i, j) == (0, 3) || (i, j) == (3, 0) { 2.0 } else { 0.0 });
        for (i, j) in [(0, 1), (1, 0), (1, 2), (2, 1)] {
            losses.tie[i * 4 + j] = TIE;
        }
        let found = Move::cheapest(&losses, 0, 3).expect("there is a cut");
        assert_eq!((found.side(true), found.lost, found.pairs), (vec![3], 2.0, 1));
    }

    #[test]
    fn what_moves_together_is_weighed_together_and_one_sure_pair_is_enough() {
        // Scans 0 to 2 are one room, 3 to 5 another that was folded onto it.
        let room = |across, witness| cheapest(6, 3, across, witness);
        assert!(!room(0.0, -0.5).is_refuted(), "the rooms have nothing to say to each other");
        assert!(room(2.0, 0.5).is_refuted(), "all but the witness know better");
        assert!(!room(2.0, -2.5).is_refuted(), "the witness is sure");
        assert!(room(3.0, -2.5).is_refuted(), "all others are surer");
        assert!(!room(0.6, 0.6).is_refuted(), "nobody is");
        for (across, witness) in [(0.0, -0.5), (2.0, 0.5), (2.0, -2.5), (0.6, 0.6)] {
            assert!(!room(across, witness).is_better());
        }
    }

    #[test]
    fn scans_move_where_most_pairs_fit_better() {
        let turned = cheapest(8, 4, -2.0, -3.0);
        assert!(turned.is_clearly_better() && !turned.is_refuted());
        assert_eq!(turned.side(true), [4, 5, 6, 7]);
        assert!(!cheapest(4, 2, -2.0, -3.0).is_clearly_better(), "four pairs are few");
        let undecided = cheapest(6, 3, -0.6, -3.0);
        assert!(!undecided.is_better(), "{undecided:?}");
        let somewhat = cheapest(6, 3, -1.2, -3.0);
        assert!(somewhat.is_better() && !somewhat.is_clearly_better(), "{somewhat:?}");
    }

    #[test]
    fn scans_that_gain_by_moving_move_along() {
        // Scans 2 to 4 are turned. Between 1 and 3 nobody noticed, so that a cut that only sees costs leaves 3 and 4 where they are.
        let losses = losses(5, |i, j| match (i.min(j), i.max(j)) {
            (0, 2..=4) | (1, 4) => -2.0,
            (0, 1) | (3, 4) => 3.0,
            (1, 3) => 0.5,
            (2, 3) => 0.25,
            _ => 0.0,
        });
        let found = Move::cheapest(&losses, 0, 2).expect("there is a cut");
        assert_eq!((found.side(true), found.lost), (vec![2], -1.75));
        let improved = found.descended(&losses);
        assert_eq!((improved.side(true), improved.lost), (vec![2, 3, 4], -7.5));
    }

    #[test]
    fn of_a_few_scans_it_may_be_left_open_where_they_belong() {
        // Twelve scans and one more.
        let one = cheapest(13, 12, 1.4, -3.0);
        assert!(!one.is_refuted() && !one.is_better());
        assert_eq!(one.few_in_doubt(), Some(vec![12]));
        assert_eq!(cheapest(13, 12, 0.3, -3.0).few_in_doubt(), None, "hardly anybody says that it stays");
        assert_eq!(cheapest(13, 9, 1.5, -3.0).few_in_doubt(), None, "four are a place of their own");
        assert_eq!(cheapest(5, 4, 1.5, -3.0).few_in_doubt(), None, "of five scans one is many");
    }
}
