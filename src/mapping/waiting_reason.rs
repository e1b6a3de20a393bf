//! Why a scan waits, in words for its owner. Used when a snapshot is made.

use super::candidates::best_candidate;
use super::component::Component;
use super::join::Refusal;
use super::mapper::Mapper;
use super::options::MappingOptions;
use super::snapshot::WaitingReason;
use crate::cloud::ScanKey;
use crate::graph::ScanGraph;

impl Mapper {
    /// Why a scan waits.
    #[must_use]
    pub fn waiting_reason(
        &self,
        scan: ScanKey,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
    ) -> WaitingReason {
        if graph.scans().len() < 2 {
            return WaitingReason::OnlyScan;
        }
        let least = options.levels.last().map_or(0.0, |l| l.support);
        let (best_support, needed) = match self.waiting.get(&scan).copied().flatten() {
            Some(Refusal::Rival { support, rival } | Refusal::Torn { support, rival }) => {
                return WaitingReason::Ambiguous { best_support: support, rival_support: rival };
            }
            Some(Refusal::Violation { found, allowed }) => {
                return WaitingReason::ViolatesFreeSpace { violation: found, allowed };
            }
            Some(Refusal::Contradicted { against, agreeing }) => {
                return WaitingReason::Contradicted { against, agreeing };
            }
            Some(Refusal::Indistinct { found, needed }) => {
                return WaitingReason::Indistinct { beyond_planes: found, needed };
            }
            Some(Refusal::Forbidden) => return WaitingReason::Forbidden,
            // Enough for the most lenient join, but not for what this would be.
            Some(Refusal::Support { found, needed }) if found >= least => (found, needed),
            Some(Refusal::Support { found, .. } | Refusal::SinglePair { support: found }) => (found, least),
            None => (0.0, least),
        };
        if self.only_a_ban_keeps_out(scan, graph, voxel, least, options) {
            return WaitingReason::Forbidden;
        }
        let tried = graph.neighbors(scan).count();
        WaitingReason::NoVerifiedPair { tried, best_support, needed }
    }

    /// Whether there would be support enough for a place of this scan if clients had forbidden nothing.
    fn only_a_ban_keeps_out(
        &self,
        scan: ScanKey,
        graph: &ScanGraph,
        voxel: f64,
        needed: f64,
        options: &MappingOptions,
    ) -> bool {
        if !options.decisions.forbid_any() {
            return false;
        }
        let unbanned = MappingOptions { decisions: options.decisions.without_bans(), ..options.clone() };
        let single = Component::single(scan);
        let waiting =
            self.waiting.keys().filter(|other| **other != scan).map(|other| Component::single(*other));
        let waiting: Vec<Component> = waiting.collect();
        self.components.iter().chain(&waiting).any(|other| {
            best_candidate(graph, other, &single, voxel, &unbanned).is_some_and(|best| {
                best.support >= needed
                    && options.decisions.client_forbids(graph, other, &single, &best.a_from_b, options)
            })
        })
    }
}
