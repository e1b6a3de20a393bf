//! What is to be done about a component, given all that speaks against it: what the hearing ruled, pairs that deny it, what outweighs the support of a
//! join, cuts that would not be joined as they are, and surfaces in free space. Used by `undo`, which does it.

use std::collections::{BTreeMap, BTreeSet};

use super::component::Component;
use super::cuts::{separating_cut, smaller_side};
use super::denial::Denials;
use super::hearing::{Hearing, Ruling};
use super::intrusion::{Intrusion, intrusion};
use super::options::MappingOptions;
use super::testimony::{Contradiction, Testimony, testimony};
use super::tracks::Tracks;
use super::undecided::{Undecided, undecided};
use super::voice::{Word, loudest, one_voice};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;

/// A join is undone when what pairs with one voice say against it comes to this share of its support …
const AGAINST_SHARE: f64 = 0.5;
/// … and without asking whether places are alike when it comes to this: of alike places, either has much for it. Where such were folded
/// onto each other it comes to 1.2 at most.
const OVERWHELMING_SHARE: f64 = 2.0;
/// … and at least this many pairs say the same.
const AGAINST_PAIRS: usize = 2;
/// Where alike places were folded onto each other, what is said with one voice comes to this and more for each witness. Where it comes to less, and all
/// of it is of one scan, that scan is wrong and not the rest: one that was turned by half in a laboratory had 0.032.
const CLEAR_WEIGHT: f64 = 0.04;
/// Contradictions whose separation is tried, the strongest first.
const TRIED: usize = 8;

/// What is to be done about a component, given what speaks against it.
pub enum Finding {
    /// Nothing.
    Sound,
    /// Alike places were taken for one, or nothing tells which of two is right: nothing of it is kept.
    Folded { strongest: Contradiction },
    /// One join in it is wrong: that of this side.
    Torn { side: BTreeSet<ScanKey>, strongest: Contradiction },
    /// It is open where these few scans belong.
    Open { scans: BTreeSet<ScanKey>, strongest: Contradiction },
}

/// A component, and what is said of it.
pub struct Case<'c> {
    /// The scan graph.
    pub graph: &'c ScanGraph,
    /// The component.
    pub component: &'c Component,
    /// What pairs of its scans say for their poses.
    pub supports: &'c BTreeMap<(ScanKey, ScanKey), f64>,
    /// What was said of it, after the hearing.
    pub testimony: &'c Testimony,
    /// Settings.
    pub options: &'c MappingOptions,
}

