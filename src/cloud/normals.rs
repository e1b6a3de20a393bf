//! Surface normals by principal components of neighbourhoods.

use crate::geometry::{Moments, NeighborIndex, Point, Spread, Surroundings};

/// Fewest neighbours that give a plane.
const MIN_NEIGHBORS: usize = 6;
/// Wider radii that are tried in turn, as multiples of the first: sparse parts of a scan need a wider look.
const WIDENING: [f32; 2] = [1.5, 2.25];

/// The unit normal at each of `at`, from the points of `index` within `radius` metres, or `None`
/// where too few points are near or they lie on a line. The sign is arbitrary: see [`face`].
#[must_use]
pub fn normals(at: &[Point], index: &NeighborIndex, radius: f32) -> Vec<Option<Point>> {
    index.map(at, radius, |query, around, spare: &mut Surroundings| {
        let place = &at[query];
        let mut wider =
            |widening: &f32| normal(&spare.gather(index, [place], radius * widening).moments(place));
        normal(&around.moments(place)).or_else(|| WIDENING.iter().find_map(&mut wider))
    })
}

fn normal(near: &Moments) -> Option<Point> {
    if near.count < MIN_NEIGHBORS {
        return None;
    }
    let Spread { values: [smallest, middle, largest], least } = Spread::of(near);
    // On a line the two smaller spreads vanish alike and the normal is free to spin.
    if !(middle > 1e-3 * largest && middle > 1.5 * smallest.max(0.0)) {
        return None;
    }
    Some(least.cast().into())
}

/// Turns `normal` so that it faces `viewpoint` as seen from `at`.
#[must_use]
pub fn face(normal: Point, at: &Point, viewpoint: &Point) -> Point {
    let toward: f32 = (0..3).map(|k| normal[k] * (viewpoint[k] - at[k])).sum();
    if toward < 0.0 { normal.map(|x| -x) } else { normal }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_has_its_own_normal_and_a_line_has_none() {
        let plane: Vec<Point> =
            (0..100).map(|i| [(i % 10) as f32 * 0.02, (i / 10) as f32 * 0.02, 1.0]).collect();
        let index = NeighborIndex::new(&plane, 0.06);
        let found = normals(&plane[55..56], &index, 0.06)[0].expect("a plane");
        assert!(found[2].abs() > 0.9999);
        assert!(face(found, &plane[55], &[0.0, 0.0, 0.0])[2] < 0.0);

        let line: Vec<Point> = (0..100).map(|i| [i as f32 * 0.01, 0.0, 1.0]).collect();
        assert_eq!(normals(&line[50..51], &NeighborIndex::new(&line, 0.06), 0.06), vec![None]);
    }
}
