//! Consensus among matches: several rigid hypotheses of a pair from second-order spatial compatibility (Chen et al.: "SC2-PCR",
//! CVPR 2022), on bit sets: row i of the compatibility matrix says which matches agree with match i, and the
//! second-order score of two matches is the number of third matches that agree with both.

use multiversion::multiversion;
use nalgebra::Vector3;

use super::matching::Match;
use crate::features::Scan;
use crate::geometry::{Pose, rigid_fit};

/// Tolerances in voxels; angles as differences of cosines.
const LENGTH_TOLERANCE: f32 = 2.0;
const MIN_LENGTH: f32 = 2.0;
const NORMAL_TOLERANCE: f32 = 0.45;
const BASELINE_TOLERANCE: f32 = 0.4;
/// A match supports a hypothesis when it is this close, in voxels.
pub const INLIER_VOXELS: f64 = 2.0;
const POWER_ITERATIONS: usize = 10;

/// How many hypotheses are sought and kept.
#[derive(Debug, Clone, Copy)]
pub struct ConsensusOptions {
    /// Matches from which a hypothesis is grown.
    pub seeds: usize,
    /// Matches in a seed's first consensus set.
    pub set_size: usize,
    /// Hypotheses kept.
    pub keep: usize,
    /// Two hypotheses closer than this angle (rad) …
    pub same_angle: f64,
    /// … and this distance (voxels) are one.
    pub same_voxels: f64,
}

impl Default for ConsensusOptions {
    fn default() -> Self {
        Self { seeds: 60, set_size: 30, keep: 12, same_angle: 0.17, same_voxels: 5.0 }
    }
}

/// A rigid motion on which many matches agree.
#[derive(Debug, Clone, Copy)]
pub struct Consensus {
    /// Maps scan b into scan a (local frames).
    pub a_from_b: Pose,
    /// Soft count of the matches that agree: sum of 1 - (residual / tolerance)^2.
    pub score: f64,
    /// Matches within the tolerance.
    pub inliers: usize,
}

/// Finds up to `options.keep` different motions, best score first.
#[must_use]
pub fn consensus(a: &Scan, b: &Scan, matches: &[Match], options: &ConsensusOptions) -> Vec<Consensus> {
    if matches.len() < 3 {
        return Vec::new();
    }
    let voxel = a.prepared.resolution;
    let lines = Lines::new(a, b, matches);
    let graph = BitGraph::compatible(&lines, voxel as f32);
    let pairs: Vec<(Vector3<f64>, Vector3<f64>)> =
        matches.iter().map(|m| (b.keypoint(m.b as usize), a.keypoint(m.a as usize))).collect();
    let tolerance = INLIER_VOXELS * voxel;

    let mut covered = vec![false; matches.len()];
    let mut found: Vec<Consensus> = Vec::new();
    for seed in graph.seed_order() {
        if found.len() >= options.seeds {
            break;
        }
        if covered[seed] {
            continue;
        }
        covered[seed] = true;
        let set = graph.consensus_set(seed, options.set_size);
        if set.len() < 3 {
            continue;
        }
        let Some(first) = rigid_fit(set.iter().map(|&(i, weight)| (pairs[i].0, pairs[i].1, weight))) else {
            continue;
        };
        let candidate = refit(&pairs, first, tolerance);
        for (covered, (in_b, in_a)) in covered.iter_mut().zip(&pairs) {
            *covered |= (candidate.a_from_b.transform(in_b) - in_a).norm_squared() < tolerance * tolerance;
        }
        found.push(candidate);
    }
    found.sort_by(|x, y| y.score.total_cmp(&x.score));
    let mut kept: Vec<Consensus> = Vec::new();
    for candidate in found {
        let known = kept.iter().any(|k| {
            let (angle, distance) = centred_difference(&k.a_from_b, &candidate.a_from_b, &b.centroid);
            angle < options.same_angle && distance < options.same_voxels * voxel
        });
        if !known {
            kept.push(candidate);
        }
        if kept.len() == options.keep {
            break;
        }
    }
    kept
}

/// The matches that agree with a motion, however it was found.
#[must_use]
pub fn agreement(a: &Scan, b: &Scan, matches: &[Match], a_from_b: &Pose) -> Consensus {
    let tolerance = INLIER_VOXELS * a.prepared.resolution;
    let pairs = matches.iter().map(|m| (b.keypoint(m.b as usize), a.keypoint(m.a as usize)));
    judge(pairs, *a_from_b, tolerance * tolerance)
}

