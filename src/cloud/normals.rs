//! Surface normals by principal components of neighbourhoods.

use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::geometry::{NeighborIndex, Point};

/// Fewest neighbours that give a plane.
const MIN_NEIGHBORS: usize = 6;
/// Radii tried in turn, as multiples of the first: sparse parts of a scan need a wider look.
const WIDENING: [f32; 3] = [1.0, 1.5, 2.25];

/// The unit normal at each of `at`, from the points of `index` (made of `cloud`) within `radius` metres, or `None`
/// where too few points are near or they lie on a line. The sign is arbitrary: see [`face`].
#[must_use]
pub fn normals(at: &[Point], cloud: &[Point], index: &NeighborIndex, radius: f32) -> Vec<Option<Point>> {
    at.par_iter()
        .map(|point| WIDENING.iter().find_map(|widening| normal(point, cloud, index, radius * widening)))
        .collect()
}

fn normal(at: &Point, cloud: &[Point], index: &NeighborIndex, radius: f32) -> Option<Point> {
    let mut count = 0_usize;
    let mut sum = [0.0_f64; 3];
    let mut products = [0.0_f64; 6];
    index.within(at, radius, |neighbor, _| {
        let d: [f64; 3] = std::array::from_fn(|k| f64::from(cloud[neighbor][k]) - f64::from(at[k]));
        count += 1;
        for k in 0..3 {
            sum[k] += d[k];
        }
        products[0] += d[0] * d[0];
        products[1] += d[0] * d[1];
        products[2] += d[0] * d[2];
        products[3] += d[1] * d[1];
        products[4] += d[1] * d[2];
        products[5] += d[2] * d[2];
    });
    if count < MIN_NEIGHBORS {
        return None;
    }
    let n = count as f64;
    let entry = |product: f64, i: usize, j: usize| product / n - sum[i] / n * sum[j] / n;
    let (xy, xz, yz) = (entry(products[1], 0, 1), entry(products[2], 0, 2), entry(products[4], 1, 2));
    #[rustfmt::skip]
    let covariance = Matrix3::new(
        entry(products[0], 0, 0), xy, xz,
        xy, entry(products[3], 1, 1), yz,
        xz, yz, entry(products[5], 2, 2),
    );
    let eigen = covariance.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [smallest, middle, largest] = order.map(|k| eigen.eigenvalues[k]);
    // On a line the two smaller spreads vanish alike and the normal is free to spin.
    if !(middle > 1e-3 * largest && middle > 1.5 * smallest.max(0.0)) {
        return None;
    }
    let normal = eigen.eigenvectors.column(order[0]);
    Some([normal[0] as f32, normal[1] as f32, normal[2] as f32])
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
        let found = normals(&plane[55..56], &plane, &index, 0.06)[0].expect("a plane");
        assert!(found[2].abs() > 0.9999);
        assert!(face(found, &plane[55], &[0.0, 0.0, 0.0])[2] < 0.0);

        let line: Vec<Point> = (0..100).map(|i| [i as f32 * 0.01, 0.0, 1.0]).collect();
        assert_eq!(normals(&line[50..51], &line, &NeighborIndex::new(&line, 0.06), 0.06), vec![None]);
    }
}
