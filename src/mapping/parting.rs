//! Components that are parted: what hangs together by little, to be decided anew, and pieces that one weak pair alone holds together, or one scan that
//! sees little of the other piece, unless other scans bear out how they lie. Such pieces
//! are not joined on one pair; but scan by scan, each on a pair of its own, a component can grow across one all the same, and if that pair is
//! wrong, so is all behind it. Used by `live_model` and `policy`.

use std::collections::{BTreeMap, BTreeSet};

use super::borne_out::borne_out;
use super::candidates::DECIDED;
use super::component::Component;
use super::consistency::{agreeing, supports};
use super::cuts::{bridge, glimpses, loose_side, smaller_side};
use super::join::Refusal;
use super::mapper::Mapper;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;

/// Scans that share less than this see little of each other, often no more than a floor and two walls. In simulated houses, pairs of one scan that were
/// sure of a wrong place shared 9 to 20 %.
const SLIGHT: f64 = 0.22;

/// The pairs with support whose scans see little of each other at the poses that they have.
fn slight(
    graph: &ScanGraph,
    component: &Component,
    supports: &Supports,
    options: &MappingOptions,
) -> BTreeSet<(ScanKey, ScanKey)> {
    let shares_little = |(a, b): &(ScanKey, ScanKey)| {
        let (Some(model_from_a), Some(model_from_b)) = (component.poses.get(a), component.poses.get(b))
        else {
            return false;
        };
        let now = model_from_a.inverse() * *model_from_b;
        let found = graph.edge(*a, *b).and_then(|edge| agreeing(graph, edge, &now, options));
        found.is_some_and(|h| h.hypothesis.evidence.both().overlap() < SLIGHT)
    };
    // What a client joined holds, however little it is.
    let asked = supports.iter().filter(|(_, support)| **support < DECIDED);
    asked.map(|(pair, _)| *pair).filter(shares_little).collect()
}

/// What pairs of a component's scans say for their poses.
type Supports = BTreeMap<(ScanKey, ScanKey), f64>;

impl Mapper {
    /// Takes apart what hangs together by less than `least` support, so that it is decided anew with all evidence there is now.
    /// What was joined leniently when little was known cannot poison the rest.
    pub fn loosen(
        &mut self,
        graph: &ScanGraph,
        least: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        self.part(graph, options, control, |component, supports| Ok(loose_side(component, supports, least)))?;
        self.forget_setbacks();
        self.doubted.clear();
        self.undone.clear();
        for refusal in self.waiting.values_mut() {
            // What was taken back then is no verdict on what is decided now.
            *refusal = refusal.filter(|refusal| !matches!(refusal, Refusal::Contradicted { .. }));
        }
        self.dissolve_small();
        self.sort_components();
        Ok(())
    }

    /// Lets everything that was refused, filtered or set aside be tried again.
    pub fn forget_setbacks(&mut self) {
        self.refused.clear();
        self.filtered.clear();
        self.set_aside.clear();
    }

    /// Parts components at their bridges that are not firm, and where one scan alone sees little of a piece, unless other scans bear out how it lies.
    pub fn part_at_bridges(
        &mut self,
        graph: &ScanGraph,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        self.part(graph, options, control, |component, supports| {
            for glimpse in glimpses(component, supports, &slight(graph, component, supports, options)) {
                if !borne_out(graph, component, &glimpse, control)? {
                    return Ok(Some(smaller_side(component, glimpse.piece)));
                }
            }
            Ok(bridge(component, supports, options.firm_support))
        })?;
        graph.forget_fine_of_many();
        self.sort_components();
        Ok(())
    }

    /// Splits a side off every component, and off what is left, while there is one.
    fn part(
        &mut self,
        graph: &ScanGraph,
        options: &MappingOptions,
        control: Control<'_>,
        side: impl Fn(&Component, &Supports) -> Result<Option<BTreeSet<ScanKey>>, Cancelled>,
    ) -> Result<(), Cancelled> {
        let mut pending = std::mem::take(&mut self.components);
        while let Some(mut component) = pending.pop() {
            control.check()?;
            match side(&component, &supports(graph, &component, options))? {
                Some(side) => {
                    pending.extend(component.split_off(&side, options));
                    pending.push(component);
                }
                None => self.components.push(component),
            }
        }
        Ok(())
    }
}
