//! A close look at a join that few pairs speak for. So little says where it belongs that it must show nothing odd at half the voxel
//! either: a wrong pose that looks clear of free space mostly stands in it there, or in that of scans that do not speak for it. And some pair
//! must show more than the corner of a room, clearly more where one alone speaks for it and is not sure. Joins of bent pieces are not asked, as many pairs speak for
//! them. Used by `join`.

use super::belief::LEAST_OF_ONE;
use super::candidates::{Backing, Candidate, LEAST_WORD, Proposal};
use super::component::Component;
use super::consistency::agreeing;
use super::join::Refusal;
use super::options::MappingOptions;
use super::surfaces::judge_finely;
use crate::features::Scan;
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph};
use crate::pairwise::{Counts, Evidence, PairKey, coinciding, look_finely, look_leniently};

/// So many pairs are few: what rests on them is looked at closely, and not straightened until it fits.
pub const FEW: usize = 2;
/// Of the judged points of few pairs this share may lie in free space (in simulated houses, right pairs put 0.1 % there and 99 of 100 at most 1.3 %,
/// wrong ones that nothing else gave away 1.3 to 2.4 %), …
const MOST_VIOLATION: f64 = 0.01;
/// … or this many times what the firmest pairs show, where the data are that noisy.
const CONTRAST: f64 = 4.0;
/// A lone scan that this many pairs or fewer have a voice for must not stand in the free space of scans that do not speak for it …
const MOST_VOICES: usize = 3;
/// … by more than this share of the points judged there. In simulated houses 98 of 100 right joins show less, most of them nothing.
const MOST_TRESPASS: f64 = 0.05;
/// Of the silent pairs so many are asked, those that overlap most, …
const SILENT: usize = 12;
/// … and nothing is said where they judge, all together and both ways, fewer points than this share of as many as the lone scan has.
const LEAST_SEEN: f64 = 0.06;
/// How many of the firmest pairs are asked …
const FIRMEST: usize = 12;
/// … and how many there must be for them to say what is usual.
const LEAST_FIRM: usize = 4;
/// Where fewer points can be judged, nothing can be said.
const LEAST_JUDGED: u32 = 100;
/// Of the points that the scans of a pair share, this share must lie beyond the three largest planes, of one pair at least: right pairs of walls in
/// a real room have 2.1 %. Of the right joins in simulated houses one of 519 that rest on one pair has less, and none of 673 that rest on several; wrong ones
/// along a bare wall have, that nothing else gave away, …
const LEAST_BEYOND_PLANES: f64 = 0.01;
/// … and this share where one pair alone has a voice and the support is not firm: of 135 such joins that are right, six have less.
const LEAST_BEYOND_PLANES_WEAK: f64 = 0.055;
/// Two lone scans whose pair is not firm must share this much. Of 24 such pairs that are right, two share less.
const LEAST_SHARED: f64 = 0.2;
/// Of one of the scans of the one pair that has a voice this much must coincide, or it is held as by a hinge: of 177 scans of simulated houses that one pair
/// placed, one with 6.6 % was turned by 9 degrees on the way; no other had less than 8. …
const LEAST_HOLD: f64 = 0.08;
/// … And this much where it is less sure than one pair must be whose support is not firm, whatever third scans say: of 51 such joins, two were wrong, with 15 and 16 %, and three
/// of the others have less.
const LEAST_HOLD_UNSURE: f64 = 0.18;

/// A pair that says something for a join.
struct Word<'g> {
    proposal: &'g Proposal,
    /// Its scan in a.
    x: &'g Scan,
    /// Its scan in b.
    y: &'g Scan,
    /// Where the join would have them, local frames.
    x_from_y: Pose,
}

impl Word<'_> {
    fn pair(&self) -> PairKey {
        PairKey::of(self.proposal.in_a, self.proposal.in_b)
    }
}

