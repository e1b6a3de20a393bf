//! What a client decided about two scans where the data alone cannot tell: identical rooms, a symmetric hall. Every join obeys.
//!
//! A scan may stand for its whole component: joining two scans joins the components that hold them. Poses are between the scans' own frames, as
//! clients see them.

use serde::{Deserialize, Serialize};

use super::component::Component;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::{PairKey, centred_difference};

/// What was decided about the two scans of a pair.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// They belong together at about this pose, which the surfaces then refine.
    Join {
        /// Maps scan b into scan a. Metres, own frames of the scans.
        a_from_b: Pose,
    },
    /// They do not belong together: at this pose, if one is given; in no way otherwise.
    Forbid {
        /// Maps scan b into scan a. Metres, own frames of the scans.
        a_from_b: Option<Pose>,
    },
}

/// A decision of a client about a pair of scans.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Decision {
    /// Which scans.
    pub pair: PairKey,
    /// What holds for them.
    pub verdict: Verdict,
}

impl Decision {
    /// Scan `y` belongs at `x_from_y` beside `x` (metres, own frames of the scans).
    #[must_use]
    pub fn join(x: ScanKey, y: ScanKey, x_from_y: &Pose) -> Self {
        Self { pair: PairKey::of(x, y), verdict: Verdict::Join { a_from_b: ordered(x, y, x_from_y) } }
    }

    /// Scan `y` does not belong at `x_from_y` beside `x`, or with `None` the two are never to be in one component.
    #[must_use]
    pub fn forbid(x: ScanKey, y: ScanKey, x_from_y: Option<&Pose>) -> Self {
        let a_from_b = x_from_y.map(|pose| ordered(x, y, pose));
        Self { pair: PairKey::of(x, y), verdict: Verdict::Forbid { a_from_b } }
    }
}

fn ordered(x: ScanKey, y: ScanKey, x_from_y: &Pose) -> Pose {
    if x < y { *x_from_y } else { x_from_y.inverse() }
}

/// All decisions that hold, in the order they were made.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Decisions {
    list: Vec<Decision>,
    /// What the mapper itself rules out while it grows: poses that it took back. Clients' joins stand against these.
    #[serde(skip)]
    taken_back: Vec<Decision>,
}

/// A decided join between two components.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DecidedJoin {
    /// The scan in the first component.
    pub in_a: ScanKey,
    /// The scan in the second.
    pub in_b: ScanKey,
    /// Maps the second component into the first.
    pub a_from_b: Pose,
    /// The same between the local frames of the two scans.
    pub in_a_from_in_b: Pose,
}

impl Decisions {
    /// All that was decided. A later decision about a pair replaces an earlier one that it contradicts: a join every other decision of its pair, a
    /// ban every join of its pair.
    #[must_use]
    pub fn new(decisions: &[Decision]) -> Self {
        let mut list: Vec<Decision> = Vec::new();
        for decision in decisions {
            list.retain(|known| {
                known.pair != decision.pair
                    || matches!(
                        (known.verdict, decision.verdict),
                        (Verdict::Forbid { .. }, Verdict::Forbid { .. })
                    ) && known.verdict != decision.verdict
            });
            list.push(*decision);
        }
        Self { list, taken_back: Vec::new() }
    }

    /// These decisions, and bans of the mapper's own until it has grown.
    #[must_use]
    pub fn with_taken_back(mut self, bans: &[Decision]) -> Self {
        self.taken_back.extend_from_slice(bans);
        self
    }

    /// The same without any ban.
    #[must_use]
    pub fn without_bans(&self) -> Self {
        let joins = self.list.iter().filter(|d| matches!(d.verdict, Verdict::Join { .. }));
        Self { list: joins.copied().collect(), taken_back: Vec::new() }
    }

    /// The decisions that hold.
    #[must_use]
    pub fn as_slice(&self) -> &[Decision] {
        &self.list
    }

    /// Forgets what was decided about a scan.
    pub fn remove_scan(&mut self, scan: ScanKey) {
        let others = |d: &Decision| d.pair.a != scan && d.pair.b != scan;
        self.list.retain(others);
        self.taken_back.retain(others);
    }

    /// The first decided join between two components, if any.
    #[must_use]
    pub fn join_between(&self, graph: &ScanGraph, a: &Component, b: &Component) -> Option<DecidedJoin> {
        self.list.iter().find_map(|decision| {
            let Verdict::Join { a_from_b } = decision.verdict else { return None };
            let local = local(graph, decision.pair, &a_from_b)?;
            let PairKey { a: first, b: second } = decision.pair;
            let placed = |in_a: ScanKey, in_b: ScanKey, motion: Pose| {
                let a_from_b = *a.poses.get(&in_a)? * motion * b.poses.get(&in_b)?.inverse();
                Some(DecidedJoin { in_a, in_b, a_from_b, in_a_from_in_b: motion })
            };
            placed(first, second, local).or_else(|| placed(second, first, local.inverse()))
        })
    }

