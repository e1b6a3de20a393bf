//! A hearing: whether what several pairs say alike against a component can be true. Then some of its scans would have to move, together,
//! and would fit the rest no worse where they went. Where alike places were folded onto each other they do; where a place looks alike
//! from both ends, such as a hall, all who see more of it than the pairs that were misled say that the scans belong where they are. Used by
//! `testimony`.

use std::cell::OnceCell;

use rayon::prelude::*;

use super::component::Component;
use super::cuts::least_cut;
use super::options::MappingOptions;
use super::voice::Word;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::{Edge, ScanGraph};
use crate::pairwise::{centred_difference, icp, look_finely, preference, quick_overlap};

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
/// Points that are looked at to see whether scans would meet at all where they moved to, …
const QUICK_POINTS: usize = 500;
/// … and the share of them that must.
const LEAST_OVERLAP: f64 = 0.02;

/// Whether what these words say, which agree with the first, is believable of some of the component's scans. Pairs are looked at with the
/// finest surfaces there are; where there are none, anything is.
pub fn is_believable(
    graph: &ScanGraph,
    component: &Component,
    words: &[&Word],
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<bool, Cancelled> {
    let Some(first) = words.first() else { return Ok(false) };
    let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
    let index = |scan: ScanKey| keys.binary_search(&scan).ok();
    let edges: Vec<(usize, usize, &Edge)> =
        graph.edges().filter_map(|edge| Some((index(edge.pair.a)?, index(edge.pair.b)?, edge))).collect();
    let losses: Vec<Loss> = edges
        .par_iter()
        .map(|(_, _, edge)| {
            control.check()?;
            Ok(loss(graph, component, edge, &first.motion, options).unwrap_or_default())
        })
        .collect::<Result<_, Cancelled>>()?;
    let n = keys.len();
    // At i * n + j, what is lost where j moves and i stays.
    let mut lost = vec![0.0; n * n];
    for ((i, j, _), loss) in edges.iter().zip(losses) {
        lost[i * n + j] = loss.b_moves;
        lost[j * n + i] = loss.a_moves;
    }
    for word in words {
        control.check()?;
        let (stays, moves) = (index(word.stays()), index(word.moves()));
        if !stays.zip(moves).is_some_and(|(stays, moves)| is_refuted(&lost, n, stays, moves)) {
            return Ok(true);
        }
    }
    Ok(false)
}

/// Whether the scans stay, by all pairs between those that would move along with `moves`, as it costs least, and those that stay with `stays`.
fn is_refuted(lost: &[f64], n: usize, stays: usize, moves: usize) -> bool {
    let mut spare: Vec<f64> = lost.iter().map(|loss| loss.max(0.0)).collect();
    let Some((staying, _)) = least_cut(&mut spare, n, stays, moves) else { return false };
    let mut stays = vec![false; n];
    for i in staying {
        stays[i] = true;
    }
    let across = (0..n * n).filter(|at| stays[at / n] && !stays[at % n]).map(|at| lost[at]);
    let said: Vec<f64> = across.filter(|loss| *loss != 0.0).collect();
    let total: f64 = said.iter().sum();
    let surest = said.iter().copied().fold(0.0, f64::min);
    total >= DECISIVE && total >= LEAST_MEAN * said.len() as f64 && surest > -SURE
}

/// What a pair loses in log-odds where one of its scans moves and the other stays; nothing where it cannot tell.
#[derive(Debug, Clone, Copy, Default)]
struct Loss {
    b_moves: f64,
    a_moves: f64,
}

fn loss(
    graph: &ScanGraph,
    component: &Component,
    edge: &Edge,
    motion: &Pose,
    options: &MappingOptions,
) -> Option<Loss> {
    let (a, b) = (graph.scan(edge.pair.a)?, graph.scan(edge.pair.b)?);
    let (model_from_a, model_from_b) =
        (component.poses.get(&edge.pair.a)?, component.poses.get(&edge.pair.b)?);
    let voxel = a.prepared.resolution;
    let stride = b.prepared.points.len().div_ceil(QUICK_POINTS).max(1);
    let least = LEAST_OVERLAP * b.prepared.points.len().div_ceil(stride) as f64;
    let meet = |pose: &Pose| quick_overlap(a, b, pose, stride) as f64 >= least;
    let apart = |x: &Pose, y: &Pose| {
        let (angle, distance) = centred_difference(x, y, &b.centroid);
        (angle < options.rival_angle && distance < options.rival_voxels * voxel).then_some(distance)
    };
    let near = |x: &Pose, y: &Pose| apart(x, y).is_some();
    let now = model_from_a.inverse() * *model_from_b;
    if !meet(&now) {
        return None;
    }
    let seen_now = OnceCell::new();
    let lost = |moved: &Pose| {
        // What the pair itself found there is nearer to right than what another pair's pose implies.
        let found = edge.hypotheses.iter().map(|h| h.hypothesis.a_from_b);
        let own = found
            .filter_map(|pose| Some((apart(&pose, moved)?, pose)))
            .min_by(|x, y| x.0.total_cmp(&y.0))
            .map(|(_, pose)| pose);
        if own.is_none() && !meet(moved) {
            return Some(0.0);
        }
        let there = own.unwrap_or_else(|| icp(a, b, moved));
        if near(&now, &there) || !meet(&there) {
            return Some(0.0);
        }
        let seen_now = (*seen_now.get_or_init(|| look_finely(a, b, &now)))?;
        let worth = preference(&seen_now, &look_finely(a, b, &there)?, voxel / 2.0);
        Some(worth.clamp(-MOST, MOST))
    };
    let b_moved = model_from_a.inverse() * *motion * *model_from_b;
    let a_moved = (*motion * *model_from_a).inverse() * *model_from_b;
    let b_moves = lost(&b_moved)?;
    // Half a turn is its own inverse.
    let a_moves = if near(&b_moved, &a_moved) { b_moves } else { lost(&a_moved)? };
    Some(Loss { b_moves, a_moves })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::test_hall::Model;
    use crate::mapping::testimony::Contradiction;
    use crate::mapping::voice::loudest;

    #[test]
    fn pairs_that_a_hall_misleads_are_not_believed_and_those_that_see_a_turned_scan_are() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let hear = |graph: &ScanGraph, component: &Component, said: &[Contradiction]| {
            let words = Word::both_ways(graph, component, said, &options);
            let voice = loudest(&words, options.rival_angle);
            assert!(voice.len() >= said.len());
            is_believable(graph, component, &voice, &options, control)
        };
        let misled = [model.contradiction((1, 4), false), model.contradiction((2, 3), false)];
        assert_eq!(hear(&model.graph, &model.component, &misled), Ok(false));
        assert_eq!(
            hear(&model.coarse(), &model.component, &misled),
            Ok(true),
            "nothing tells the ends apart"
        );
        let wrong = model.with_turned(&[5]);
        let witnesses = [model.contradiction((1, 5), true), model.contradiction((2, 5), true)];
        assert_eq!(hear(&model.graph, &wrong, &witnesses), Ok(true));
        token.cancel();
        assert_eq!(hear(&model.graph, &wrong, &witnesses), Err(Cancelled));
    }

    #[test]
    fn what_moves_together_is_weighed_together_and_one_sure_pair_is_enough() {
        // Scans 0 to 2 are one room, 3 to 5 another that was folded onto it.
        let between = |across: f64, witness: f64| {
            let mut lost = vec![0.0; 36];
            for (i, j) in (0..6).flat_map(|i| (0..6).map(move |j| (i, j))).filter(|(i, j)| i != j) {
                lost[i * 6 + j] = if (i < 3) == (j < 3) { 3.0 } else { across };
            }
            lost[5] = witness;
            lost
        };
        assert!(!is_refuted(&between(0.0, -0.5), 6, 0, 5), "the rooms have nothing to say to each other");
        assert!(is_refuted(&between(2.0, 0.5), 6, 0, 5), "all but the witness know better");
        assert!(!is_refuted(&between(2.0, -2.5), 6, 0, 5), "the witness is sure");
        assert!(!is_refuted(&between(0.6, 0.6), 6, 0, 5), "nobody is");
    }
}