/// What is wrong with a join of b to a at this pose, which has this backing there, if anything is.
#[must_use]
pub fn objection(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidate: &Candidate,
    backing: Backing,
    a_from_b: &Pose,
    options: &MappingOptions,
) -> Option<Refusal> {
    if candidate.decided {
        return None;
    }
    graph.forget_fine_of_many();
    let speaking = candidate.members.iter().filter(|member| member.evidence > LEAST_WORD);
    let words = speaking.filter_map(|proposal| {
        let Proposal { in_a, in_b, .. } = proposal;
        let (a_from_x, b_from_y) = (a.poses.get(in_a)?, b.poses.get(in_b)?);
        let x_from_y = a_from_x.inverse() * *a_from_b * *b_from_y;
        Some(Word { proposal, x: graph.scan(*in_a)?, y: graph.scan(*in_b)?, x_from_y })
    });
    let words: Vec<Word<'_>> = words.collect();
    let violation = if backing.edges > FEW { None } else { violation(graph, &words) };
    let support = candidate.support.min(backing.support);
    let weak = support < options.firm_support;
    let lone = weak && a.len() == 1 && b.len() == 1;
    let slight = || if lone { slightness(graph, &words, support, options) } else { None };
    violation
        .or_else(|| indistinctness(&words, weak))
        .or_else(slight)
        .or_else(|| looseness(graph, &words, support, options))
        .or_else(|| trespass(graph, (a, b), &words, a_from_b))
}

