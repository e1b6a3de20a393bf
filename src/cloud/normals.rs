//! Surface normals by principal components of neighbourhoods.

use crate::geometry::{Moments, NeighborIndex, Point, Spread};

/// Fewest neighbours that give a plane.
const MIN_NEIGHBORS: u32 = 6;
/// Radii that are tried in turn, as multiples of the one asked for: sparse parts of a scan need a wider look.
const WIDENING: [f32; 3] = [1.0, 1.5, 2.25];

/// The unit normal at each of `at`, from the points of `index` within `radius` metres, or `None`
/// where too few points are near or they lie on a line. The sign is arbitrary: see [`face`].
#[must_use]
pub fn normals(at: &[Point], index: &NeighborIndex, radius: f32) -> Vec<Option<Point>> {
    let mut normals = vec![None; at.len()];
    let mut without: Vec<usize> = (0..at.len()).collect();
    for widening in WIDENING {
        let places: Vec<Point> = without.iter().map(|place| at[*place]).collect();
        let found = index.map_moments(&places, radius * widening, |near| {
            near.iter().zip(Spread::of_all(near)).map(|(near, spread)| normal(near, &spread)).collect()
        });
        for (place, normal) in without.iter().zip(found) {
            normals[*place] = normal;
        }
        without.retain(|place| normals[*place].is_none());
    }
    normals
}

fn normal(near: &Moments, spread: &Spread) -> Option<Point> {
    let Spread { values: [smallest, middle, largest], least } = spread;
    // On a line the two smaller spreads vanish alike and the normal is free to spin.
    let is_plane = *middle > 1e-3 * largest && *middle > 1.5 * smallest.max(0.0);
    (near.count >= MIN_NEIGHBORS && is_plane).then(|| least.cast().into())
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
    fn sparse_surfaces_have_normals_and_each_place_its_own() {
        // Squares that face along x, y and z, with more than five points within one, one and a half, and two and a quarter times the radius.
        let square = |axis: usize, spacing: f32| {
            (0..49).map(move |i| {
                let mut point = [10.0 * axis as f32; 3];
                point[(axis + 1) % 3] += (i % 7) as f32 * spacing;
                point[(axis + 2) % 3] += (i / 7) as f32 * spacing;
                point
            })
        };
        let mut points: Vec<Point> =
            [0.02, 0.05, 0.075].into_iter().enumerate().flat_map(|(k, s)| square(k, s)).collect();
        points.push([50.0; 3]);
        let index = NeighborIndex::new(&points, 0.06);
        let places = [points[24], points[147], points[73], points[122], points[25]];
        let found = normals(&places, &index, 0.06);
        let axis = |normal: &Option<Point>| normal.map(|n| (0..3).find(|k| n[*k].abs() > 0.9999));
        let axes: Vec<_> = found.iter().map(axis).collect();
        assert_eq!(axes, [Some(Some(0)), None, Some(Some(1)), Some(Some(2)), Some(Some(0))]);
    }

    #[test]
    fn a_plane_has_its_own_normal_and_a_line_has_none() {
        let plane: Vec<Point> =
            (0..100).map(|i| [(i % 10) as f32 * 0.02, (i / 10) as f32 * 0.02, 1.0]).collect();
        let index = NeighborIndex::new(&plane, 0.06);
        let found = normals(&plane[55..56], &index, 0.06)[0].expect("a plane");
        assert!(found[2].abs() > 0.9999);
        assert!(face(found, &plane[55], &[0.0, 0.0, 0.0])[2] < 0.0);

        assert_eq!(normals(&[[5.0; 3]], &index, 0.06), vec![None], "nothing is near");

        let line: Vec<Point> = (0..100).map(|i| [i as f32 * 0.01, 0.0, 1.0]).collect();
        assert_eq!(normals(&line[50..51], &NeighborIndex::new(&line, 0.06), 0.06), vec![None]);
    }
}
