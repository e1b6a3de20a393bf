//! Fast point feature histograms (Rusu, Blodow, Beetz: "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009),
//! in the Hellinger form: square-rooted and normalised, so that the dot product of two descriptors is the
//! Bhattacharyya coefficient of their histograms, between 0 and 1.

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
    let index = NeighborIndex::new(points);
    let neighborhoods: Vec<Vec<(u32, f32)>> = points
        .par_iter()
        .enumerate()
        .map(|(me, point)| {
            let mut near = Vec::with_capacity(128);
            index.within(point, radius, |other, square| {
                if other != me && square > 0.0 {
                    near.push((other as u32, square));
                }
            });
            near
        })
        .collect();
    let simple: Vec<Descriptor> = neighborhoods
        .par_iter()
        .enumerate()
        .map(|(me, near)| simplified_histogram(me, near, points, normals))
        .collect();
    neighborhoods
        .par_iter()
        .enumerate()
        .map(|(me, near)| {
            let mut sum = [0.0; DESCRIPTOR_LEN];
            for &(other, square) in near {
                let weight = 1.0 / square;
                for (total, x) in sum.iter_mut().zip(&simple[other as usize]) {
                    *total += weight * x;
                }
            }
            normalise_histograms(&mut sum);
            for (total, x) in sum.iter_mut().zip(&simple[me]) {
                *total += x;
            }
            hellinger(sum)
        })
        .collect()
}

/// The SPFH of one point: angles between its normal, its neighbours' normals and the lines between them.
fn simplified_histogram(me: usize, near: &[(u32, f32)], points: &[Point], normals: &[Point]) -> Descriptor {
    let mut histogram = [0.0; DESCRIPTOR_LEN];
    for &(other, square) in near {
        let other = other as usize;
        let inverse = square.sqrt().recip();
        let d: Point = std::array::from_fn(|k| (points[other][k] - points[me][k]) * inverse);
        let Some([alpha, phi, theta]) = pair_features(&d, &normals[me], &normals[other]) else { continue };
        histogram[bin(alpha)] += 1.0;
        histogram[BINS + bin(phi)] += 1.0;
        histogram[2 * BINS + bin(theta * std::f32::consts::FRAC_1_PI)] += 1.0;
    }
    normalise_histograms(&mut histogram);
    histogram
}

/// The three angles of a Darboux frame, as (sine-like, sine-like, radians). `d` is the unit vector from the first to the second
/// point. The point whose normal is closer to the line is the source, as in the paper.
fn pair_features(d: &Point, first: &Point, second: &Point) -> Option<[f32; 3]> {
    let (along_first, along_second) = (dot(first, d), dot(second, d));
    let (u, target, d, phi) = if along_first.abs() >= along_second.abs() {
        (first, second, *d, along_first)
    } else {
        (second, first, d.map(|x| -x), -along_second)
    };
    let v = cross(&d, u);
    let length = dot(&v, &v).sqrt();
    if length < 1e-6 {
        return None;
    }
    let v = v.map(|x| x / length);
    let w = cross(u, &v);
    Some([dot(&v, target), phi, dot(&w, target).atan2(dot(u, target))])
}

/// The bin of a value in [-1, 1].
fn bin(value: f32) -> usize {
    (((value + 1.0) * 0.5 * BINS as f32) as usize).min(BINS - 1)
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

fn dot(a: &Point, b: &Point) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn cross(a: &Point, b: &Point) -> Point {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
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
    fn a_lonely_point_has_the_zero_descriptor() {
        assert_eq!(fpfh(&[[0.0; 3]], &[[0.0, 0.0, 1.0]], 1.0), vec![[0.0; DESCRIPTOR_LEN]]);
    }
}