/// The angle between two motions (rad) and how far apart they put `centre` (metres).
#[must_use]
pub fn centred_difference(x: &Pose, y: &Pose, centre: &Vector3<f64>) -> (f64, f64) {
    ((x.inverse() * *y).angle(), (x.transform(centre) - y.transform(centre)).norm())
}

/// Two rounds of least squares on the matches within the tolerance.
fn refit(pairs: &[(Vector3<f64>, Vector3<f64>)], first: Pose, tolerance: f64) -> Consensus {
    let square = tolerance * tolerance;
    let mut best = judge(pairs.iter().copied(), first, square);
    for _ in 0..2 {
        let near = pairs.iter().filter_map(|(in_b, in_a)| {
            let r2 = (best.a_from_b.transform(in_b) - in_a).norm_squared();
            (r2 < square).then(|| (*in_b, *in_a, 1.0 / (1.0 + r2 / square)))
        });
        let Some(pose) = rigid_fit(near) else { break };
        let next = judge(pairs.iter().copied(), pose, square);
        if next.score <= best.score {
            break;
        }
        best = next;
    }
    best
}

fn judge(
    pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)>,
    a_from_b: Pose,
    square: f64,
) -> Consensus {
    let (mut score, mut inliers) = (0.0, 0);
    for (in_b, in_a) in pairs {
        let r2 = (a_from_b.transform(&in_b) - in_a).norm_squared();
        if r2 < square {
            score += 1.0 - r2 / square;
            inliers += 1;
        }
    }
    Consensus { a_from_b, score, inliers }
}

/// The matches' points and normals, one array a coordinate.
struct Lines {
    /// x, y, z in a; x, y, z in b; normal in a; normal in b.
    data: [Vec<f32>; 12],
}

impl Lines {
    fn new(a: &Scan, b: &Scan, matches: &[Match]) -> Self {
        let column = |k: usize| -> Vec<f32> {
            matches
                .iter()
                .map(|m| {
                    let (scan, keypoint) = if k % 6 < 3 { (a, m.a) } else { (b, m.b) };
                    let at = scan.prepared.keypoints[keypoint as usize] as usize;
                    let of = if k < 6 { &scan.prepared.points } else { &scan.prepared.normals };
                    of[at][k % 3]
                })
                .collect()
        };
        Self { data: std::array::from_fn(column) }
    }

    fn len(&self) -> usize {
        self.data[0].len()
    }
}

/// A symmetric graph on matches, one bit a pair.
struct BitGraph {
    size: usize,
    words: usize,
    bits: Vec<u64>,
}

impl BitGraph {
    fn compatible(lines: &Lines, voxel: f32) -> Self {
        let size = lines.len();
        let words = size.div_ceil(64);
        let mut bits = vec![0_u64; size * words];
        let mut agrees = vec![0_u8; words * 64];
        for i in 0..size {
            compatible_with(&lines.data, i, voxel, &mut agrees[..size]);
            for (word, flags) in bits[i * words..(i + 1) * words].iter_mut().zip(agrees.chunks_exact(64)) {
                *word = pack(flags);
            }
        }
        Self { size, words, bits }
    }

    fn row(&self, i: usize) -> &[u64] {
        &self.bits[i * self.words..(i + 1) * self.words]
    }

    fn neighbors(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        self.row(i).iter().enumerate().flat_map(|(word, &bits)| {
            std::iter::successors(Some(bits), |b| Some(b & b.wrapping_sub(1)))
                .take_while(|b| *b != 0)
                .map(move |b| word * 64 + b.trailing_zeros() as usize)
        })
    }

    /// Matches in the order in which hypotheses are grown from them: alternately by the leading eigenvector of the graph and
    /// by the sum of second-order scores.
    fn seed_order(&self) -> Vec<usize> {
        let neighbors: Vec<Vec<u32>> =
            (0..self.size).map(|i| self.neighbors(i).map(|j| j as u32).collect()).collect();
        let mut vector = vec![1.0_f64; self.size];
        for _ in 0..POWER_ITERATIONS {
            let next: Vec<f64> = neighbors.iter().map(|of| sum_of(&vector, of)).collect();
            let norm = next.iter().map(|x| x * x).sum::<f64>().sqrt();
            if norm == 0.0 {
                break;
            }
            vector = next.iter().map(|x| x / norm).collect();
        }
        let mut second_order = vec![0.0_f64; self.size];
        for (i, of) in neighbors.iter().enumerate() {
            for j in of.iter().map(|j| *j as usize).take_while(|j| *j < i) {
                let score = f64::from(common(self.row(i), self.row(j)));
                second_order[i] += score;
                second_order[j] += score;
            }
        }
        let ranked = |score: &[f64]| {
            let mut order: Vec<usize> = (0..self.size).collect();
            order.sort_by(|&x, &y| score[y].total_cmp(&score[x]).then(x.cmp(&y)));
            order
        };
        let by_vector = ranked(&vector);
        let by_second_order = ranked(&second_order);
        by_vector.into_iter().zip(by_second_order).flat_map(|(x, y)| [x, y]).collect()
    }

