//! A close look at a join that rests on one or two pairs. So little says where it belongs that it must show nothing odd at half the voxel
//! either: a wrong pose that looks clear of free space mostly stands in it there. Used by `join`.

use super::candidates::{Candidate, LEAST_WORD, Proposal};
use super::component::Component;
use super::join::Refusal;
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph};
use crate::pairwise::{Counts, PairKey, look_finely, look_leniently};

/// So many pairs are few: what rests on them is looked at closely, and not straightened until it fits.
pub const FEW: usize = 2;
/// Of the judged points of few pairs this share may lie in free space (in simulated houses, right pairs put 0.1 % there and 99 of 100 at most 1.3 %,
/// wrong ones that nothing else gave away 1.3 to 2.4 %), …
const MOST_VIOLATION: f64 = 0.01;
/// … or this many times what the firmest pairs show, where the data are that noisy.
const CONTRAST: f64 = 4.0;
/// How many of the firmest pairs are asked …
const FIRMEST: usize = 12;
/// … and how many there must be for them to say what is usual.
const LEAST_FIRM: usize = 4;
/// Where fewer points can be judged, nothing can be said.
const LEAST_JUDGED: u32 = 100;

/// What is wrong with a join of b to a at this pose, which so many edges speak for, if anything is.
#[must_use]
pub fn objection(
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    candidate: &Candidate,
    edges: usize,
    a_from_b: &Pose,
) -> Option<Refusal> {
    if edges > FEW || candidate.decided {
        return None;
    }
    let look = |member: &Proposal| {
        let (x, y) = (graph.scan(member.in_a)?, graph.scan(member.in_b)?);
        let (a_from_x, b_from_y) = (a.poses.get(&member.in_a)?, b.poses.get(&member.in_b)?);
        look_leniently(x, y, &(a_from_x.inverse() * *a_from_b * *b_from_y))
    };
    let speaking = || candidate.members.iter().filter(|member| member.evidence > LEAST_WORD);
    let seen = speaking().filter_map(look).fold(Counts::default(), |sum, counts| sum.plus(&counts));
    let found = seen.violation_share();
    if seen.inliers + seen.violations < LEAST_JUDGED || found <= MOST_VIOLATION {
        return None;
    }
    let own: Vec<PairKey> = speaking().map(|member| PairKey::of(member.in_a, member.in_b)).collect();
    let allowed = MOST_VIOLATION.max(CONTRAST * usual(graph, &own).unwrap_or(0.0));
    (found > allowed).then_some(Refusal::Violation { found, allowed })
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
    use nalgebra::Vector3;

    use super::*;
    use crate::cloud::ScanKey;
    use crate::mapping::test_hall::Model;

    #[test]
    fn a_join_of_one_pair_that_puts_surfaces_into_free_space_is_objected_to() {
        let model = Model::new(2);
        let (a, b) = (Component::single(ScanKey(1)), Component::single(ScanKey(2)));
        let truth = model.contradiction((1, 2), true).a_from_b;
        let candidate = |a_from_b: Pose, decided: bool| {
            let member = Proposal {
                a_from_b,
                in_a: ScanKey(1),
                in_b: ScanKey(2),
                in_a_from_in_b: a_from_b,
                evidence: 4.0,
                doubt: 4.0,
                alone: 4.0,
                centroid: Vector3::zeros(),
            };
            Candidate { a_from_b, support: 4.0, doubt: 4.0, rival: 0.0, members: vec![member], decided }
        };
        let object = |graph: &ScanGraph, a_from_b: Pose, edges: usize, decided: bool| {
            objection(graph, (&a, &b), &candidate(a_from_b, decided), edges, &a_from_b)
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
}
