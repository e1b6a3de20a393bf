//! Fast point feature histograms (Rusu, Blodow, Beetz: "Fast Point Feature Histograms (FPFH) for 3D registration", ICRA 2009),
//! in the Hellinger form: square-rooted and normalised, so that the dot product of two descriptors is the
//! Bhattacharyya coefficient of their histograms, between 0 and 1.

use multiversion::multiversion;

use super::surfel::Surfel;
use crate::geometry::{NeighborIndex, Pairs, Point, whole};

const BINS: usize = 11;
/// Numbers in a descriptor: three histograms of eleven bins.
pub const DESCRIPTOR_LEN: usize = 3 * BINS;

/// One descriptor, of unit length.
pub type Descriptor = [f32; DESCRIPTOR_LEN];

/// Histograms while they are summed, with zeros behind them: whole vectors of any processor.
type Row = [f32; ROW];
const ROW: usize = DESCRIPTOR_LEN.next_multiple_of(16);
/// Histograms of neighbours that are added at a time.
const SUMMANDS: usize = 4;

/// The descriptors of all points, from neighbours within `radius` metres. `normals` are unit vectors that face the sensor,
/// one a point. A point without neighbours gets the zero descriptor, which matches nothing. All but the search for neighbours runs on one
/// thread, as each pair adds to the sums of both its points; scans are prepared side by side.
#[must_use]
pub fn fpfh(points: &[Point], normals: &[Point], radius: f32) -> Vec<Descriptor> {
    let index = NeighborIndex::new(points, radius);
    // What two points are to each other is the same from either side: each pair is looked at once.
    let pairs = index.pairs(radius);
    let surfel = |item: &u32| Surfel { position: points[*item as usize], normal: normals[*item as usize] };
    let surfels: Vec<Surfel> = index.order().iter().map(surfel).collect();
    let simple = simplified_histograms(&pairs, &surfels);
    let sums = weighted_sums(&pairs, &simple);
    let mut descriptors = vec![[0.0; DESCRIPTOR_LEN]; points.len()];
    for ((item, mut sum), simple) in index.order().iter().zip(sums).zip(&simple) {
        normalise_histograms(&mut sum);
        descriptors[*item as usize] = hellinger(std::array::from_fn(|k| sum[k] + simple[k]));
    }
    descriptors
}

/// For each point the sum of its neighbours' histograms, each weighted by its inverse squared distance.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn weighted_sums(pairs: &Pairs, simple: &[Row]) -> Vec<Row> {
    const NOTHING: Row = [0.0; ROW];
    let mut sums = vec![NOTHING; simple.len()];
    for (me, partners) in pairs.by_point().enumerate() {
        let mine = &simple[me];
        let mut sum = NOTHING;
        // Several at once, as each addition to the sum waits for the last.
        for some in partners.chunks(SUMMANDS) {
            let mut weights = [0.0; SUMMANDS];
            let mut theirs = [&NOTHING; SUMMANDS];
            for (at, &(other, square)) in some.iter().enumerate() {
                // What is in the same place has no weight, as it has no angles.
                weights[at] = if square > 0.0 { 1.0 / square } else { 0.0 };
                theirs[at] = &simple[other as usize];
                let their_sum = &mut sums[other as usize];
                for k in 0..ROW {
                    their_sum[k] += weights[at] * mine[k];
                }
            }
            let [a, b, c, d] = theirs;
            for k in 0..ROW {
                let first = weights[0] * a[k] + weights[1] * b[k];
                sum[k] += first + (weights[2] * c[k] + weights[3] * d[k]);
            }
        }
        for (total, x) in sums[me].iter_mut().zip(&sum) {
            *total += x;
        }
    }
    sums
}

/// The SPFH of all points: angles between the normals of each and of its neighbours and the lines between them.
fn simplified_histograms(pairs: &Pairs, surfels: &[Surfel]) -> Vec<Row> {
    // The entry after the last takes what has no angles.
    let mut counts = vec![[0_u32; DESCRIPTOR_LEN + 1]; surfels.len()];
    let mut block = Neighbors::default();
    for (me, partners) in pairs.by_point().enumerate() {
        // Two in turns, as an addition to an entry waits for the last one to it.
        let mut mine = [[0_u32; DESCRIPTOR_LEN + 1]; 2];
        for some in partners.chunks(LANES) {
            block.fill(&surfels[me], some, surfels);
            pair_bins(&surfels[me].normal, &mut block);
            for (lane, &(other, _)) in some.iter().enumerate() {
                let theirs = &mut counts[other as usize];
                for bins in &block.bins {
                    let bin = bins[lane] as usize;
                    mine[lane % 2][bin] += 1;
                    theirs[bin] += 1;
                }
            }
        }
        for (total, count) in counts[me].iter_mut().zip(mine[0].iter().zip(&mine[1])) {
            *total += count.0 + count.1;
        }
    }
    let histogram = |counts: &[u32; DESCRIPTOR_LEN + 1]| {
        let mut row = [0.0; ROW];
        for (x, count) in row[..DESCRIPTOR_LEN].iter_mut().zip(counts) {
            *x = *count as f32;
        }
        normalise_histograms(&mut row);
        row
    };
    counts.iter().map(histogram).collect()
}

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
    /// The result: the numbers of the descriptor that the three angles of each fall into, or [`DESCRIPTOR_LEN`] for none.
    bins: [[u32; LANES]; 3],
}

impl Neighbors {
    /// Takes some partners of a point in.
    fn fill(&mut self, of: &Surfel, partners: &[(u32, f32)], surfels: &[Surfel]) {
        for (lane, &(other, square)) in partners.iter().take(LANES).enumerate() {
            let other = &surfels[other as usize];
            for k in 0..3 {
                self.offset[k][lane] = other.position[k] - of.position[k];
                self.normal[k][lane] = other.normal[k];
            }
            self.square[lane] = square;
        }
    }
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
        let per_length = 1.0 / length;
        let triple = (dy * mz - dz * my) * nx[k] + (dz * mx - dx * mz) * ny[k] + (dx * my - dy * mx) * nz[k];
        let between = mx * nx[k] + my * ny[k] + mz * nz[k];
        // w . t = (d - u (d . u)) . t / |d x u|
        let theta = half_turns((along_target - phi * between) * per_length, between);
        let determined = length >= 1e-6;
        let angles = [triple * per_length, phi, theta];
        for (part, angle) in angles.into_iter().enumerate() {
            let bin = (part * BINS) as u32 + bin(angle);
            block.bins[part][k] = if determined { bin } else { DESCRIPTOR_LEN as u32 };
        }
    }
}

/// The bin of a value in [-1, 1].
#[inline]
fn bin(value: f32) -> u32 {
    whole(((value + 1.0) * 0.5 * BINS as f32).clamp(0.0, BINS as f32 - 1.0)).min(BINS as u32 - 1)
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

fn normalise_histograms(row: &mut Row) {
    for part in row[..DESCRIPTOR_LEN].chunks_exact_mut(BINS) {
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
    fn every_number_has_a_bin() {
        assert_eq!([-1.0, 0.0, 1.0].map(bin), [0, 5, 10]);
        for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, -7.0, 7.0] {
            assert!(bin(value) < BINS as u32, "{value}");
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
        // What is in the same place is no company.
        assert_eq!(fpfh(&[[0.0; 3]; 2], &[[0.0, 0.0, 1.0]; 2], 1.0), vec![[0.0; DESCRIPTOR_LEN]; 2]);
    }
}