/// Whether they put surfaces into free space.
fn violation(graph: &ScanGraph, words: &[Word<'_>]) -> Option<Refusal> {
    let looks = words.iter().filter_map(|word| look_leniently(word.x, word.y, &word.x_from_y));
    let seen = looks.fold(Counts::default(), |sum, counts| sum.plus(&counts));
    let found = seen.violation_share();
    if seen.inliers + seen.violations < LEAST_JUDGED || found <= MOST_VIOLATION {
        return None;
    }
    let pairs: Vec<PairKey> = words.iter().map(Word::pair).collect();
    let allowed = MOST_VIOLATION.max(CONTRAST * usual(graph, &pairs).unwrap_or(0.0));
    (found > allowed).then_some(Refusal::Violation { found, allowed })
}

/// Whether the scans of all that have a voice of their own share little more than three planes; where one alone has, and support is weak, it must
/// show more. Where none has, third scans speak, and the levels ask for them.
fn indistinctness(words: &[Word<'_>], weak: bool) -> Option<Refusal> {
    let own: Vec<&Word<'_>> = words.iter().filter(|word| word.proposal.has_own_voice()).collect();
    let needed = if weak && own.len() == 1 { LEAST_BEYOND_PLANES_WEAK } else { LEAST_BEYOND_PLANES };
    let mut most: Option<f64> = None;
    for word in own {
        let there = coinciding(word.x, word.y, &word.x_from_y);
        let back = coinciding(word.y, word.x, &word.x_from_y.inverse());
        let shared = there.plus(&back);
        let found = shared.share();
        if shared.points < LEAST_JUDGED {
            continue;
        }
        if found >= needed {
            return None;
        }
        most = Some(most.map_or(found, |known| known.max(found)));
    }
    most.map(|found| Refusal::Indistinct { found, needed })
}

/// Whether two lone scans share little: what such a pair is sure of may be chance, and nobody else is there to be asked.
fn slightness(
    graph: &ScanGraph,
    words: &[Word<'_>],
    support: f64,
    options: &MappingOptions,
) -> Option<Refusal> {
    let evidence = said_here(graph, words.first()?, options)?;
    (evidence.both().overlap() < LEAST_SHARED)
        .then_some(Refusal::Support { found: support, needed: options.firm_support })
}

/// Whether of both scans of the one pair that has a voice of its own so little coincides that it does not hold the pose. More pairs do.
fn looseness(
    graph: &ScanGraph,
    words: &[Word<'_>],
    support: f64,
    options: &MappingOptions,
) -> Option<Refusal> {
    let mut own = words.iter().filter(|word| word.proposal.has_own_voice());
    let (word, None) = (own.next()?, own.next()) else { return None };
    let Evidence { b_on_a, a_on_b, .. } = said_here(graph, word, options)?;
    let needed = if word.proposal.alone < LEAST_OF_ONE { LEAST_HOLD_UNSURE } else { LEAST_HOLD };
    (b_on_a.plus(a_on_b).points >= LEAST_JUDGED && b_on_a.overlap().max(a_on_b.overlap()) < needed)
        .then_some(Refusal::Support { found: support, needed: options.most_support() })
}

/// What a pair found at the best of its poses which is where the join would have them.
fn said_here<'g>(graph: &'g ScanGraph, word: &Word<'_>, options: &MappingOptions) -> Option<&'g Evidence> {
    let pair = word.pair();
    let now = if pair.a == word.proposal.in_a { word.x_from_y } else { word.x_from_y.inverse() };
    let said = agreeing(graph, graph.edge(pair.a, pair.b)?, &now, options)?;
    Some(&said.hypothesis.evidence)
}

/// Whether a lone scan that few pairs have a voice for stands in the free space of scans that it touches and that do not speak for it, or they in
/// its.
fn trespass(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    words: &[Word<'_>],
    a_from_b: &Pose,
) -> Option<Refusal> {
    let voices = words.iter().filter(|word| word.proposal.has_own_voice()).count();
    let (lone, rest) = if a.len() < b.len() { (a, b) } else { (b, a) };
    if voices > MOST_VOICES || lone.len() > 1 || rest.len() == 1 {
        return None;
    }
    let own: Vec<PairKey> = words.iter().map(Word::pair).collect();
    let points = graph.scan(lone.gauge)?.prepared.fine.as_ref()?.count();
    let seen = judge_finely(graph, (a, b), a_from_b, &own, SILENT);
    let (found, judged) = (seen.violation_share(), seen.inliers + seen.violations);
    (judged >= LEAST_JUDGED && f64::from(judged) >= LEAST_SEEN * points as f64 && found > MOST_TRESPASS)
        .then_some(Refusal::Violation { found, allowed: MOST_TRESPASS })
}

/// The share of violations of the firmest pairs of all scans but these: their median. `None` where there are too few.
fn usual(graph: &ScanGraph, but: &[PairKey]) -> Option<f64> {
    let others = graph.edges().filter(|edge| !but.contains(&edge.pair) && edge.best_score() > 0.0);
    let mut firm: Vec<&Edge> = others.collect();
    firm.sort_by(|x, y| y.best_score().total_cmp(&x.best_score()).then(x.pair.cmp(&y.pair)));
    let look = |edge: &&Edge| {
        let (a, b) = (graph.scan(edge.pair.a)?, graph.scan(edge.pair.b)?);
        Some(look_finely(a, b, &edge.hypotheses.first()?.hypothesis.a_from_b)?.violation_share())
    };
    let mut shares: Vec<f64> = firm.iter().take(FIRMEST).filter_map(look).collect();
    shares.sort_by(f64::total_cmp);
    (shares.len() >= LEAST_FIRM).then(|| shares[shares.len() / 2])
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::Vector3;

    use super::*;
    use crate::cloud::ScanKey;
    use crate::graph::SupportOptions;
    use crate::mapping::test_hall::Model;
    use crate::pairwise::test_survey::corner;
    use crate::pairwise::{Hypothesis, PairResult};

    /// Edge of a box that is enough for what a pair is sure of, metres.
    const SMALL_BOX: f32 = 0.5;

    /// What says in a cluster where scan 2 lies in the frame of another.
    fn proposal(in_a: u128, a_from_b: Pose, alone: f64) -> Proposal {
        Proposal {
            a_from_b,
            in_a: ScanKey(in_a),
            in_b: ScanKey(2),
            in_a_from_in_b: a_from_b,
            evidence: 4.0,
            doubt: 4.0,
            alone,
            centroid: Vector3::zeros(),
        }
    }

    fn cluster(members: Vec<Proposal>) -> Candidate {
        let a_from_b = members[0].a_from_b;
        Candidate { a_from_b, support: 4.0, doubt: 4.0, rival: 0.0, members, decided: false }
    }

    #[test]
    fn a_join_of_one_pair_that_puts_surfaces_into_free_space_is_objected_to() {
        let model = Model::new(2);
        let (a, b) = (Component::single(ScanKey(1)), Component::single(ScanKey(2)));
        let truth = model.contradiction((1, 2), true).a_from_b;
        // An empty hall is little but planes, which is objected to as well.
        let object = |graph: &ScanGraph, a_from_b: Pose, edges: usize, decided: bool| {
            let candidate = Candidate { decided, ..cluster(vec![proposal(1, a_from_b, 4.0)]) };
            let backing = Backing { support: 4.0, edges };
            objection(graph, (&a, &b), &candidate, backing, &a_from_b, &MappingOptions::default())
                .filter(|refusal| !matches!(refusal, Refusal::Indistinct { .. }))
        };
        assert_eq!(object(&model.graph, truth, 1, false), None);
        let off = truth * Pose::from_translation(Vector3::new(2.0, 1.5, 0.0));
        let refusal = object(&model.graph, off, 1, false);
        assert!(
            matches!(refusal, Some(Refusal::Violation { found, allowed }) if found > allowed && allowed >= MOST_VIOLATION),
            "{refusal:?}"
        );
        // Three pairs are not few, a client knows better, and without finer surfaces there is no closer look.
        assert_eq!(object(&model.graph, off, 3, false), None);
        assert_eq!(object(&model.graph, off, 1, true), None);
        assert_eq!(object(&model.coarse(), off, 1, false), None);
    }

    /// Scans 1 to 3 of the corner of a room, in which these see a box of so long an edge.
    fn corners(boxes: [Option<f32>; 3]) -> ScanGraph {
        let mut graph = ScanGraph::new();
        for (key, edge) in (1..).zip(boxes) {
            graph.add_scan(Arc::new(corner(ScanKey(key), edge)));
        }
        graph
    }

    /// What is wrong with joining scan 2 to scans 1 and 3, of which the first few have these log-odds for it.
    fn cornered(graph: &ScanGraph, voices: &[f64], support: f64) -> Option<Refusal> {
        let mut a = Component::single(ScanKey(1));
        a.poses.insert(ScanKey(3), Pose::identity());
        let members = voices.iter().zip([1, 3]).map(|(alone, in_a)| proposal(in_a, Pose::identity(), *alone));
        let candidate = Candidate { support, ..cluster(members.collect()) };
        let (b, still) = (Component::single(ScanKey(2)), Pose::identity());
        let backing = Backing { support, edges: voices.len() };
        objection(graph, (&a, &b), &candidate, backing, &still, &MappingOptions::default())
    }

    #[test]
    fn a_join_of_pairs_that_share_but_the_corner_of_a_room_is_objected_to() {
        let bare = corners([None; 3]);
        let refusal = cornered(&bare, &[4.0], 4.0);
        assert!(
            matches!(refusal, Some(Refusal::Indistinct { found, needed }) if found < needed),
            "{refusal:?}"
        );
        assert_eq!(cornered(&corners([Some(1.5); 3]), &[4.0], 4.0), None, "a box stands in the corner");
        assert_eq!(cornered(&bare, &[4.0, -2.0], 4.0), refusal, "the other repeats what the first says");
        assert_eq!(cornered(&bare, &[4.0, 3.0], 7.0), refusal, "both look at the same corner");
        let one_more = corners([None, Some(1.5), Some(1.5)]);
        assert_eq!(cornered(&one_more, &[4.0, 3.0], 7.0), None, "the second sees the box");
    }

    #[test]
    fn what_one_pair_says_weakly_must_show_more_than_what_it_is_sure_of() {
        let small = corners([Some(SMALL_BOX); 3]);
        assert_eq!(cornered(&small, &[4.0], 4.0), None);
        let refusal = cornered(&small, &[4.0], 3.0);
        assert!(
            matches!(refusal, Some(Refusal::Indistinct { found, needed }) if found > LEAST_BEYOND_PLANES && needed == LEAST_BEYOND_PLANES_WEAK),
            "{refusal:?}"
        );
        assert_eq!(cornered(&small, &[3.0, 2.0], 3.0), None, "two say so");
    }

    /// What is wrong with joining scan 2 to scan 1 and others, where so many of 1000 points of either coincide, and the first few have these log-odds for it.
    fn sharing(inliers: [u32; 2], support: f64, others: &[u128], voices: &[f64]) -> Option<Refusal> {
        let mut graph = corners([Some(1.5); 3]);
        let [b_on_a, a_on_b] = inliers.map(|inliers| Counts { points: 1000, inliers, ..Counts::default() });
        let evidence = Evidence { b_on_a, a_on_b, ..Evidence::default() };
        let result = PairResult {
            pair: PairKey::of(ScanKey(1), ScanKey(2)),
            matches: Vec::new(),
            hypotheses: vec![Hypothesis { a_from_b: Pose::identity(), evidence, logit: 4.0 }],
        };
        graph.add_results([result], &SupportOptions::default());
        let mut a = Component::single(ScanKey(1));
        a.poses.extend(others.iter().map(|other| (ScanKey(*other), Pose::identity())));
        let members = voices.iter().zip([1, 3]).map(|(alone, in_a)| proposal(in_a, Pose::identity(), *alone));
        let candidate = Candidate { support, ..cluster(members.collect()) };
        let (b, still) = (Component::single(ScanKey(2)), Pose::identity());
        let backing = Backing { support: 3.5, edges: 1 };
        objection(&graph, (&a, &b), &candidate, backing, &still, &MappingOptions::default())
    }

    #[test]
    fn two_lone_scans_that_share_little_start_nothing_unless_they_are_firm() {
        let object = |inliers, support, others: &[u128]| sharing([inliers; 2], support, others, &[5.0]);
        assert_eq!(object(100, 3.0, &[]), Some(Refusal::Support { found: 3.0, needed: 4.0 }));
        assert_eq!(
            object(100, 4.5, &[]),
            Some(Refusal::Support { found: 3.5, needed: 4.0 }),
            "alignment left that"
        );
        assert_eq!(object(300, 3.0, &[]), None, "they share much");
        assert_eq!(object(100, 3.0, &[3]), None, "there is somebody to be asked");
    }

    #[test]
    fn one_pair_that_shares_next_to_nothing_holds_no_scan() {
        let loose = Some(Refusal::Support { found: 3.5, needed: 8.0 });
        assert_eq!(sharing([70; 2], 4.0, &[3], &[5.0]), loose);
        assert_eq!(sharing([90; 2], 4.0, &[3], &[5.0]), None);
        assert_eq!(sharing([170; 2], 4.0, &[3], &[4.9]), loose, "an unsure one must share more");
        assert_eq!(sharing([190; 2], 4.0, &[3], &[4.9]), None);
        assert_eq!(sharing([900, 10], 4.0, &[3], &[4.0]), None, "nearly all of one lies on a larger one");
        assert_eq!(sharing([70; 2], 4.0, &[3], &[4.0, 3.0]), None, "another holds it too");
        assert_eq!(sharing([70; 2], 4.0, &[3], &[4.0, -2.0]), loose, "the other has no voice of its own");
    }

    #[test]
    fn a_lone_scan_in_the_free_space_of_one_that_does_not_speak_for_it_is_objected_to() {
        let model = Model::new(3);
        let mut a = Component::single(ScanKey(1));
        a.poses.insert(ScanKey(3), model.contradiction((1, 3), true).a_from_b);
        let b = Component::single(ScanKey(2));
        let truth = model.contradiction((1, 2), true).a_from_b;
        let off = truth * Pose::from_translation(Vector3::new(2.0, 1.5, 0.0));
        // So many edges that the pair itself is not looked at, and no voice of its own, so that it is not asked what it shares.
        let object = |a: &Component, said: &[u128], a_from_b: Pose| {
            let voices = said.iter().map(|in_a| proposal(*in_a, a_from_b, -2.0));
            objection(
                &model.graph,
                (a, &b),
                &cluster(voices.collect()),
                Backing { support: 4.0, edges: FEW + 1 },
                &a_from_b,
                &MappingOptions::default(),
            )
        };
        assert_eq!(object(&a, &[1], truth), None);
        let refusal = object(&a, &[1], off);
        assert!(
            matches!(refusal, Some(Refusal::Violation { found, allowed }) if found > allowed && allowed == MOST_TRESPASS),
            "{refusal:?}"
        );
        assert_eq!(object(&a, &[1, 3], off), None, "nobody is silent");
        assert_eq!(object(&Component::single(ScanKey(1)), &[1], off), None, "nobody else is there");
    }
}
