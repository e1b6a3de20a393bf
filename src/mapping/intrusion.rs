//! Whether scans of a grown component stand in each other's free space. A join is judged by the scans that are there when it is made;
//! those that come later may show what it put into a room that was seen to be empty. Used by `undo`.

use std::collections::{BTreeMap, BTreeSet};

use super::component::Component;
use super::cuts::separating_cut;
use super::options::MappingOptions;
use super::surfaces::{judge, judge_each};
use super::testimony::Contradiction;
use super::tracks::Tracks;
use super::violation::{ViolationLimit, violation_of};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::PairKey;

/// A pair of scans is suspicious when more than this share of its judged points lies in free space.
const SUSPICIOUS: f64 = 0.05;
/// What has grown since it was joined may violate free space this many times as much as a new join. Right joins do so up to 1.1 times as
/// much, wrong ones more than twice.
const LENIENCE: f64 = 1.5;
/// Suspicious pairs whose separation is tried, those with most points in free space first.
const TRIED: usize = 8;

/// Two sides of a component that would not be joined for what lies in free space.
pub struct Intrusion {
    /// One of the sides.
    pub side: BTreeSet<ScanKey>,
    /// The pair that shows it: its pose is said to be wrong, not what would be right.
    pub shown_by: Contradiction,
}

/// The first of the component's suspicious pairs whose separating cut has sides that violate each other's free space by more than any
/// join may. `supports` are those of the component.
pub fn intrusion(
    graph: &ScanGraph,
    component: &Component,
    supports: &BTreeMap<(ScanKey, ScanKey), f64>,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<Intrusion>, Cancelled> {
    let Some(lenient) = options.levels.last() else { return Ok(None) };
    let mut suspicious = judge_each(graph, component);
    suspicious.retain(|(_, counts)| counts.violation_share() > SUSPICIOUS);
    suspicious.sort_by(|x, y| y.1.violations.cmp(&x.1.violations).then(x.0.cmp(&y.0)));
    for (pair, _) in suspicious.into_iter().take(TRIED) {
        control.check()?;
        let Some((side, support)) = separating_cut(component, supports, &[pair.a], &[pair.b]) else {
            continue;
        };
        let (Some((rest, part)), Some(a_from_b)) = (sides(component, &side), between(component, pair)) else {
            continue;
        };
        let found = violation_of(&judge(graph, &rest, &part, &Pose::identity()));
        let limit = ViolationLimit::new(graph, (&rest, &part), lenient, options);
        if found > LENIENCE * limit.share(support) {
            let shown_by = Contradiction::of_pose(pair, a_from_b);
            return Ok(Some(Intrusion { side, shown_by }));
        }
    }
    Ok(None)
}

fn between(component: &Component, pair: PairKey) -> Option<Pose> {
    Some(component.poses.get(&pair.a)?.inverse() * *component.poses.get(&pair.b)?)
}

/// The scans on either side, both in the component's frame; landmarks are not asked here. `None` if a side is empty.
fn sides(component: &Component, side: &BTreeSet<ScanKey>) -> Option<(Component, Component)> {
    let part = |inside: bool| {
        let poses: BTreeMap<ScanKey, Pose> = component
            .poses
            .iter()
            .filter(|(key, _)| side.contains(key) == inside)
            .map(|(key, pose)| (*key, *pose))
            .collect();
        Some(Component { gauge: *poses.keys().next()?, poses, tracks: Tracks::default() })
    };
    Some((part(false)?, part(true)?))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::{Rotation3, Vector3};

    use super::*;
    use crate::control::{CancelToken, Seed, Silent};
    use crate::features::{PrepareOptions, Scan, SensorPosition, prepare};
    use crate::simulate::{Sensor, SurveyOptions, simulate};

    #[test]
    fn a_side_that_stands_in_the_free_space_of_the_other_is_found() {
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let survey = simulate(&SurveyOptions {
            sensor: Sensor::panoramic(60_000),
            stations: 6,
            seed: Seed(3),
            ..SurveyOptions::default()
        })
        .expect("the options are valid");
        let options = PrepareOptions::at(0.15, Seed(0));
        let mut graph = ScanGraph::new();
        let mut right = Component { gauge: ScanKey(0), poses: BTreeMap::new(), tracks: Tracks::default() };
        for (key, scan) in (0..).map(ScanKey).zip(&survey.scans) {
            let prepared = prepare(key, &scan.cloud, SensorPosition::default(), &options, control)
                .expect("the scan is large enough");
            right.poses.insert(key, scan.model_from_scan * prepared.local_from_scan().inverse());
            graph.add_scan(Arc::new(Scan::new(prepared)));
        }
        let moved_side = |key: ScanKey| key >= ScanKey(3);
        let mut supports = BTreeMap::new();
        for a in 0..6 {
            for b in a + 1..6 {
                let (a, b) = (ScanKey(a), ScanKey(b));
                supports.insert((a, b), if moved_side(a) == moved_side(b) { 8.0 } else { 0.5 });
            }
        }
        let options = MappingOptions::default();
        let find =
            |component: &Component| intrusion(&graph, component, &supports, &options, control).unwrap();
        assert!(find(&right).is_none());

        let mut wrong = right.clone();
        let off = Pose::new(Rotation3::from_axis_angle(&Vector3::z_axis(), 0.6), Vector3::new(1.5, 0.7, 0.0));
        for (key, pose) in &mut wrong.poses {
            if moved_side(*key) {
                *pose = off * *pose;
            }
        }
        let found = find(&wrong).expect("half of the office was turned into the other half");
        let all = |side: &BTreeSet<ScanKey>, moved: bool| side.iter().all(|key| moved_side(*key) == moved);
        assert_eq!(found.side.len(), 3);
        assert!(all(&found.side, true) || all(&found.side, false));
        assert_ne!(moved_side(found.shown_by.pair.a), moved_side(found.shown_by.pair.b));

        token.cancel();
        assert!(intrusion(&graph, &wrong, &supports, &options, control).is_err());
    }
}
