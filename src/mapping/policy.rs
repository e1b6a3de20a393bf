//! The order of mapping: which step comes when, what is tried again, and when the model is refined.
//!
//! At each level of strictness, strictest first: register the next scan into a component; else merge two components; else start
//! a component from an initial pair. Any success goes back to the strictest level, because the model has grown and what waited may
//! now be well supported. When nothing fits, misplaced scans are filtered and tried again, waiting scans reclaim those that belong to them, and
//! retrieval widens for what stays apart.
//! Where the pairs that it tries show that right poses are rarer than it seemed, all is joined anew.
//! Only firm joins are made before all pairs that retrieval proposes were tried: a weak one is weighed with all that can be known. Where
//! alike places were found, none but those of the strictest level are made from then on, which no single pair passes. Pieces that a single weak pair, or one scan that sees little, turns out to hold together
//! are parted at the end, unless others bear the latter out; and before that, scans that components tore at are settled where their own pairs say clearly which is right. What is left waits.

use std::collections::BTreeSet;

use super::mapper::Mapper;
use super::options::{JoinLevel, MappingOptions};
use crate::control::{Cancelled, Control, Stage};
use crate::graph::ScanGraph;
use crate::pairwise::PairResult;

/// Rounds in which contradicted joins are undone while the model grows, and again when all is asked once more; after that what was undone
/// stays apart.
const MAX_UNDONE: usize = 20;

/// Grows the model until nothing more fits. `pairs` collects the results of pairs that widening tried.
pub fn grow(
    mapper: &mut Mapper,
    graph: &mut ScanGraph,
    voxel: f64,
    options: &MappingOptions,
    pairs: &mut Vec<PairResult>,
    control: Control<'_>,
) -> Result<(), Cancelled> {
    let mut rounds = 0;
    let mut undone = 0;
    let told = options;
    let mut options = options.clone();
    let mut weakly = false;
    let mut is_last = false;
    loop {
        let levels = if !mapper.doubted.is_empty() {
            options.strictest_level()
        } else if weakly {
            &options.levels
        } else {
            options.firm_levels()
        };
        join_all(mapper, graph, levels, voxel, &options, control)?;
        if mapper.filter_scans(graph, voxel, &options, control)? > 0
            || mapper.reclaim(graph, voxel, &options, control)?
        {
            continue;
        }
        if let Some(bans) = mapper.undo_contradicted(graph, voxel, &options, control)? {
            undone += 1;
            options.decisions = options.decisions.with_taken_back(&bans);
            if undone < MAX_UNDONE {
                continue;
            }
        }
        let fresh: BTreeSet<_> = if rounds < options.widening_rounds {
            mapper.widen(graph, &options, control)?
        } else {
            BTreeSet::new()
        };
        if !fresh.is_empty() {
            rounds += 1;
            let correction = graph.correction();
            pairs.extend(graph.try_pairs(&fresh, &options.support, control)?);
            if graph.correction() < correction {
                // Right poses are rarer than it seemed, and what was joined may not be as likely as it was.
                let placed = mapper.components.iter().flat_map(|c| c.poses.keys().copied()).collect();
                mapper.reopen(&placed);
                mapper.refused.clear();
            }
        } else if !weakly {
            weakly = true;
        } else if !is_last && mapper.doubted.is_empty() && (undone > 0 || !mapper.set_aside.is_empty()) {
            // What was torn apart or set aside was so when less was known of what surrounds it: all is asked once more.
            is_last = true;
            undone = 0;
            options.decisions = told.decisions.clone();
            mapper.forget_setbacks();
        } else {
            break;
        }
    }
    mapper.settle(graph, voxel, &options, control)?;
    mapper.part_at_bridges(graph, &options, control)?;
    if mapper.refinement_is_due(&options) {
        mapper.refine(graph, voxel, &options, control)?;
    }
    mapper.sort_components();
    mapper.list_open_joins(graph, voxel, &options, control)
}

/// Makes joins, strictest level first, until no level makes any.
fn join_all(
    mapper: &mut Mapper,
    graph: &ScanGraph,
    levels: &[JoinLevel],
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<(), Cancelled> {
    let total = mapper.registered() + mapper.waiting.len();
    let mut level = 0;
    while let Some(rules) = levels.get(level) {
        control.check()?;
        let joined = mapper.register_next_scan(graph, rules, voxel, options, control)?.is_some()
            || mapper.merge_components(graph, rules, voxel, options, control)?
            || mapper.start_component(graph, rules, voxel, options, control)?;
        if joined {
            level = 0;
            control.report(Stage::Map, mapper.registered(), total);
            if mapper.refinement_is_due(options) {
                mapper.refine(graph, voxel, options, control)?;
            }
        } else {
            level += 1;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::ScanKey;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::component::Component;
    use crate::mapping::test_hall::Model;
    use crate::mapping::tracks::Tracks;

    #[test]
    fn what_was_set_aside_is_asked_once_more_when_nothing_else_fits() {
        let model = Model::new(8);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let mut poses = model.component.poses.clone();
        poses.remove(&ScanKey(8));
        let rest = Component { gauge: ScanKey(1), poses, tracks: Tracks::default() };
        let mut mapper = Mapper { components: vec![rest], ..Mapper::default() };
        mapper.add_waiting(ScanKey(8));
        mapper.set_aside.insert(ScanKey(8));
        let (mut graph, options, mut pairs) = (model.graph.clone(), MappingOptions::default(), Vec::new());
        let total = model.component.len();
        grow(&mut mapper, &mut graph, model.hall.resolution, &options, &mut pairs, control)
            .expect("nobody cancels");
        assert!(mapper.set_aside.is_empty() && mapper.waiting.is_empty());
        assert_eq!(mapper.components.iter().map(Component::len).collect::<Vec<_>>(), [total]);
    }
}
