//! Whether scans bear out how two pieces of a component lie, beside the one that joined them. Two pieces that belong elsewhere share what misled
//! that scan, such as a floor and two walls; where they lie right, scans meet that no pair was sure of, and their surfaces coincide. Used by
//! `parting`.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::component::Component;
use super::cuts::Glimpse;
use super::surfaces::{coarse_overlap_of_either, may_overlap};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::{Counts, look_finely};

/// Scans meet if they share this much.
const SHARED: f64 = 0.05;
/// Pairs that are looked at finely, those that share most.
const LOOKS: usize = 32;
/// The pieces are borne out if this many of them meet, …
const PAIRS: usize = 3;
/// … of this many scans at least on either side, …
const SCANS: usize = 2;
/// … and put no more than this share of what can be judged into free space, all together: of a lab of depth cameras that lies right, 0.06 to 0.08 % is
/// there. Of ten such pieces of simulated houses, whose views are few, none has pairs enough to tell.
const MOST_VIOLATION: f64 = 0.005;

/// Whether pairs of a piece and of what the scan that sees it is of bear out how these lie, those of that scan aside. Where there are no fine
/// surfaces, none does.
pub fn borne_out(
    graph: &ScanGraph,
    component: &Component,
    glimpse: &Glimpse,
    control: Control<'_>,
) -> Result<bool, Cancelled> {
    let Glimpse { scan, own, piece } = glimpse;
    let others = || own.iter().filter(|other| *other != scan);
    let pairs: Vec<(ScanKey, ScanKey)> = piece.iter().flat_map(|x| others().map(move |y| (*x, *y))).collect();
    let shares = |&(x, y): &(ScanKey, ScanKey)| {
        control.check()?;
        let (Some(from_x), Some(from_y)) = (component.poses.get(&x), component.poses.get(&y)) else {
            return Ok(None);
        };
        let (Some(scan_x), Some(scan_y)) = (graph.scan(x), graph.scan(y)) else { return Ok(None) };
        if !may_overlap(scan_x, from_x, scan_y, from_y) {
            return Ok(None);
        }
        let x_from_y = from_x.inverse() * *from_y;
        let share = coarse_overlap_of_either(scan_x, scan_y, &x_from_y);
        Ok((share >= SHARED).then_some((share, x, y, x_from_y)))
    };
    let meeting = pairs.par_iter().map(shares).collect::<Result<Vec<_>, Cancelled>>()?;
    let mut meeting: Vec<_> = meeting.into_iter().flatten().collect();
    meeting.sort_by(|p, q| q.0.total_cmp(&p.0).then((p.1, p.2).cmp(&(q.1, q.2))));
    meeting.truncate(LOOKS);
    let look = |(_, x, y, x_from_y): &(f64, ScanKey, ScanKey, Pose)| {
        control.check()?;
        let counts = graph.scan(*x).zip(graph.scan(*y)).and_then(|(x, y)| look_finely(x, y, x_from_y));
        Ok(counts.filter(|counts| counts.overlap() >= SHARED).map(|counts| (*x, *y, counts)))
    };
    let seen = meeting.par_iter().map(look).collect::<Result<Vec<_>, Cancelled>>()?;
    let seen: Vec<(ScanKey, ScanKey, Counts)> = seen.into_iter().flatten().collect();
    let scans =
        |of: fn(&(ScanKey, ScanKey, Counts)) -> ScanKey| seen.iter().map(of).collect::<BTreeSet<_>>().len();
    let together = seen.iter().fold(Counts::default(), |sum, (_, _, counts)| sum.plus(counts));
    Ok(seen.len() >= PAIRS
        && scans(|pair| pair.0) >= SCANS
        && scans(|pair| pair.1) >= SCANS
        && together.violation_share() <= MOST_VIOLATION)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::mapping::test_hall::Model;

    #[test]
    fn scans_that_meet_bear_out_how_pieces_lie_unless_they_stand_in_free_space() {
        let model = Model::new(6);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let piece = BTreeSet::from([5, 6].map(ScanKey));
        let glimpse = Glimpse {
            scan: ScanKey(4),
            own: BTreeSet::from([1, 2, 3, 4].map(ScanKey)),
            piece: piece.clone(),
        };
        let asked = |graph: &ScanGraph, component: &Component| borne_out(graph, component, &glimpse, control);
        assert_eq!(asked(&model.graph, &model.component), Ok(true));
        assert_eq!(asked(&model.coarse(), &model.component), Ok(false), "nothing is seen finely");
        let moved = |off: f64| {
            let mut wrong = model.component.clone();
            for scan in &piece {
                let pose = wrong.poses.get_mut(scan).expect("a scan of the hall");
                *pose = Pose::from_translation(Vector3::new(off, 0.75 * off, 0.0)) * *pose;
            }
            wrong
        };
        assert_eq!(asked(&model.graph, &moved(2.0)), Ok(false), "walls stand in free space");
        assert_eq!(asked(&model.graph, &moved(500.0)), Ok(false), "nothing meets");
        let (lone, three) = (BTreeSet::from([1, 2].map(ScanKey)), BTreeSet::from([3, 4, 5].map(ScanKey)));
        let seen_by_one = Glimpse { scan: ScanKey(2), own: lone, piece: three };
        let said = borne_out(&model.graph, &model.component, &seen_by_one, control);
        assert_eq!(said, Ok(false), "three pairs of one scan are no independent witnesses");
        token.cancel();
        assert_eq!(asked(&model.graph, &model.component), Err(Cancelled));
    }
}
