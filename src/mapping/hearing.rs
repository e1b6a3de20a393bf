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
/// The scans stay if the pairs between those that would move and the rest are for it by these log-odds together, …
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
/// A change of what is lost below this is rounding.
const NO_GAIN: f64 = -1e-9;
/// Of how few scans it may be left open whether they belong where they are: that is no question of alike places, but of them …
const FEW_SCANS: usize = 2;
/// … as long as the rest are this many times as many.
const REST: usize = 6;
/// Scans belong where the voice would have them if the same is said for the move, by as much on average: in near-symmetric halls it is 1.2.
/// Identical rooms come near to that, so it must settle the matter (`undo`). …
const BETTER_MEAN: f64 = 1.0;
/// … Where chunks of a warehouse were turned it is 2.0 and more: that is clear, whatever else is said.
const CLEAR_MEAN: f64 = 1.6;
/// Points that are looked at to see whether scans would meet at all where they moved to, …
const QUICK_POINTS: usize = 500;
/// … and the share of them that must.
const LEAST_OVERLAP: f64 = 0.02;
/// Pairs that share more than this show what is usual.
const USUAL_OVERLAP: f64 = 0.1;

/// What comes of a hearing.
#[derive(Debug, Clone, PartialEq)]
pub enum Verdict {
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

/// Whether what these words say, which agree with the first, is believable of some of the component's scans. Pairs are looked at with the
/// finest surfaces there are; where there are none, anything is. What moves scans to where they fit better comes before what leaves all in doubt,
/// and that before what leaves a few. Scans that wait (`waits`) stand in the component for what they say; where only they are in question, nothing
/// else is.
pub fn hear(
    graph: &ScanGraph,
    component: &Component,
    words: &[&Word],
    waits: &BTreeSet<ScanKey>,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Verdict, Cancelled> {
    let Some(first) = words.first() else { return Ok(Verdict::Refuted) };
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index = |scan: ScanKey| keys.binary_search(&scan).ok();
    let edges: Vec<(usize, usize, &Edge)> =
        graph.edges().filter_map(|edge| Some((index(edge.pair.a)?, index(edge.pair.b)?, edge))).collect();
    let seen: Vec<Option<Seen>> = edges
        .par_iter()
        .map(|(_, _, edge)| control.check().map(|()| Seen::now(graph, component, edge)))
        .collect::<Result<_, Cancelled>>()?;
    let usual = usual(&seen);
    let losses: Vec<Loss> = seen
        .par_iter()
        .map(|seen| {
            control.check()?;
            let loss = seen.as_ref().and_then(|seen| seen.loss(usual.as_ref(), &first.motion, options));
            Ok(loss.unwrap_or_default())
        })
        .collect::<Result<_, Cancelled>>()?;
    let n = keys.len();
    // At i * n + j, what is lost where j moves and i stays.
    let mut lost = vec![0.0; n * n];
    for ((i, j, _), loss) in edges.iter().zip(losses) {
        lost[i * n + j] = loss.b_moves;
        lost[j * n + i] = loss.a_moves;
    }
    let mut best: Option<Move> = None;
    let (mut open, mut believable) = (None, false);
    for word in words {
        control.check()?;
        let cut = index(word.stays()).zip(index(word.moves));
        let Some(found) = cut.and_then(|(stays, moves)| Move::cheapest(&lost, n, stays, moves)) else {
            believable = true;
            continue;
        };
        if found.is_refuted() {
            continue;
        }
        let improved = found.descended(&lost);
        if improved.is_better() {
            if best.as_ref().is_none_or(|best| improved.lost < best.lost) {
                best = Some(improved);
            }
        } else if let Some(few) = found.few_in_doubt(|i| waits.contains(&keys[i])) {
            open = open.or(Some(few));
        } else {
            believable = true;
        }
    }
    let scans = |indices: Vec<usize>| indices.into_iter().map(|i| keys[i]).collect();
    Ok(match (best, open) {
        (Some(best), _) => {
            let clearly = best.is_clearly_better();
            Verdict::Moves { scans: scans(best.side(true)), motion: first.motion, clearly }
        }
        (None, Some(few)) if !believable => Verdict::Open(scans(few)),
        (None, None) if !believable => Verdict::Refuted,
        (None, _) => Verdict::Believable,
    })
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
    /// The scans that move along with `moves`, and not with `stays`, as it costs least. At `i * n + j`, what is lost where j moves and i stays.
    /// What pairs gain is left out of the choice, as cuts are exact only then.
    fn cheapest(lost: &[f64], n: usize, stays: usize, moves: usize) -> Option<Self> {
        let mut spare: Vec<f64> = lost.iter().map(|loss| loss.max(0.0)).collect();
        let (staying, _) = least_cut(&mut spare, n, stays, moves)?;
        let word = (stays, moves);
        let mut moves = vec![true; n];
        for i in staying {
            moves[i] = false;
        }
        Some(Self::of(word, moves, lost))
    }

    fn of(word: (usize, usize), moves: Vec<bool>, lost: &[f64]) -> Self {
        let n = moves.len();
        let across = (0..n * n).filter(|at| !moves[at / n] && moves[at % n]).map(|at| lost[at]);
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
    fn descended(&self, lost: &[f64]) -> Self {
        let n = self.moves.len();
        let mut moves = self.moves.clone();
        loop {
            // By how much more is lost when a scan changes sides.
            let change = |k: usize| -> f64 {
                let others = (0..n).filter(|i| *i != k);
                let with = |i: usize| match (moves[i], moves[k]) {
                    (false, false) => lost[i * n + k],
                    (true, false) => -lost[k * n + i],
                    (false, true) => -lost[i * n + k],
                    (true, true) => lost[k * n + i],
                };
                others.map(with).sum()
            };
            let free = (0..n).filter(|k| *k != self.word.0 && *k != self.word.1);
            let best = free.map(|k| (change(k), k)).min_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
            match best {
                // Every change makes it less, so no division comes twice.
                Some((change, k)) if change < NO_GAIN => moves[k] = !moves[k],
                _ => return Self::of(self.word, moves, lost),
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
        self.is_better() && self.lost <= -CLEAR_MEAN * self.pairs as f64
    }

    /// The few scans on one side, if it is more likely than not that they belong where they are, or if they only wait.
    fn few_in_doubt(&self, waits: impl Fn(usize) -> bool) -> Option<Vec<usize>> {
        let moving = self.moves.iter().filter(|moves| **moves).count();
        let staying = self.moves.len() - moving;
        let few = moving.min(staying);
        let only_they = few <= FEW_SCANS && REST * few <= moving.max(staying);
        let side = self.side(moving <= staying);
        ((only_they && self.leans_to_stay()) || side.iter().all(|i| waits(*i))).then_some(side)
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

/// What is usual for pairs that meet: the one of them with the median share in free space.
fn usual(seen: &[Option<Seen<'_>>]) -> Option<Counts> {
    let mut counts: Vec<Counts> = seen.iter().flatten().filter_map(|seen| seen.counts).collect();
    counts.retain(|counts| counts.overlap() > USUAL_OVERLAP);
    counts.sort_by(|x, y| x.violation_share().total_cmp(&y.violation_share()));
    counts.get(counts.len() / 2).copied()
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
            hear(graph, component, &voice, &BTreeSet::new(), &options, control)
        };
        let misled = [model.contradiction((1, 4), false), model.contradiction((2, 3), false)];
        assert_eq!(hear(&model.graph, &model.component, &misled), Ok(Verdict::Refuted));
        assert_eq!(
            hear(&model.coarse(), &model.component, &misled),
            Ok(Verdict::Believable),
            "nothing tells the ends apart"
        );
        let wrong = model.with_turned(&[5]);
        let witnesses = [model.contradiction((1, 5), true), model.contradiction((2, 5), true)];
        let Ok(Verdict::Moves { scans, .. }) = hear(&model.graph, &wrong, &witnesses) else {
            panic!("the turned scan is where it does not fit");
        };
        // Half a turn of the one is half a turn of the others.
        let turned = scans.contains(&ScanKey(5));
        assert_eq!(scans.len(), if turned { 1 } else { 5 }, "{scans:?}");
        token.cancel();
        assert_eq!(hear(&model.graph, &wrong, &witnesses), Err(Cancelled));
    }

    /// What moving scans `from..n` loses with each pair across, the rest being held by 30; `witness` between the first and the last.
    fn cheapest(n: usize, from: usize, across: f64, witness: f64) -> Move {
        let mut lost = vec![0.0; n * n];
        for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|(i, j)| i != j) {
            lost[i * n + j] = if (i < from) == (j < from) { 30.0 } else { across };
        }
        lost[n - 1] = witness;
        Move::cheapest(&lost, n, 0, n - 1).expect("there is a cut")
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
        let turned = cheapest(6, 3, -2.0, -3.0);
        assert!(turned.is_clearly_better() && !turned.is_refuted());
        assert_eq!(turned.side(true), [3, 4, 5]);
        let undecided = cheapest(6, 3, -0.6, -3.0);
        assert!(!undecided.is_better(), "{undecided:?}");
        let somewhat = cheapest(6, 3, -1.2, -3.0);
        assert!(somewhat.is_better() && !somewhat.is_clearly_better(), "{somewhat:?}");
    }

    #[test]
    fn scans_that_gain_by_moving_move_along() {
        // Scans 2 to 4 are turned. Between 1 and 3 nobody noticed, so that a cut that only sees costs leaves 3 and 4 where they are.
        let n = 5;
        let mut lost = vec![0.0; n * n];
        let mut set = |i: usize, j: usize, loss: f64| {
            lost[i * n + j] = loss;
            lost[j * n + i] = loss;
        };
        for (i, j) in [(0, 2), (0, 3), (0, 4), (1, 4)] {
            set(i, j, -2.0);
        }
        for (i, j, loss) in [(0, 1, 3.0), (3, 4, 3.0), (1, 3, 0.5), (2, 3, 0.25)] {
            set(i, j, loss);
        }
        let found = Move::cheapest(&lost, n, 0, 2).expect("there is a cut");
        assert_eq!((found.side(true), found.lost), (vec![2], -1.75));
        let improved = found.descended(&lost);
        assert_eq!((improved.side(true), improved.lost), (vec![2, 3, 4], -7.5));
    }

    #[test]
    fn of_a_few_scans_it_may_be_left_open_where_they_belong() {
        let in_doubt = |found: &Move| found.few_in_doubt(|_| false);
        // Twelve scans and one more.
        let one = cheapest(13, 12, 1.4, -3.0);
        assert!(!one.is_refuted() && !one.is_better());
        assert_eq!(in_doubt(&one), Some(vec![12]));
        assert_eq!(in_doubt(&cheapest(13, 12, 0.3, -3.0)), None, "hardly anybody says that it stays");
        assert_eq!(in_doubt(&cheapest(13, 9, 1.5, -3.0)), None, "four are a place of their own");
        assert_eq!(in_doubt(&cheapest(5, 4, 1.5, -3.0)), None, "of five scans one is many");
        let unsure = cheapest(13, 9, 0.3, -3.0);
        assert_eq!(in_doubt(&unsure), None);
        assert_eq!(unsure.few_in_doubt(|i| i >= 9), Some(vec![9, 10, 11, 12]), "they only wait");
    }
}
