//! Fast point feature histograms (Rusu, Blodow, Beetz: "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009),
//! in the Hellinger form: square-rooted and normalised, so that the dot product of two descriptors is the
//! Bhattacharyya coefficient of their histograms, between 0 and 1.

use multiversion::multiversion;
use rayon::prelude::*;

use crate::geometry::{NeighborIndex, Point};

const BINS: usize = 11;
/// Numbers in a descriptor: three histograms of eleven bins.
pub const DESCRIPTOR_LEN: usize = 3 * BINS;

/// One descriptor, of unit length.
pub type Descriptor = [f32; DESCRIPTOR_LEN];

/// The descriptors of all points, from neighbours within `radius` metres. `normals` are unit vectors that face the sensor,
/// one a point. A point without neighbours gets the zero descriptor, which matches nothing.
#[must_use]
pub fn fpfh(points: &[Point], normals: &[Point], radius: f32) -> Vec<Descriptor> {
    let index = NeighborIndex::new(points, radius);
    let neighborhoods: Vec<Vec<(u32, f32)>> = index.map(points, radius, |me, around, near: &mut Vec<_>| {
        near.clear();
        around.within(&points[me], |other, square| {
            if other != me && square > 0.0 {
                near.push((other as u32, square));
            }
        });
        near.clone()
    });
    let simple = simplified_histograms(&neighborhoods, points, normals);
    neighborhoods
        .par_iter()
        .enumerate()
        .map(|(me, near)| {
            let mut sum = weighted_sum(near, &simple);
            normalise_histograms(&mut sum);
            for (total, x) in sum.iter_mut().zip(&simple[me]) {
                *total += x;
            }
            hellinger(sum)
        })
        .collect()
}

/// The sum of the neighbours' histograms, each weighted by its inverse squared distance.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn weighted_sum(near: &[(u32, f32)], simple: &[Descriptor]) -> Descriptor {
    let mut sum = [0.0; DESCRIPTOR_LEN];
    for &(other, square) in near {
        let weight = 1.0 / square;
        for (total, x) in sum.iter_mut().zip(&simple[other as usize]) {
            *total += weight * x;
        }
    }
    sum
}

/// The SPFH of all points: angles between the normals of each and of its neighbours and the lines between them. Two neighbours have
/// the same angles, whichever is asked, so these are computed once.
fn simplified_histograms(
    neighborhoods: &[Vec<(u32, f32)>],
    points: &[Point],
    normals: &[Point],
) -> Vec<Descriptor> {
    let later = |me: usize| neighborhoods[me].iter().filter(move |(other, _)| *other as usize > me);
    let pairs: Vec<Vec<Bins>> = (0..neighborhoods.len())
        .into_par_iter()
        .map_init(Vec::new, |near, me| {
            near.clear();
            near.extend(later(me));
            pair_bins_with(me, near, points, normals)
        })
        .collect();
    // The last entry takes what has no angles.
    let mut counts = vec![[0_u32; DESCRIPTOR_LEN + 1]; points.len()];
    for (me, pairs) in pairs.iter().enumerate() {
        for ((other, _), bins) in later(me).zip(pairs) {
            for bin in bins {
                counts[me][*bin as usize] += 1;
                counts[*other as usize][*bin as usize] += 1;
            }
        }
    }
    let histogram = |counts: &[u32; DESCRIPTOR_LEN + 1]| {
        let mut histogram = std::array::from_fn(|k| counts[k] as f32);
        normalise_histograms(&mut histogram);
        histogram
    };
    counts.par_iter().map(histogram).collect()
}

/// The bins of a point's angles with each of some neighbours.
fn pair_bins_with(me: usize, near: &[(u32, f32)], points: &[Point], normals: &[Point]) -> Vec<Bins> {
    let mut block = Neighbors::default();
    let mut found = Vec::with_capacity(near.len());
    for near in near.chunks(LANES) {
        for (lane, &(other, square)) in near.iter().enumerate() {
            let other = other as usize;
            for k in 0..3 {
                block.offset[k][lane] = points[other][k] - points[me][k];
                block.normal[k][lane] = normals[other][k];
            }
            block.square[lane] = square;
        }
        pair_bins(&normals[me], &mut block);
        let bins = |lane: usize| std::array::from_fn(|part| block.bins[part][lane] as u8);
        found.extend((0..near.len()).map(bins));
    }
    found
}

