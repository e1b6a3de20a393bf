//! Scans that several components claim which do not fit each other, placed at last. While the model grows they are set aside, since a scan that two alike
//! places pull at says nothing of either. When nothing more fits, the log-odds of its pairs by themselves mostly tell: what a join weighs is
//! limited for each pair and raised by third scans, and so may be about as much for the wrong place. Used by `policy`.

use super::candidates::{CLUSTERS, Candidate, candidates, moved};
use super::component::Component;
use super::join::{Refusal, weigh_join};
use super::mapper::Mapper;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;

/// A scan is settled where its pairs by themselves have these log-odds together, …
const MUCH: f64 = 8.0;
/// … this many times as much as for any pose in another component. Of 34 such scans in simulated houses that settles 14, all where they belong; wrong
/// places had up to 1.6 times as much as right ones.
const CLEARLY_MORE: f64 = 2.0;

/// A component in which much more speaks for a scan than in any other.
struct Settled {
    scan: ScanKey,
    component: usize,
    candidates: Vec<Candidate>,
}

impl Settled {
    /// The most that pairs by themselves say for one pose: log-odds.
    fn most(&self) -> f64 {
        self.candidates.iter().map(Candidate::alone).fold(0.0, f64::max)
    }

    /// The pose with most support.
    fn best(&self) -> Option<&Candidate> {
        self.candidates.first()
    }

    /// What pairs by themselves say for that.
    fn alone(&self) -> f64 {
        self.best().map_or(0.0, Candidate::alone)
    }
}

