//! Positions of scans from displacements of pairs, once the rotations are known, some of which are wrong. Used by `baseline`.

use nalgebra::Vector3;

use super::averaging::{Averageable, Averaged, AveragingError, AveragingOptions, Link, average};
use crate::control::Control;

/// A measured displacement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TranslationEdge {
    /// A scan.
    pub i: usize,
    /// Another scan.
    pub j: usize,
    /// Translation of scan j less that of scan i, in the axes of the model, metres.
    pub j_less_i: Vector3<f64>,
    /// How much it counts, above zero; outside the kernel.
    pub weight: f64,
}

struct Translations<'a>(&'a [TranslationEdge]);

impl Averageable<Vector3<f64>> for Translations<'_> {
    fn residual(&self, link: usize, nodes: &[Vector3<f64>]) -> Vector3<f64> {
        let edge = &self.0[link];
        edge.j_less_i - (nodes[edge.j] - nodes[edge.i])
    }

    fn moved(&self, node: &Vector3<f64>, by: &Vector3<f64>) -> Vector3<f64> {
        node + by
    }
}

/// Finds translations of `model_from_scan` that agree with most edges: minimises the sum of distances, which has one minimum
/// whatever the start, then that of their Geman-McClure costs. The scale of `options` is in metres. The lowest index of each
/// connected group stays at `start`.
pub fn average_translations(
    start: &[Vector3<f64>],
    edges: &[TranslationEdge],
    options: &AveragingOptions,
    control: Control<'_>,
) -> Result<Averaged<Vector3<f64>>, AveragingError> {
    let links: Vec<Link> = edges
        .iter()
        .map(|edge| Link {
            i: edge.i,
            j: edge.j,
            weight: edge.weight,
            finite: edge.j_less_i.iter().all(|x| x.is_finite()),
        })
        .collect();
    average(&Translations(edges), &links, start, options, control)
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::super::test_scene::{rng, vector, with_control, with_threads};
    use super::*;

    fn solve(start: &[Vector3<f64>], edges: &[TranslationEdge]) -> Averaged<Vector3<f64>> {
        with_control(|control| {
            average_translations(start, edges, &AveragingOptions::with_scale(0.2), control).unwrap()
        })
    }

    /// Thirty places and 120 displacements, of which every fourth is off by metres.
    fn scene(noise: f64) -> (Vec<Vector3<f64>>, Vec<TranslationEdge>) {
        let mut rng = rng(7);
        let mut truth: Vec<Vector3<f64>> = (0..30).map(|_| vector(&mut rng, 10.0)).collect();
        truth[0] = Vector3::zeros();
        let mut edges = Vec::new();
        for index in 0..120 {
            let i = index % 30;
            let j = (i + 1 + rng.random_range(0..8)) % 30;
            let mut j_less_i = truth[j] - truth[i] + vector(&mut rng, noise);
            if index % 4 == 3 {
                j_less_i += vector(&mut rng, 8.0);
            }
            edges.push(TranslationEdge { i, j, j_less_i, weight: rng.random_range(0.5..3.0) });
        }
        (truth, edges)
    }

    fn worst(found: &[Vector3<f64>], truth: &[Vector3<f64>]) -> f64 {
        found.iter().zip(truth).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
    }

    #[test]
    fn the_truth_is_found_from_anywhere_among_displacements_that_are_wrong() {
        let (truth, edges) = scene(1e-9);
        let mut start = vec![Vector3::new(100.0, -3.0, 8.0); 30];
        start[0] = Vector3::zeros();
        let averaged = solve(&start, &edges);
        assert!(worst(&averaged.nodes, &truth) < 1e-3, "{}", worst(&averaged.nodes, &truth));
        let again = with_threads(3, || solve(&start, &edges));
        assert!(averaged == again);
    }

    #[test]
    fn noise_is_averaged_and_outliers_are_told() {
        let (truth, edges) = scene(0.03);
        let averaged = solve(&truth, &edges);
        assert!(worst(&averaged.nodes, &truth) < 0.06, "{}", worst(&averaged.nodes, &truth));
        for (index, weight) in averaged.weights.iter().enumerate() {
            assert!(if index % 4 == 3 { *weight < 0.25 } else { *weight > 0.5 }, "edge {index}: {weight}");
        }
    }
}