/// The numbers of the descriptor that the three angles of a pair fall into, or [`DESCRIPTOR_LEN`] for none.
type Bins = [u8; 3];

/// Neighbours of a point that are taken together.
const LANES: usize = 16;

/// Some neighbours of a point, one array a coordinate.
#[derive(Default)]
struct Neighbors {
    /// From the point to them, metres.
    offset: [[f32; LANES]; 3],
    /// Square of that distance, square metres.
    square: [f32; LANES],
    normal: [[f32; LANES]; 3],
    /// The result: [`Bins`] of each.
    bins: [[u32; LANES]; 3],
}

/// The three angles of a Darboux frame, of each neighbour, as bins. The point whose normal is closer to the line between
/// both is the source, as in the paper.
///
/// With d the unit line from source to target, u the source's normal and t the target's, v = d x u / |d x u| and w = u x v: the
/// angles are v . t, d . u, and atan2(w . t, u . t). The triple product in v . t is the same whichever point is the source.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn pair_bins(mine: &Point, block: &mut Neighbors) {
    let [mx, my, mz] = *mine;
    let ([ox, oy, oz], [nx, ny, nz]) = (&block.offset, &block.normal);
    for k in 0..LANES {
        let inverse = 1.0 / block.square[k].sqrt();
        let (dx, dy, dz) = (ox[k] * inverse, oy[k] * inverse, oz[k] * inverse);
        let along_mine = mx * dx + my * dy + mz * dz;
        let along_other = nx[k] * dx + ny[k] * dy + nz[k] * dz;
        let from_mine = along_mine.abs() >= along_other.abs();
        let (phi, along_target) =
            if from_mine { (along_mine, along_other) } else { (-along_other, -along_mine) };
        let (ux, uy, uz) = if from_mine { (mx, my, mz) } else { (nx[k], ny[k], nz[k]) };
        let (vx, vy, vz) = (dy * uz - dz * uy, dz * ux - dx * uz, dx * uy - dy * ux);
        let length = (vx * vx + vy * vy + vz * vz).sqrt();
        let triple = (dy * mz - dz * my) * nx[k] + (dz * mx - dx * mz) * ny[k] + (dx * my - dy * mx) * nz[k];
        let between = mx * nx[k] + my * ny[k] + mz * nz[k];
        // w . t = (d - u (d . u)) . t / |d x u|
        let theta = half_turns((along_target - phi * between) / length, between);
        let determined = length >= 1e-6;
        let angles = [triple / length, phi, theta];
        for (part, angle) in angles.into_iter().enumerate() {
            let bin = (part * BINS) as u32 + bin(angle);
            block.bins[part][k] = if determined { bin } else { DESCRIPTOR_LEN as u32 };
        }
    }
}

/// The bin of a value in [-1, 1].
#[inline]
fn bin(value: f32) -> u32 {
    ((value + 1.0) * 0.5 * BINS as f32).clamp(0.0, BINS as f32 - 1.0) as u32
}

/// atan2(y, x) / pi to within 1e-6, in arithmetic that runs on many numbers at once.
#[inline]
fn half_turns(y: f32, x: f32) -> f32 {
    // A polynomial of atan(r) / (pi r) in the square of r, whose largest error on [0, 1] is the least possible.
    const ARCTANGENT: [f32; 8] = [
        0.318_309_66,
        -0.106_092_244,
        0.063_491_89,
        -0.044_272_542,
        0.030_692_069,
        -0.017_797_446,
        0.006_959_195,
        -0.001_290_608_4,
    ];
    let (ax, ay) = (x.abs(), y.abs());
    let (low, high) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let ratio = if high > 0.0 { low / high } else { 0.0 };
    let square = ratio * ratio;
    let mut value = ARCTANGENT[7];
    for coefficient in ARCTANGENT[..7].iter().rev() {
        value = value * square + coefficient;
    }
    let first = value * ratio;
    let steep = if ax < ay { 0.5 - first } else { first };
    let upper = if x < 0.0 { 1.0 - steep } else { steep };
    if y < 0.0 { -upper } else { upper }
}