impl Mapper {
    /// Registers scans that were set aside because components tear at them, each where several of its pairs say much more for it than elsewhere, if that
    /// passes as a firm join. Where alike places were found, nothing is settled, nor scans of which a hearing left open where they belong.
    pub fn settle(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<(), Cancelled> {
        let Some(level) = options.firm_levels().last() else { return Ok(()) };
        if !self.doubted.is_empty() {
            return Ok(());
        }
        // Scans that were settled are no witnesses for others.
        for Settled { scan, component, candidates } in self.clearly_claimed(graph, voxel, options, control)? {
            control.check()?;
            let (of, single) = (&self.components[component], Component::single(scan));
            let Ok(a_from_b) = weigh_join(graph, (of, &single), &candidates, level, voxel, options, control)?
            else {
                continue;
            };
            // It was weighed against other components at its best pose alone.
            let elsewhere =
                |best: &Candidate| moved(graph, &single, &best.a_from_b, &a_from_b, voxel, options);
            if candidates.first().is_none_or(elsewhere) {
                continue;
            }
            self.set_aside.remove(&scan);
            self.take_in((component, single), &a_from_b, graph, voxel, options, control)?;
        }
        Ok(())
    }

    /// The scans that were set aside and have so much for them in one component alone, those with most first.
    fn clearly_claimed(
        &self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<Vec<Settled>, Cancelled> {
        let mut found = Vec::new();
        for scan in &self.set_aside {
            control.check()?;
            if !matches!(self.waiting.get(scan), Some(Some(Refusal::Torn { .. }))) {
                continue;
            }
            let single = Component::single(*scan);
            let claim = |(component, of): (usize, &Component)| {
                let candidates = candidates(graph, of, &single, voxel, options, CLUSTERS);
                Settled { scan: *scan, component, candidates }
            };
            let mut claims: Vec<Settled> = self.components.iter().enumerate().map(claim).collect();
            claims.sort_by(|x, y| y.alone().total_cmp(&x.alone()).then(x.component.cmp(&y.component)));
            let elsewhere = claims.iter().skip(1).map(Settled::most).fold(0.0, f64::max);
            let clearly = |claim: &Settled| {
                claim.best().is_some_and(Candidate::rests_on_several)
                    && claim.alone() >= MUCH.max(CLEARLY_MORE * elsewhere)
            };
            found.extend(claims.into_iter().next().filter(clearly));
        }
        found.sort_by(|x, y| y.alone().total_cmp(&x.alone()).then(x.scan.cmp(&y.scan)));
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::decision::{Decision, Decisions, between_own_frames};
    use crate::mapping::test_hall::Model;
    use crate::pairwise::{Evidence, Hypothesis, PairKey, PairResult};

    /// Two pieces of a hall, and scan 8: the first four scans would have it at the wrong end, with these log-odds, the other three where it belongs.
    fn torn(model: &Model, wrong: f64, right: f64, options: &MappingOptions) -> (Mapper, ScanGraph) {
        let mut graph = model.coarse();
        let pairs = (1..=7).map(|k| (k, 8)).chain((1..=4).flat_map(|k| (5..=7).map(move |of| (k, of))));
        let results = pairs.map(|(k, of)| {
            let (truly, logit) = if k > 4 { (true, right) } else { (false, wrong) };
            let hypothesis = Hypothesis {
                a_from_b: model.contradiction((k, of), truly).a_from_b,
                evidence: Evidence::default(),
                logit,
            };
            let hypotheses = if of == 8 { vec![hypothesis] } else { Vec::new() };
            PairResult { pair: PairKey::of(ScanKey(k), ScanKey(of)), matches: Vec::new(), hypotheses }
        });
        graph.add_results(results.collect::<Vec<_>>(), &options.support);
        let mut large = model.component.clone();
        large.remove(ScanKey(8), options);
        let small = large.split_off(&BTreeSet::from([5, 6, 7].map(ScanKey)), options);
        let mut mapper =
            Mapper { components: small.into_iter().chain([large]).collect(), ..Mapper::default() };
        mapper.waiting.insert(ScanKey(8), Some(Refusal::Torn { support: 12.0, rival: 12.0 }));
        mapper.set_aside.insert(ScanKey(8));
        (mapper, graph)
    }

    #[test]
    fn a_scan_that_was_torn_is_settled_where_its_own_pairs_say_much_more() {
        let model = Model::new(8);
        let mut options = MappingOptions::default();
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let settle = |(mut mapper, graph): (Mapper, ScanGraph), options: &MappingOptions| {
            mapper.settle(&graph, model.hall.resolution, options, control)?;
            let home = mapper.components.iter().find(|c| c.poses.contains_key(&ScanKey(8)));
            let placed = home.is_some();
            assert_eq!(placed, !mapper.set_aside.contains(&ScanKey(8)));
            assert_eq!(placed, !mapper.waiting.contains_key(&ScanKey(8)));
            Ok(home.map(|home| home.poses.keys().map(|key| key.0).collect::<Vec<_>>()))
        };
        assert_eq!(settle(torn(&model, 1.0, 6.0, &options), &options), Ok(Some(vec![5, 6, 7, 8])));
        let nearly = torn(&model, 3.0, 6.0, &options);
        assert_eq!(settle(nearly, &options), Ok(None), "18 are not twice as much as 12");
        assert_eq!(settle(torn(&model, 0.3, 2.0, &options), &options), Ok(None), "they are not sure enough");
        let (mut folded, graph) = torn(&model, 1.0, 6.0, &options);
        folded.doubted.insert(ScanKey(9));
        assert_eq!(settle((folded, graph), &options), Ok(None), "alike places were found");
        let (mut open, graph) = torn(&model, 1.0, 6.0, &options);
        open.waiting.insert(ScanKey(8), Some(Refusal::Contradicted { against: 2, agreeing: 9 }));
        assert_eq!(settle((open, graph), &options), Ok(None), "a hearing left it open");
        let case = torn(&model, 1.0, 6.0, &options);
        let local = model.contradiction((5, 8), true).a_from_b;
        let pose = between_own_frames(&case.1, ScanKey(5), ScanKey(8), &local).expect("both are there");
        options.decisions = Decisions::new(&[Decision::forbid(ScanKey(5), ScanKey(8), Some(&pose))]);
        assert_eq!(settle(case, &options), Ok(None), "a client forbids it");
        options.decisions = Decisions::default();
        token.cancel();
        assert_eq!(settle(torn(&model, 1.0, 6.0, &options), &options), Err(Cancelled));
    }
}