impl Case<'_> {
    /// What is to be done. Of `asked`, the component with some scans that wait, `waits` are these.
    pub fn finding(
        &self,
        asked: &Component,
        waits: &BTreeSet<ScanKey>,
        voxel: f64,
        control: Control<'_>,
    ) -> Result<Finding, Cancelled> {
        let Self { graph, component, supports, testimony, options } = *self;
        let condemned = testimony.contradictions.first().copied().filter(|_| testimony.condemns());
        let moved = match &testimony.ruling {
            Some(Ruling::Moves { scans, motion, clearly }) => condemned
                .zip(self.part(scans))
                .map(|(strongest, side)| (strongest, side, scans, motion, *clearly)),
            _ => None,
        };
        if let Some((_, side, _, _, true)) = &moved {
            return Ok(self.torn(side.clone()));
        }
        if let Some(strongest) = Denials::of(graph, component, options).shown() {
            return Ok(Finding::Folded { strongest });
        }
        if let Some((strongest, side, scans, motion, _)) = moved {
            let settled = self.settles(asked, scans, motion, waits, control)?;
            return Ok(if settled { self.torn(side) } else { Finding::Folded { strongest } });
        }
        if let Some((side, strongest)) = self.tear(OVERWHELMING_SHARE, control)? {
            return Ok(Finding::Torn { side, strongest });
        }
        if let Some(strongest) = condemned {
            let few = match &testimony.ruling {
                Some(Ruling::Open(scans)) => self.part(scans),
                _ => None,
            };
            if few.is_none()
                && let Some(scan) = self.suspect()
            {
                return Ok(self.torn(BTreeSet::from([scan])));
            }
            return Ok(match few {
                Some(scans) => Finding::Open { strongest: self.shown_by(&scans).unwrap_or(strongest), scans },
                None => Finding::Folded { strongest },
            });
        }
        if let Some((side, strongest)) = self.tear(AGAINST_SHARE, control)? {
            return Ok(Finding::Torn { side, strongest });
        }
        match undecided(graph, component, testimony, voxel, options, control)? {
            Some(Undecided { strongest, alike: true, .. }) => return Ok(Finding::Folded { strongest }),
            Some(Undecided { side, strongest, .. }) => return Ok(Finding::Torn { side, strongest }),
            None => {}
        }
        Ok(match intrusion(graph, component, supports, options, control)? {
            Some(Intrusion { side, shown_by }) => {
                Finding::Torn { side: smaller_side(component, side), strongest: shown_by }
            }
            None => Finding::Sound,
        })
    }

    /// Those of the scans that the component holds, if they are some and not all of its.
    fn part(&self, scans: &BTreeSet<ScanKey>) -> Option<BTreeSet<ScanKey>> {
        let held: BTreeSet<ScanKey> =
            scans.iter().filter(|scan| self.component.poses.contains_key(scan)).copied().collect();
        (!held.is_empty() && held.len() < self.component.len()).then_some(held)
    }

    /// The surest of the pairs that contradict the component and are of this side and the rest.
    fn shown_by(&self, side: &BTreeSet<ScanKey>) -> Option<Contradiction> {
        let across = |c: &&Contradiction| side.contains(&c.pair.a) != side.contains(&c.pair.b);
        self.testimony.inside(self.component).find(across).copied()
    }

    /// The scan that all pairs which contradict are of, where all of these are of the component and weigh less together than they do where alike places were folded.
    fn suspect(&self) -> Option<ScanKey> {
        let contradictions = &self.testimony.contradictions;
        if self.testimony.condemns_by(CLEAR_WEIGHT)
            || self.testimony.inside(self.component).count() < contradictions.len()
        {
            return None;
        }
        let mut pairs = contradictions.iter().map(|c| [c.pair.a, c.pair.b]);
        let first = pairs.next()?;
        let others: Vec<[ScanKey; 2]> = pairs.collect();
        first.into_iter().find(|scan| others.iter().all(|pair| pair.contains(scan)))
    }

    /// A side that belongs elsewhere.
    fn torn(&self, side: BTreeSet<ScanKey>) -> Finding {
        match self.shown_by(&side).or_else(|| self.testimony.contradictions.first().copied()) {
            Some(strongest) => Finding::Torn { side: smaller_side(self.component, side), strongest },
            None => Finding::Sound,
        }
    }

    /// Whether nothing that a hearing does not refute would be said any more if these scans were moved. Where there are more alike places
    /// than two, one move does not put them right.
    fn settles(
        &self,
        asked: &Component,
        scans: &BTreeSet<ScanKey>,
        motion: &Pose,
        waits: &BTreeSet<ScanKey>,
        control: Control<'_>,
    ) -> Result<bool, Cancelled> {
        let moved = |(scan, pose): (&ScanKey, &Pose)| {
            (*scan, if scans.contains(scan) { *motion * *pose } else { *pose })
        };
        let poses = asked.poses.iter().map(moved).collect();
        let there = Component { gauge: asked.gauge, poses, tracks: Tracks::default() };
        let mut testimony = testimony(self.graph, &there, self.options);
        testimony.cross_examine(self.graph, &there, waits, self.options, control)?;
        Ok(!testimony.condemns())
    }

    /// Where the component comes apart: a cut between two contradicting scans, or between several, that what speaks against it with one voice outweighs by this share
    /// of its support, unless a hearing refutes that voice; by its smaller side, and the pair that shows it.
    fn tear(
        &self,
        share: f64,
        control: Control<'_>,
    ) -> Result<Option<(BTreeSet<ScanKey>, Contradiction)>, Cancelled> {
        let Self { graph, component, supports, testimony, options } = *self;
        let inside: Vec<&Contradiction> = testimony.inside(component).collect();
        let mut hearing: Option<Hearing<'_>> = None;
        let mut refuted: BTreeSet<BTreeSet<ScanKey>> = BTreeSet::new();
        let single = |c: &&Contradiction| separating_cut(component, supports, &[c.pair.a], &[c.pair.b]);
        let singles = inside.iter().take(TRIED).filter_map(|c| Some((single(c)?, *c)));
        // Where they fail, all; the first of these is known.
        let gathered = std::iter::once(()).flat_map(|()| self.gathered(&inside)).skip(1);
        for ((side, support), strongest) in singles.chain(gathered) {
            control.check()?;
            let smaller = smaller_side(component, side.clone());
            if refuted.contains(&smaller) {
                continue;
            }
            let words = Word::on_side(graph, component, &side, &inside, options);
            let against = one_voice(&words, options.rival_angle);
            if against.pairs < AGAINST_PAIRS || against.evidence < share * support {
                continue;
            }
            if hearing.is_none() {
                hearing = Some(Hearing::open(graph, component, control)?);
            }
            let voice = loudest(&words, options.rival_angle);
            if let Some(hearing) = &hearing
                && hearing.hear(&voice, &BTreeSet::new(), options, control)? == Ruling::Refuted
            {
                refuted.insert(smaller);
                continue;
            }
            return Ok(Some((smaller, *strongest)));
        }
        Ok(None)
    }

    /// Cuts that separate more and more of the scans that contradict each other, the strongest first, each the way that costs less: between
    /// two of them alone, a place that hangs by less may be nearer than the one that they mean.
    fn gathered<'c>(
        &self,
        inside: &[&'c Contradiction],
    ) -> Vec<((BTreeSet<ScanKey>, f64), &'c Contradiction)> {
        let mut sides: [Vec<ScanKey>; 2] = Default::default();
        let mut cuts = Vec::new();
        for c in inside.iter().take(TRIED) {
            let ways = [[c.pair.a, c.pair.b], [c.pair.b, c.pair.a]].map(|way| {
                let mut ends = sides.clone();
                for (end, scan) in ends.iter_mut().zip(way) {
                    end.push(scan);
                }
                let cut = separating_cut(self.component, self.supports, &ends[0], &ends[1])?;
                Some((cut, ends))
            });
            let cheapest = ways.into_iter().flatten().min_by(|x, y| x.0.1.total_cmp(&y.0.1));
            if let Some((cut, ends)) = cheapest {
                sides = ends;
                cuts.push((cut, inside[0]));
            }
        }
        cuts
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::consistency::supports;
    use crate::mapping::test_hall::Model;
    use crate::mapping::voice::Voice;
    use crate::pairwise::PairKey;

    #[test]
    fn scans_settle_where_everybody_says_they_belong() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let settles = |component: &Component| {
            let said = testimony(&model.graph, component, &options);
            let case = Case {
                graph: &model.graph,
                component,
                supports: &supports(&model.graph, component, &options),
                testimony: &said,
                options: &options,
            };
            let turned = BTreeSet::from([ScanKey(5)]);
            case.settles(component, &turned, &model.hall.turned, &BTreeSet::new(), control)
        };
        // Half a turn is its own inverse.
        assert_eq!(settles(&model.with_turned(&[5])), Ok(true));
        assert_eq!(settles(&model.component), Ok(false));
        assert_eq!(settles(&model.with_turned(&[4, 5])), Ok(false), "scan 4 is still at the wrong end");
    }

    #[test]
    fn a_scan_that_all_contradictions_are_of_is_suspected_unless_they_weigh_much() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let suspect = |pairs: &[(u128, u128)], agreeing: usize| {
            let contradictions = pairs.iter().map(|&(a, b)| Contradiction {
                pair: PairKey::of(ScanKey(a), ScanKey(b)),
                ..model.contradiction((1, 2), false)
            });
            let contradictions = contradictions.collect();
            let voice = Voice { pairs: pairs.len(), evidence: 4.0 * pairs.len() as f64 };
            let testimony = Testimony { agreeing, contradictions, voice, ruling: Some(Ruling::Believable) };
            assert!(testimony.condemns(), "{pairs:?}, {agreeing}");
            let case = Case {
                graph: &model.graph,
                component: &model.component,
                supports: &BTreeMap::new(),
                testimony: &testimony,
                options: &options,
            };
            case.suspect()
        };
        assert_eq!(suspect(&[(1, 5), (2, 5)], 112), Some(ScanKey(5)));
        assert_eq!(suspect(&[(1, 5), (2, 5)], 70), None, "of fewer witnesses it is much");
        assert_eq!(suspect(&[(1, 5), (2, 5), (3, 5)], 112), None, "three say much");
        assert_eq!(suspect(&[(1, 5), (2, 4)], 112), None, "either may be wrong, or the rest");
        assert_eq!(suspect(&[(1, 5), (2, 5), (3, 4)], 180), None);
        assert_eq!(suspect(&[(1, 5), (7, 5)], 112), None, "one of them is of a scan that waits");
    }

    #[test]
    fn all_that_contradict_are_separated_where_two_of_them_would_be_elsewhere() {
        let model = Model::new(6);
        let options = MappingOptions::default();
        let key = |pair: (u128, u128)| (ScanKey(pair.0), ScanKey(pair.1));
        // A chain: 4 to 6 hang on 1, wrongly, by more than 2 and 3 do.
        let chain = [((1, 2), 7.5), ((2, 3), 16.0), ((1, 4), 8.5), ((4, 5), 16.0), ((5, 6), 16.0)];
        let supports = chain.map(|(pair, support)| (key(pair), support)).into();
        let said = [model.contradiction((3, 5), false), model.contradiction((1, 5), false)];
        let case = Case {
            graph: &model.graph,
            component: &model.component,
            supports: &supports,
            testimony: &Testimony::default(),
            options: &options,
        };
        let found = case.gathered(&said.iter().collect::<Vec<_>>());
        let sides: Vec<Vec<u128>> =
            found.iter().map(|((side, _), _)| side.iter().map(|scan| scan.0).collect()).collect();
        assert_eq!(sides, [vec![2, 3], vec![1, 2, 3]]);
        let supports = found.iter().map(|((_, support), _)| *support);
        assert!(supports.zip([7.5, 8.5]).all(|(found, right)| (found - right).abs() < 1e-9));
    }
}