fn normalise_histograms(descriptor: &mut Descriptor) {
    for part in descriptor.chunks_exact_mut(BINS) {
        let sum: f32 = part.iter().sum();
        if sum > 0.0 {
            for x in part {
                *x /= sum;
            }
        }
    }
}

fn hellinger(descriptor: Descriptor) -> Descriptor {
    let root = descriptor.map(f32::sqrt);
    let norm = root.iter().map(|x| x * x).sum::<f32>().sqrt();
    if norm > 0.0 { root.map(|x| x / norm) } else { root }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use nalgebra::{Rotation3, Vector3};

    /// A wavy surface with its exact normals.
    fn surface() -> (Vec<Point>, Vec<Point>) {
        (0..900)
            .map(|i| {
                let (x, y) = ((i % 30) as f32 * 0.05, (i / 30) as f32 * 0.05);
                let (dx, dy) = (0.6 * (3.0 * x).cos(), -0.4 * (2.0 * y).sin());
                let n = Vector3::new(-dx, -dy, 1.0).normalize();
                ([x, y, 0.2 * (3.0 * x).sin() + 0.2 * (2.0 * y).cos()], [n.x, n.y, n.z])
            })
            .unzip()
    }

    #[test]
    fn descriptors_have_unit_length_and_do_not_change_under_a_rigid_motion() {
        let (points, normals) = surface();
        let pose = Pose::new(Rotation3::new(Vector3::new(0.3, -1.0, 2.0)), Vector3::new(4.0, 5.0, -6.0));
        let spin = Pose::new(pose.rotation, Vector3::zeros());
        let moved: Vec<Point> = points.iter().map(|&p| pose.transform_point(p)).collect();
        let turned: Vec<Point> = normals.iter().map(|&n| spin.transform_point(n)).collect();
        let before = fpfh(&points, &normals, 0.25);
        let after = fpfh(&moved, &turned, 0.25);
        for (a, b) in before.iter().zip(&after) {
            let same: f32 = a.iter().zip(b).map(|(x, y)| x * y).sum();
            assert!((a.iter().map(|x| x * x).sum::<f32>() - 1.0).abs() < 1e-5);
            assert!(same > 0.98, "{same}");
        }
    }

    #[test]
    fn angles_are_angles() {
        for i in 0..720 {
            let angle = f64::from(i).to_radians() * 0.5 - std::f64::consts::PI + 0.001;
            let found = half_turns(3.0 * angle.sin() as f32, 3.0 * angle.cos() as f32);
            assert!((f64::from(found) - angle / std::f64::consts::PI).abs() < 1e-6, "{angle}");
        }
        assert_eq!(half_turns(0.0, 0.0), 0.0);
    }

    #[test]
    fn the_bins_are_those_of_the_darboux_frame() {
        let mine = Vector3::<f32>::new(0.1, 0.2, 0.97).normalize();
        let other = Vector3::<f32>::new(-0.4, 0.3, 0.8).normalize();
        let line = Vector3::<f32>::new(0.3, -0.1, 0.05);
        // The other normal is closer to the line, so that point is the source and the line runs from it to the first.
        let (u, target, d) = (other, mine, -line.normalize());
        assert!(u.dot(&d).abs() > target.dot(&d).abs());
        let v = d.cross(&u).normalize();
        let w = u.cross(&v);
        let theta = w.dot(&target).atan2(u.dot(&target)) / std::f32::consts::PI;
        let expected = [v.dot(&target), u.dot(&d), theta].map(bin);

        let mut block = Neighbors::default();
        for k in 0..3 {
            block.offset[k][0] = line[k];
            block.normal[k][0] = other[k];
        }
        block.square[0] = line.norm_squared();
        pair_bins(&mine.into(), &mut block);
        let found: [u32; 3] = std::array::from_fn(|k| block.bins[k][0] - (k * BINS) as u32);
        assert_eq!(found, expected);
    }

    #[test]
    fn a_lonely_point_has_the_zero_descriptor() {
        assert_eq!(fpfh(&[[0.0; 3]], &[[0.0, 0.0, 1.0]], 1.0), vec![[0.0; DESCRIPTOR_LEN]]);
    }
}