    /// Whether anything is forbidden at all.
    #[must_use]
    pub fn forbid_any(&self) -> bool {
        self.list.iter().chain(&self.taken_back).any(|d| matches!(d.verdict, Verdict::Forbid { .. }))
    }

    /// Whether a ban stands against `a_from_b` between two components: a client's, or one of the mapper's own.
    #[must_use]
    pub fn forbids(
        &self,
        graph: &ScanGraph,
        a: &Component,
        b: &Component,
        a_from_b: &Pose,
        options: &MappingOptions,
    ) -> bool {
        self.client_forbids(graph, a, b, a_from_b, options)
            || self.taken_back.iter().any(|ban| rules_out(ban, graph, (a, b), a_from_b, options))
    }

    /// Whether a client's ban does.
    #[must_use]
    pub fn client_forbids(
        &self,
        graph: &ScanGraph,
        a: &Component,
        b: &Component,
        a_from_b: &Pose,
        options: &MappingOptions,
    ) -> bool {
        self.list.iter().any(|decision| rules_out(decision, graph, (a, b), a_from_b, options))
    }

    /// Whether anything was decided about a pair, by a client or by taking back what it led to.
    #[must_use]
    pub fn concern(&self, pair: PairKey) -> bool {
        self.list.iter().chain(&self.taken_back).any(|d| d.pair == pair)
    }

    /// Pairs of scans that a join holds together.
    pub fn joined_pairs(&self) -> impl Iterator<Item = PairKey> + '_ {
        self.list.iter().filter(|d| matches!(d.verdict, Verdict::Join { .. })).map(|d| d.pair)
    }
}

/// Whether a decision is a ban that stands against `a_from_b` between two components.
fn rules_out(
    decision: &Decision,
    graph: &ScanGraph,
    (a, b): (&Component, &Component),
    a_from_b: &Pose,
    options: &MappingOptions,
) -> bool {
    let Verdict::Forbid { a_from_b: banned } = decision.verdict else { return false };
    let PairKey { a: first, b: second } = decision.pair;
    let across = |x: ScanKey, y: ScanKey| Some((*a.poses.get(&x)?, *b.poses.get(&y)?));
    let between = match (across(first, second), across(second, first)) {
        (Some((a_from_first, b_from_second)), _) => a_from_first.inverse() * *a_from_b * b_from_second,
        (None, Some((a_from_second, b_from_first))) => {
            (a_from_second.inverse() * *a_from_b * b_from_first).inverse()
        }
        (None, None) => return false,
    };
    let Some(banned) = banned else { return true };
    let (Some(banned), Some(moved)) = (local(graph, decision.pair, &banned), graph.scan(second)) else {
        return false;
    };
    let (angle, distance) = centred_difference(&banned, &between, &moved.centroid);
    angle < options.rival_angle && distance < options.rival_voxels * moved.prepared.resolution
}

/// A motion between the own frames of two scans as one between the local frames of their prepared forms.
fn local(graph: &ScanGraph, pair: PairKey, a_from_b: &Pose) -> Option<Pose> {
    let (a, b) = (graph.scan(pair.a)?, graph.scan(pair.b)?);
    Some(a.prepared.local_from_scan() * *a_from_b * b.prepared.local_from_scan().inverse())
}

/// The same the other way.
#[must_use]
pub fn between_own_frames(graph: &ScanGraph, a: ScanKey, b: ScanKey, local_a_from_b: &Pose) -> Option<Pose> {
    let (a, b) = (graph.scan(a)?, graph.scan(b)?);
    Some(a.prepared.local_from_scan().inverse() * *local_a_from_b * b.prepared.local_from_scan())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_later_decision_replaces_what_it_contradicts() {
        let (x, y) = (ScanKey(2), ScanKey(1));
        let there = Pose::from_translation(nalgebra::Vector3::new(1.0, 0.0, 0.0));
        let join = Decision::join(x, y, &there);
        assert_eq!(join, Decision::join(y, x, &there.inverse()));
        let ban = Decision::forbid(x, y, Some(&there));
        let never = Decision::forbid(x, y, None);
        assert_eq!(Decisions::new(&[join, ban]).as_slice(), [ban]);
        assert_eq!(Decisions::new(&[ban, never, ban]).as_slice(), [never, ban]);
        assert_eq!(Decisions::new(&[ban, never, join]).as_slice(), [join]);
        let mut decisions = Decisions::new(&[join]);
        assert!(decisions.concern(PairKey::of(x, y)) && !decisions.forbid_any());
        decisions.remove_scan(y);
        assert!(decisions.as_slice().is_empty());
    }
}
