//! A scan's global signature: what kinds of surface it holds, as one short vector, for retrieval.
//!
//! It is the mean of random Fourier features of the descriptors of the scan's keypoints (Rahimi, Recht: "Random Features for
//! Large-Scale Kernel Machines", 2007), that is, the kernel mean embedding of their distribution: scans that see the same things
//! have close signatures. Keypoints are rare points above all, so it tells of what is there beside walls and floors. Unlike a learned vocabulary it needs no training data and is the same for every project.

use multiversion::multiversion;
use rand::{Rng, SeedableRng};
use rayon::prelude::*;

use super::fpfh::{DESCRIPTOR_LEN, Descriptor};
use crate::control::SeedRng;

/// Numbers in a signature.
pub const SIGNATURE_LEN: usize = 512;
/// Inverse width of the Gaussian kernel between unit-length descriptors.
const KERNEL_SCALE: f32 = 8.0;
/// The features are part of the format of prepared scans, so this never follows a project's seed.
const FEATURE_SEED: u64 = 0x5167_7265;

/// The mean random Fourier feature of `descriptors`: 512 numbers in [-1, 1].
#[must_use]
pub fn signature(descriptors: &[Descriptor]) -> Vec<f32> {
    let mut rng = SeedRng::seed_from_u64(FEATURE_SEED);
    let mut uniform = move || (rng.next_u32() as f32 + 0.5) / 4_294_967_296.0;
    let waves: Vec<([f32; DESCRIPTOR_LEN], f32)> = (0..SIGNATURE_LEN)
        .map(|_| {
            let wave = std::array::from_fn(|_| {
                // Box and Muller's normal variate.
                (-2.0 * uniform().ln()).sqrt() * (std::f32::consts::TAU * uniform()).cos() * KERNEL_SCALE
            });
            (wave, std::f32::consts::TAU * uniform())
        })
        .collect();
    let blocks: Vec<Block> = descriptors.chunks(LANES).map(transposed).collect();
    let full = descriptors.len() / LANES * LANES;
    waves
        .par_iter()
        .map(|(wave, phase)| {
            // In turns instead of radians, which the cosine is computed from.
            let wave = wave.map(|w| w / std::f32::consts::TAU);
            let sum = sum_of_cosines(&wave, phase / std::f32::consts::TAU, &blocks, descriptors.len() - full);
            (sum / descriptors.len().max(1) as f64) as f32
        })
        .collect()
}

/// Descriptors taken together.
const LANES: usize = 16;
/// The same number of each of [`LANES`] descriptors, for all numbers.
type Block = [[f32; LANES]; DESCRIPTOR_LEN];

fn transposed(descriptors: &[Descriptor]) -> Block {
    std::array::from_fn(|k| std::array::from_fn(|lane| descriptors.get(lane).map_or(0.0, |d| d[k])))
}

/// `sum_d cos(2 pi (wave . d + phase))`; of the last block only the first `rest` descriptors count, unless that is 0.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn sum_of_cosines(wave: &Descriptor, phase: f32, blocks: &[Block], rest: usize) -> f64 {
    let mut sums = [0.0_f64; LANES];
    for (number, block) in blocks.iter().enumerate() {
        let mut turns = [phase; LANES];
        for (w, column) in wave.iter().zip(block) {
            for lane in 0..LANES {
                turns[lane] += w * column[lane];
            }
        }
        let mut cosines = [0.0_f32; LANES];
        for lane in 0..LANES {
            cosines[lane] = cosine_of_turns(turns[lane]);
        }
        if number + 1 == blocks.len() && rest > 0 {
            cosines[rest..].fill(0.0);
        }
        for lane in 0..LANES {
            sums[lane] += f64::from(cosines[lane]);
        }
    }
    sums.iter().sum()
}

/// cos(2 pi t) to within 1e-6, for |t| below a million, in arithmetic that runs on many numbers at once.
#[inline]
fn cosine_of_turns(t: f32) -> f32 {
    // Adding and taking away a number this large rounds to whole turns.
    const ROUND: f32 = 12_582_912.0;
    // The odd Taylor polynomial of sin(2 pi x), which suffices up to a quarter turn.
    const SINE: [f32; 6] = [std::f32::consts::TAU, -41.341_7, 81.605_25, -76.705_86, 42.058_693, -15.094_643];
    let t = t - ((t + ROUND) - ROUND);
    let x = 0.25 - t.abs();
    let square = x * x;
    let mut value = SINE[5];
    for coefficient in SINE[..5].iter().rev() {
        value = value * square + coefficient;
    }
    value * x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cosines_are_cosines() {
        for i in -4000..4000 {
            let t = i as f32 * 0.003;
            let expected = (f64::from(t) * std::f64::consts::TAU).cos();
            assert!((f64::from(cosine_of_turns(t)) - expected).abs() < 2e-6, "{t}");
        }
    }

    #[test]
    fn sums_over_blocks_leave_no_descriptor_out_and_add_none() {
        let descriptors: Vec<Descriptor> =
            (0..37).map(|i| std::array::from_fn(|k| ((i * 7 + k) % 13) as f32 * 0.02)).collect();
        let wave: Descriptor = std::array::from_fn(|k| (k as f32 - 16.0) * 0.1);
        for n in [0, 5, 16, 32, 37] {
            let blocks: Vec<Block> = descriptors[..n].chunks(LANES).map(transposed).collect();
            let expected: f64 = descriptors[..n]
                .iter()
                .map(|d| {
                    let turns: f32 = d.iter().zip(&wave).map(|(x, w)| x * w).sum::<f32>() + 0.3;
                    (f64::from(turns) * std::f64::consts::TAU).cos()
                })
                .sum();
            assert!((sum_of_cosines(&wave, 0.3, &blocks, n % LANES) - expected).abs() < 1e-4);
        }
    }

    #[test]
    fn like_distributions_have_like_signatures() {
        let descriptor = |k: usize| -> Descriptor {
            let mut d = [0.0; DESCRIPTOR_LEN];
            d[k % DESCRIPTOR_LEN] = 1.0;
            d
        };
        let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(x, y)| (x - y).powi(2)).sum::<f32>();
        let some: Vec<_> = (0..300).map(|i| descriptor(i % 5)).collect();
        let alike: Vec<_> = (0..200).map(|i| descriptor((i + 3) % 5)).collect();
        let others: Vec<_> = (0..300).map(|i| descriptor(10 + i % 5)).collect();
        let [some, alike, others] = [some, alike, others].map(|d| signature(&d));
        assert!(distance(&some, &alike) < 0.01 * distance(&some, &others));
    }
}
