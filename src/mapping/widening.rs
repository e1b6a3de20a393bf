//! Retrieval that widens: what is still worth a try for scans and components that stay apart. Used by `policy`.

use std::collections::BTreeSet;

use super::mapper::Mapper;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::{Retrieval, ScanGraph};
use crate::pairwise::PairKey;

impl Mapper {
    /// Pairs worth a try for scans and components that stay apart: for every scan outside the largest component, its most similar
    /// scans elsewhere that were not tried yet. Those that are far down the list are never worth it, however often it is asked: two buildings
    /// that will never meet are not compared scan by scan.
    pub fn widen(
        &self,
        graph: &ScanGraph,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<BTreeSet<PairKey>, Cancelled> {
        let largest =
            (0..self.components.len()).max_by_key(|i| (self.components[*i].len(), std::cmp::Reverse(*i)));
        let home = |scan: &ScanKey| self.components.iter().position(|c| c.poses.contains_key(scan));
        let outside =
            graph.scans().map(|s| s.key()).filter(|scan| home(scan).is_none() || home(scan) != largest);
        let promising = options.retrieved * (options.widening_rounds + 1);
        let mut pairs = BTreeSet::new();
        for (scan, others) in Retrieval::new(graph).ranked(outside, control)? {
            let own = home(&scan);
            let fresh =
                others.into_iter().take(promising).map(|(other, _)| other).filter(|other| {
                    (own.is_none() || home(other) != own) && graph.edge(scan, *other).is_none()
                });
            pairs.extend(fresh.take(options.retrieved).map(|other| PairKey::of(scan, other)));
        }
        Ok(pairs)
    }
}
