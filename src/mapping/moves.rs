//! Scans of a component that would move together, and what the pairs between them and the rest say of it: whether they stay, fit better where
//! they would go, or are so few that it is no question of the component. Used by `hearing`.

use super::cuts::least_cut;

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
/// Where no pair denies the component, this on average is enough, however sure somebody is of the move. In most rows of identical rooms that were
/// folded some pair denies it; in those where none does it is 0.4 at most.
const UNDENIED_MEAN: f64 = 0.7;
/// A change of what is lost that is smaller is rounding.
const ROUNDING: f64 = 1e-9;
/// What parting two scans that meet costs where nothing else is said of it.
const TIE: f64 = 1e-3;
/// Of how few scans it may be left open whether they belong where they are: that is no question of alike places, but of them …
const FEW_SCANS: usize = 2;
/// … as long as the rest are this many times as many.
const REST: usize = 6;
/// Scans belong where the voice would have them if the same is said for the move, by as much on average: in near-symmetric halls it is 1.2.
/// Identical rooms come near to that, so it must settle the matter (`finding`). …
const BETTER_MEAN: f64 = 1.0;
/// … Where chunks of a warehouse were turned it is 2.0 and more, and as much together as is overwhelming: that is clear, whatever else is said.
const CLEAR_MEAN: f64 = 1.6;
/// … It is clear with less on average, too, …
const WHOLE_MEAN: f64 = 0.85;
/// … where as much as this of the pairs between the sides can tell: all still meet, so that the move maps the place onto itself, as half a turn does a
/// hall. Of identical rooms, most see nothing of each other after a move, and no such move gains 13.
const WHOLE_SHARE: f64 = 0.85;

/// What pairs lose in log-odds where scans move, at `i * n + j` where j moves and i stays.
#[derive(Debug, Clone)]
pub struct Losses {
    n: usize,
    lost: Vec<f64>,
    /// Next to nothing where scans meet, so that those of which nothing is said stay with those that they meet.
    tie: Vec<f64>,
}

impl Losses {
    /// Of n scans of which nothing is said.
    #[must_use]
    pub fn none(n: usize) -> Self {
        Self { n, lost: vec![0.0; n * n], tie: vec![0.0; n * n] }
    }

    /// What is lost where one scan moves and the other stays.
    pub fn set(&mut self, stays: usize, moves: usize, lost: f64) {
        self.lost[stays * self.n + moves] = lost;
    }

