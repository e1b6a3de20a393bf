//! Which points of a scan become keypoints: rare ones are likelier. Where planes dominate, a uniform sample is nearly all wall and
//! floor, whose descriptors match each other anywhere; what tells one place from another is what the scan holds little of.

use multiversion::multiversion;
use rand::Rng;
use rayon::prelude::*;

use super::fpfh::Descriptor;
use super::similarity::Columns;
use crate::control::SeedRng;

/// Descriptors, evenly spread over the scan, that stand for all when density is estimated. A multiple of `LANES`.
const REFERENCES: usize = 512;
/// Descriptors that are compared with them at a time.
const TOGETHER: usize = 24;
const LANES: usize = 16;
/// Two descriptors count as alike up to about this Hellinger similarity short of 1.
const KERNEL_WIDTH: f32 = 0.16;
/// A point is taken with a probability in proportion to density to the power of minus this …
const POWER: f32 = 1.5;
/// … but densities below this are one: noise is rare as well, and must not push everything else out.
const LEAST_DENSITY: f32 = 0.001;

/// Draws at most `count` points without replacement, rare descriptors first in probability; indices ascending. Points without a
/// descriptor (the zero descriptor) are taken only when nothing else is left.
#[must_use]
pub fn select_keypoints(rng: &mut SeedRng, descriptors: &[Descriptor], count: usize) -> Vec<u32> {
    let densities = densities(descriptors);
    // The first of independent exponential clocks, each running at its point's weight (Efraimidis, Spirakis 2006).
    let mut rings: Vec<(f32, u32)> = densities
        .iter()
        .zip(0..)
        .map(|(density, index)| {
            let uniform = (rng.next_u32() as f32 + 1.0) / 4_294_967_808.0;
            (-uniform.ln() * density.max(LEAST_DENSITY).powf(POWER), index)
        })
        .collect();
    rings.sort_unstable_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
    let mut keypoints: Vec<u32> = rings.into_iter().take(count).map(|(_, index)| index).collect();
    keypoints.sort_unstable();
    keypoints
}

/// For each descriptor the share of the scan's descriptors that are like it: a kernel estimate in [0, 1]. Infinite for the zero
/// descriptor.
fn densities(descriptors: &[Descriptor]) -> Vec<f32> {
    if descriptors.is_empty() {
        return Vec::new();
    }
    // Repeated, where there are fewer points than references.
    let reference = |slot: usize| descriptors[slot * descriptors.len() / REFERENCES];
    let references = Columns::new((0..REFERENCES).map(reference).collect::<Vec<_>>().as_flattened());
    let density = |descriptor: &Descriptor, similarity: &[f32; REFERENCES]| {
        if descriptor.iter().all(|x| *x == 0.0) {
            return f32::INFINITY;
        }
        likeness(similarity) / REFERENCES as f32
    };
    let room = || vec![[0.0_f32; REFERENCES]; TOGETHER];
    descriptors
        .par_chunks(TOGETHER)
        .map_init(room, |similarities, descriptors| {
            references.multiply(descriptors.as_flattened(), similarities.as_flattened_mut());
            let found = descriptors.iter().zip(similarities);
            found.map(|(descriptor, similarity)| density(descriptor, similarity)).collect::<Vec<_>>()
        })
        .flatten_iter()
        .collect()
}

/// The sum of a kernel of finite reach, close to `exp(-8 (1 - s) / KERNEL_WIDTH)`.
#[multiversion(targets("x86_64+avx512f", "x86_64+avx2", "aarch64+neon"))]
fn likeness(similarity: &[f32; REFERENCES]) -> f32 {
    let mut sums = [0.0_f32; LANES];
    for chunk in similarity.chunks_exact(LANES) {
        for lane in 0..LANES {
            let inside = (1.0 - (1.0 - chunk[lane]) / KERNEL_WIDTH).max(0.0);
            let square = inside * inside;
            let fourth = square * square;
            sums[lane] += fourth * fourth;
        }
    }
    sums.iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Seed;
    use crate::features::DESCRIPTOR_LEN;

    /// A descriptor of one bin, a little blurred.
    fn kind(bin: usize, blur: f32) -> Descriptor {
        let mut d = [0.0; DESCRIPTOR_LEN];
        d[bin] = (1.0 - blur * blur).sqrt();
        d[bin + 1] = blur;
        d
    }

    #[test]
    fn what_a_scan_holds_little_of_is_sampled_far_more_densely() {
        // 4,000 points of wall, 200 of furniture.
        let scan: Vec<Descriptor> =
            (0..4200).map(|i| kind(if i % 21 == 0 { 20 } else { 0 }, 0.001 * (i % 50) as f32)).collect();
        let mut rng = Seed(7).derive("test", 0);
        let chosen = select_keypoints(&mut rng, &scan, 400);
        let rare = chosen.iter().filter(|i| *i % 21 == 0).count();
        assert_eq!(chosen.len(), 400);
        assert!(chosen.is_sorted());
        assert!(rare > 150, "{rare} of 200 rare points were taken, {} of 4000 others", 400 - rare);
    }

    #[test]
    fn points_without_a_descriptor_come_last() {
        let mut scan: Vec<Descriptor> = (0..300).map(|i| kind(0, 0.001 * (i % 50) as f32)).collect();
        scan.extend([[0.0; DESCRIPTOR_LEN]; 10]);
        let mut rng = Seed(7).derive("test", 0);
        assert!(select_keypoints(&mut rng, &scan, 300).iter().all(|i| *i < 300));
        assert_eq!(select_keypoints(&mut rng, &scan, 1000).len(), 310);
        assert!(select_keypoints(&mut rng, &[], 5).is_empty());
    }
}
