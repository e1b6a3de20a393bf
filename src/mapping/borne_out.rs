//! Whether scans bear out how two pieces of a component lie, beside the one that joined them. Two pieces that belong elsewhere share what misled
//! that scan, such as a floor and two walls; where they lie right, scans meet that no pair was sure of, and their surfaces coincide. Used by
//! `parting`.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::component::Component;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::graph::ScanGraph;
use crate::pairwise::{Counts, look_finely, quick_overlap};

/// Scans meet if they share this much, …
const SHARED: f64 = 0.05;
/// … which so many points of one are asked for at first.
const QUICK_POINTS: usize = 500;
/// The pieces are borne out if this many pairs meet, …
const PAIRS: usize = 3;
/// … of as many scans at least on either side, …
const SCANS: usize = 2;
/// … and put no more than this share of what can be judged into free space, all together: a tenth of it where a lab lies right, several times as
/// much where it does not.
const MOST_VIOLATION: f64 = 0.005;

/// Whether pairs of a piece with the rest of its component bear out how these lie, those of the scan that joined them (`hinge`) aside. Where
/// there are no fine surfaces, none does.
pub fn borne_out(
    graph: &ScanGraph,
    component: &Component,
    piece: &BTreeSet<ScanKey>,
    hinge: ScanKey,
    control: Control<'_>,
) -> Result<bool, Cancelled> {
    let (inside, outside): (Vec<ScanKey>, Vec<ScanKey>) =
        component.poses.keys().filter(|scan| **scan != hinge).partition(|scan| piece.contains(scan));
    let pairs: Vec<(ScanKey, ScanKey)> =
        inside.iter().flat_map(|x| outside.iter().map(move |y| (*x, *y))).collect();
    let look = |&(x, y): &(ScanKey, ScanKey)| {
        control.check()?;
        Ok(meeting(graph, component, x, y).map(|counts| (x, y, counts)))
    };
    let found = pairs.par_iter().map(look).collect::<Result<Vec<_>, Cancelled>>()?;
    let found: Vec<(ScanKey, ScanKey, Counts)> = found.into_iter().flatten().collect();
    let scans =
        |of: fn(&(ScanKey, ScanKey, Counts)) -> ScanKey| found.iter().map(of).collect::<BTreeSet<_>>().len();
    let together = found.iter().fold(Counts::default(), |sum, (_, _, counts)| sum.plus(counts));
    Ok(found.len() >= PAIRS
        && scans(|pair| pair.0) >= SCANS
        && scans(|pair| pair.1) >= SCANS
        && together.violation_share() <= MOST_VIOLATION)
}

/// What a fine look at two scans tells, if they meet.
fn meeting(graph: &ScanGraph, component: &Component, x: ScanKey, y: ScanKey) -> Option<Counts> {
    let x_from_y = component.poses.get(&x)?.inverse() * *component.poses.get(&y)?;
    let (x, y) = (graph.scan(x)?, graph.scan(y)?);
    let stride = y.prepared.points.len().div_ceil(QUICK_POINTS).max(1);
    let asked = y.prepared.points.len().div_ceil(stride);
    if (quick_overlap(x, y, &x_from_y, stride) as f64) < 0.5 * SHARED * asked as f64 {
        return None;
    }
    look_finely(x, y, &x_from_y).filter(|counts| counts.overlap() >= SHARED)
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::control::{CancelToken, Silent};
    use crate::geometry::Pose;
    use crate::mapping::test_hall::Model;

    #[test]
    fn scans_that_meet_bear_out_how_pieces_lie_unless_they_stand_in_free_space() {
        let model = Model::new(6);
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let (piece, hinge) = (BTreeSet::from([5, 6].map(ScanKey)), ScanKey(4));
        let asked =
            |graph: &ScanGraph, component: &Component| borne_out(graph, component, &piece, hinge, control);
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
        let mut few = model.component.clone();
        few.poses.retain(|scan, _| piece.contains(scan) || *scan == hinge || *scan == ScanKey(1));
        assert_eq!(asked(&model.graph, &few), Ok(false), "one scan is no witness");
        token.cancel();
        assert_eq!(asked(&model.graph, &model.component), Err(Cancelled));
    }
}
