//! A scan's global signature: what kinds of surface it holds, as one short vector, for retrieval.
//!
//! It is the mean of random Fourier features of the scan's descriptors (Rahimi, Recht: "Random Features for Large-Scale Kernel
//! Machines", 2007), that is, the kernel mean embedding of their distribution: scans that see the same things have close
//! signatures. Unlike a learned vocabulary it needs no training data and is the same for every project.

use rand::{Rng, SeedableRng};
use rayon::prelude::*;

use super::fpfh::{DESCRIPTOR_LEN, Descriptor};
use crate::control::SeedRng;

/// Numbers in a signature.
pub const SIGNATURE_LEN: usize = 512;
/// Inverse width of the Gaussian kernel between unit-length descriptors.
const KERNEL_SCALE: f32 = 4.0;
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
    waves
        .par_iter()
        .map(|(wave, phase)| {
            let sum: f64 = descriptors
                .iter()
                .map(|d| f64::from((wave.iter().zip(d).map(|(w, x)| w * x).sum::<f32>() + phase).cos()))
                .sum();
            (sum / descriptors.len().max(1) as f64) as f32
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

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
