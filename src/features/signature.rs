//! A scan's global signature: what kinds of surface it holds, as one short vector, for retrieval.
//!
//! It is the mean of random Fourier features of the descriptors of the scan's keypoints (Rahimi, Recht: "Random Features for
//! Large-Scale Kernel Machines", 2007), that is, the kernel mean embedding of their distribution: scans that see the same things
//! have close signatures. Keypoints are rare points above all, so it tells of what is there beside walls and floors. Unlike a learned vocabulary it needs no training data and is the same for every project.

use std::f32::consts::TAU;
use std::sync::LazyLock;

use multiversion::multiversion;
use rand::{Rng, SeedableRng};
use rayon::prelude::*;

use super::fpfh::Descriptor;
use super::similarity::Columns;
use crate::control::SeedRng;

/// Numbers in a signature.
pub const SIGNATURE_LEN: usize = 512;
/// Inverse width of the Gaussian kernel between unit-length descriptors.
const KERNEL_SCALE: f32 = 8.0;
/// The features are part of the format of prepared scans, so this never follows a project's seed.
const FEATURE_SEED: u64 = 0x5167_7265;

/// Waves that are taken together: as many rows as a tile of products has, twice.
const TOGETHER: usize = 12;

/// What the features are cosines of.
struct Waves {
    /// One after the other, each [`DESCRIPTOR_LEN`] numbers, in turns.
    waves: Vec<Descriptor>,
    /// Of each, in turns.
    phases: Vec<f32>,
}

/// Drawn once.
static WAVES: LazyLock<Waves> = LazyLock::new(|| {
    let mut rng = SeedRng::seed_from_u64(FEATURE_SEED);
    let mut uniform = move || (rng.next_u32() as f32 + 0.5) / 4_294_967_296.0;
    let draw = |_| {
        // In turns instead of radians, which the cosine is computed from.
        let wave: Descriptor = std::array::from_fn(|_| {
            // Box and Muller's normal variate.
            (-2.0 * uniform().ln()).sqrt() * (TAU * uniform()).cos() * KERNEL_SCALE / TAU
        });
        (wave, uniform())
    };
    let (waves, phases) = (0..SIGNATURE_LEN).map(draw).unzip();
    Waves { waves, phases }
});

/// The mean random Fourier feature of `descriptors`: 512 numbers in [-1, 1].
#[must_use]
pub fn signature(descriptors: &[Descriptor]) -> Vec<f32> {
    if descriptors.is_empty() {
        return vec![0.0; SIGNATURE_LEN];
    }
    let columns = Columns::new(descriptors.as_flattened());
    let count = descriptors.len();
    let room = || vec![0.0; TOGETHER * columns.stride()];
    WAVES
        .waves
        .par_chunks(TOGETHER)
        .zip(WAVES.phases.par_chunks(TOGETHER))
        .map_init(room, |turns, (waves, phases)| {
            columns.multiply(waves.as_flattened(), turns);
            let rows = turns.chunks(columns.stride()).zip(phases);
            rows.map(|(turns, phase)| (sum_of_cosines(&turns[..count], *phase) / count as f64) as f32)
                .collect::<Vec<_>>()
        })
        .flatten_iter()
        .collect()
}

/// Numbers taken together.
const LANES: usize = 16;

/// `sum cos(2 pi (t + phase))` over some turns t.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn sum_of_cosines(turns: &[f32], phase: f32) -> f64 {
    let mut sums = [0.0_f64; LANES];
    let (whole, rest) = turns.as_chunks::<LANES>();
    for turns in whole {
        for lane in 0..LANES {
            sums[lane] += f64::from(cosine_of_turns(turns[lane] + phase));
        }
    }
    let rest: f64 = rest.iter().map(|turns| f64::from(cosine_of_turns(turns + phase))).sum();
    sums.iter().sum::<f64>() + rest
}

/// cos(2 pi t) to within 1e-6, for |t| below a million, in arithmetic that runs on many numbers at once.
#[inline]
fn cosine_of_turns(t: f32) -> f32 {
    // Adding and taking away a number this large rounds to whole turns.
    const ROUND: f32 = 12_582_912.0;
    // The odd Taylor polynomial of sin(2 pi x), which suffices up to a quarter turn.
    const SINE: [f32; 6] = [TAU, -41.341_7, 81.605_25, -76.705_86, 42.058_693, -15.094_643];
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
    use crate::features::DESCRIPTOR_LEN;

    #[test]
    fn cosines_are_cosines() {
        for i in -4000..4000 {
            let t = i as f32 * 0.003;
            let expected = (f64::from(t) * std::f64::consts::TAU).cos();
            assert!((f64::from(cosine_of_turns(t)) - expected).abs() < 2e-6, "{t}");
        }
    }

    #[test]
    fn a_number_is_the_mean_of_the_cosines_of_a_wave() {
        let descriptors: Vec<Descriptor> =
            (0..37).map(|i| std::array::from_fn(|k| ((i * 7 + k) % 13) as f32 * 0.02)).collect();
        for n in [1, 5, 16, 32, 37] {
            let found = signature(&descriptors[..n]);
            assert_eq!(found.len(), SIGNATURE_LEN);
            for ((found, wave), phase) in found.iter().zip(&WAVES.waves).zip(&WAVES.phases) {
                let cosine = |d: &Descriptor| {
                    let turns = d.iter().zip(wave).map(|(x, w)| f64::from(x * w)).sum::<f64>();
                    ((turns + f64::from(*phase)) * std::f64::consts::TAU).cos()
                };
                let expected = descriptors[..n].iter().map(cosine).sum::<f64>() / n as f64;
                assert!((f64::from(*found) - expected).abs() < 1e-4, "{found} is not {expected}");
            }
        }
        assert_eq!(signature(&[]).len(), SIGNATURE_LEN);
        assert!(signature(&[]).iter().all(|x| *x == 0.0));
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