    /// The seed and the matches with the highest second-order scores to it, each with its score as weight.
    fn consensus_set(&self, seed: usize, size: usize) -> Vec<(usize, f64)> {
        let row = self.row(seed);
        let mut scored: Vec<(u32, usize)> =
            self.neighbors(seed).map(|j| (common(row, self.row(j)), j)).collect();
        scored.sort_unstable_by(|x, y| y.0.cmp(&x.0).then(x.1.cmp(&y.1)));
        scored.truncate(size);
        let top = scored.first().map_or(1, |s| s.0.max(1));
        let mut set: Vec<(usize, f64)> =
            scored.iter().filter(|s| s.0 > 0).map(|&(score, j)| (j, f64::from(score))).collect();
        set.push((seed, f64::from(top)));
        set
    }
}

/// The sum of some numbers of a vector, four at a time: one sum would wait for each addition.
fn sum_of(vector: &[f64], which: &[u32]) -> f64 {
    let mut sums = [0.0; 4];
    for some in which.chunks(4) {
        for (sum, i) in sums.iter_mut().zip(some) {
            *sum += vector[*i as usize];
        }
    }
    sums.iter().sum()
}

fn pack(flags: &[u8]) -> u64 {
    flags.iter().enumerate().fold(0, |word, (k, flag)| word | u64::from(*flag) << k)
}

#[multiversion(targets(
    "x86_64+avx512f+avx512vpopcntdq+popcnt",
    "x86_64+avx2+popcnt",
    "x86_64+popcnt",
    "aarch64+neon"
))]
fn common(x: &[u64], y: &[u64]) -> u32 {
    x.iter().zip(y).map(|(x, y)| (x & y).count_ones()).sum()
}

/// `agrees[j] = 1` where matches i and j can belong to one rigid motion.
#[multiversion(targets("x86_64+avx512f+avx512bw", "x86_64+avx2", "aarch64+neon"))]
fn compatible_with(data: &[Vec<f32>; 12], i: usize, voxel: f32, agrees: &mut [u8]) {
    let n = agrees.len();
    let [ax, ay, az, bx, by, bz, nax, nay, naz, nbx, nby, nbz] = data;
    let (ax, ay, az) = (&ax[..n], &ay[..n], &az[..n]);
    let (bx, by, bz) = (&bx[..n], &by[..n], &bz[..n]);
    let (nax, nay, naz) = (&nax[..n], &nay[..n], &naz[..n]);
    let (nbx, nby, nbz) = (&nbx[..n], &nby[..n], &nbz[..n]);
    let tolerance = LENGTH_TOLERANCE * voxel;
    let shortest = MIN_LENGTH * voxel;
    for j in 0..n {
        let (dax, day, daz) = (ax[j] - ax[i], ay[j] - ay[i], az[j] - az[i]);
        let (dbx, dby, dbz) = (bx[j] - bx[i], by[j] - by[i], bz[j] - bz[i]);
        let la = (dax * dax + day * day + daz * daz).sqrt();
        let lb = (dbx * dbx + dby * dby + dbz * dbz).sqrt();
        let normals_a = nax[i] * nax[j] + nay[i] * nay[j] + naz[i] * naz[j];
        let normals_b = nbx[i] * nbx[j] + nby[i] * nby[j] + nbz[i] * nbz[j];
        // Cosines between normals and baselines, compared after multiplication with both lengths.
        let scale = la * lb;
        let first = (nax[i] * dax + nay[i] * day + naz[i] * daz) * lb
            - (nbx[i] * dbx + nby[i] * dby + nbz[i] * dbz) * la;
        let other = (nax[j] * dax + nay[j] * day + naz[j] * daz) * lb
            - (nbx[j] * dbx + nby[j] * dby + nbz[j] * dbz) * la;
        agrees[j] = u8::from((la - lb).abs() < tolerance)
            & u8::from(la > shortest)
            & u8::from(lb > shortest)
            & u8::from((normals_a - normals_b).abs() < NORMAL_TOLERANCE)
            & u8::from(first.abs() < BASELINE_TOLERANCE * scale)
            & u8::from(other.abs() < BASELINE_TOLERANCE * scale);
    }
}