    /// Notes that two scans meet.
    pub fn tie(&mut self, i: usize, j: usize) {
        self.tie[i * self.n + j] = TIE;
        self.tie[j * self.n + i] = TIE;
    }

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
pub struct Move {
    /// The scan that the word leaves where it is, and the one that it moves.
    word: (usize, usize),
    /// By scan, whether it moves.
    moves: Vec<bool>,
    /// Pairs that can tell.
    pairs: usize,
    /// Log-odds that they lose together.
    pub lost: f64,
    /// The most that one of them gains.
    gained: f64,
}

impl Move {
    /// The scans that move along with `moves`, and not with `stays`, as it costs least. What pairs gain is left out of the choice, as cuts are
    /// exact only then.
    #[must_use]
    pub fn cheapest(losses: &Losses, stays: usize, moves: usize) -> Option<Self> {
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
    #[must_use]
    pub fn descended(&self, losses: &Losses) -> Self {
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

    /// Whether the scans stay. Less is asked where no pair denies what the component makes of its scans (`undenied`).
    #[must_use]
    pub fn is_refuted(&self, undenied: bool) -> bool {
        let overwhelming = self.lost >= OVERWHELMING && self.lost >= OVERWHELMING_MEAN * self.pairs as f64;
        let stays = if undenied {
            self.lost >= UNDENIED_MEAN * self.pairs as f64
        } else {
            self.leans_to_stay() && (self.gained < SURE || overwhelming)
        };
        self.lost >= DECISIVE && stays
    }

    fn leans_to_stay(&self) -> bool {
        self.pairs > 0 && self.lost >= LEAST_MEAN * self.pairs as f64
    }

    /// Whether the scans fit better where they would go.
    #[must_use]
    pub fn is_better(&self) -> bool {
        self.is_clearly_better() || (self.lost <= -DECISIVE && self.lost <= -BETTER_MEAN * self.pairs as f64)
    }

    /// Whether they do by more than alike places ever show.
    #[must_use]
    pub fn is_clearly_better(&self) -> bool {
        let least = if self.maps_the_place_onto_itself() { WHOLE_MEAN } else { CLEAR_MEAN };
        self.lost <= -OVERWHELMING && self.lost <= -least * self.pairs as f64
    }

    /// Whether both sides are more than a few scans, and nearly all pairs between them can tell: they meet at both places, or would.
    fn maps_the_place_onto_itself(&self) -> bool {
        let [moving, staying] = [true, false].map(|moving| self.side(moving).len());
        moving.min(staying) > FEW_SCANS && self.pairs as f64 >= WHOLE_SHARE * (moving * staying) as f64
    }

    /// The few scans on one side, if it is more likely than not that they belong where they are.
    #[must_use]
    pub fn few_in_doubt(&self) -> Option<Vec<usize>> {
        let moving = self.moves.iter().filter(|moves| **moves).count();
        let staying = self.moves.len() - moving;
        let few = moving.min(staying);
        let only_they = few <= FEW_SCANS && REST * few <= moving.max(staying);
        (only_they && self.leans_to_stay()).then(|| self.side(moving <= staying))
    }

    /// The scans on one side, ascending.
    #[must_use]
    pub fn side(&self, moving: bool) -> Vec<usize> {
        (0..self.moves.len()).filter(|i| self.moves[*i] == moving).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn losses(n: usize, lost: impl Fn(usize, usize) -> f64) -> Losses {
        let mut losses = Losses::none(n);
        for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|(i, j)| i != j) {
            losses.set(i, j, lost(i, j));
        }
        losses
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
        losses.tie(0, 1);
        losses.tie(1, 2);
        let found = Move::cheapest(&losses, 0, 3).expect("there is a cut");
        assert_eq!((found.side(true), found.lost, found.pairs), (vec![3], 2.0, 1));
    }

    #[test]
    fn what_moves_together_is_weighed_together_and_one_sure_pair_is_enough() {
        // Scans 0 to 2 are one room, 3 to 5 another that was folded onto it.
        let room = |across, witness| cheapest(6, 3, across, witness);
        assert!(!room(0.0, -0.5).is_refuted(true), "the rooms have nothing to say to each other");
        assert!(room(2.0, 0.5).is_refuted(false), "all but the witness know better");
        assert!(!room(2.0, -2.5).is_refuted(false), "the witness is sure");
        assert!(room(3.0, -2.5).is_refuted(false), "all others are surer");
        assert!(!room(0.6, 0.6).is_refuted(true), "nobody is");
        for (across, witness) in [(0.0, -0.5), (2.0, 0.5), (2.0, -2.5), (0.6, 0.6)] {
            assert!(!room(across, witness).is_better());
        }
    }

    #[test]
    fn scans_move_where_most_pairs_fit_better() {
        let turned = cheapest(8, 4, -2.0, -3.0);
        assert!(turned.is_clearly_better() && !turned.is_refuted(true));
        assert_eq!(turned.side(true), [4, 5, 6, 7]);
        assert!(!cheapest(4, 2, -2.0, -3.0).is_clearly_better(), "four pairs are few");
        let undecided = cheapest(6, 3, -0.6, -3.0);
        assert!(!undecided.is_better(), "{undecided:?}");
        let somewhat = cheapest(6, 3, -1.2, -3.0);
        assert!(somewhat.is_better() && !somewhat.is_clearly_better(), "{somewhat:?}");
    }

    #[test]
    fn a_move_that_maps_the_place_onto_itself_is_clear_with_less() {
        let turned = cheapest(12, 6, -0.9, -1.5);
        assert!(turned.is_clearly_better() && turned.is_better(), "{turned:?}");
        // Of scans that went to another room, many see nothing of the others any more.
        let elsewhere = losses(12, |i, j| match (i < 6, j < 6) {
            _ if (i, j) == (0, 11) => -1.5,
            (x, y) if x == y => 30.0,
            _ if (i + j) % 3 == 0 => 0.0,
            _ => -0.9,
        });
        let found = Move::cheapest(&elsewhere, 0, 11).expect("there is a cut");
        assert!(found.lost < -20.0 && !found.is_better(), "{found:?}");
    }

    #[test]
    fn where_nobody_denies_less_refutes() {
        // One of twelve scans: most say that it stays, one is sure that it does not.
        let one = cheapest(12, 11, 1.2, -2.5);
        assert!(one.is_refuted(true) && !one.is_refuted(false), "{one:?}");
        assert!(!cheapest(12, 11, 0.6, -2.5).is_refuted(true), "hardly anybody says so");
        assert!(!cheapest(5, 4, 2.0, -2.5).is_refuted(true), "few say so");
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
        assert!(!one.is_refuted(false) && !one.is_better());
        assert_eq!(one.few_in_doubt(), Some(vec![12]));
        assert_eq!(cheapest(13, 12, 0.3, -3.0).few_in_doubt(), None, "hardly anybody says that it stays");
        assert_eq!(cheapest(13, 9, 1.5, -3.0).few_in_doubt(), None, "four are a place of their own");
        assert_eq!(cheapest(5, 4, 1.5, -3.0).few_in_doubt(), None, "of five scans one is many");
    }
}
