//! Rotations of scans from relative rotations of pairs, some of which are wrong. Used by `baseline`.

use nalgebra::{Rotation3, Vector3};

use super::averaging::{Averageable, Averaged, AveragingError, AveragingOptions, Link, average};
use super::twist::rotation_vector;
use crate::control::Control;
use crate::geometry::Pose;

/// A measured relative rotation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RotationEdge {
    /// A scan.
    pub i: usize,
    /// Another scan.
    pub j: usize,
    /// Turns directions of scan j into those of scan i.
    pub i_from_j: Rotation3<f64>,
    /// How much it counts, above zero; outside the kernel.
    pub weight: f64,
}

struct Rotations<'a>(&'a [RotationEdge]);

impl Averageable<Rotation3<f64>> for Rotations<'_> {
    /// `log(R_i R_ij R_j^-1)` in the model frame. Under left perturbations it becomes, to first order, itself plus that of i minus that
    /// of j.
    fn residual(&self, link: usize, nodes: &[Rotation3<f64>]) -> Vector3<f64> {
        let edge = &self.0[link];
        let turn = nodes[edge.i] * edge.i_from_j * nodes[edge.j].inverse();
        rotation_vector(&Pose::new(turn, Vector3::zeros()))
    }

    fn moved(&self, node: &Rotation3<f64>, by: &Vector3<f64>) -> Rotation3<f64> {
        Pose::new(Rotation3::new(*by) * node, Vector3::zeros()).renormalised().rotation
    }
}

/// Finds rotations `model_from_scan` that agree with most edges: minimises the sum of angles, then that of their Geman-McClure
/// costs, starting at `start`. The scale of `options` is an angle in radians.
///
/// Chatterjee and Govindu (2013), with both phases as reweighted least squares on the tangent space. As every local
/// method it needs a start that is mostly right, for example a maximum spanning tree.
pub fn average_rotations(
    start: &[Rotation3<f64>],
    edges: &[RotationEdge],
    options: &AveragingOptions,
    control: Control<'_>,
) -> Result<Averaged<Rotation3<f64>>, AveragingError> {
    let links: Vec<Link> = edges
        .iter()
        .map(|edge| Link {
            i: edge.i,
            j: edge.j,
            weight: edge.weight,
            finite: edge.i_from_j.matrix().iter().all(|x| x.is_finite()),
        })
        .collect();
    average(&Rotations(edges), &links, start, options, control)
}

#[cfg(test)]
mod tests {
    use rand::RngExt;

    use super::super::test_scene::{poses, rng, vector, with_control};
    use super::*;
    use crate::control::SeedRng;

    const SCALE: f64 = 0.0873;

    fn turn(rng: &mut SeedRng, half_width: f64) -> Rotation3<f64> {
        Rotation3::new(vector(rng, half_width))
    }

    /// Every scan with its next five, turned by up to `noise` radians along each axis.
    fn edges(truth: &[Rotation3<f64>], noise: f64, rng: &mut SeedRng) -> Vec<RotationEdge> {
        let mut edges = Vec::new();
        for i in 0..truth.len() {
            for j in i + 1..truth.len().min(i + 6) {
                let i_from_j = truth[i].inverse() * turn(rng, noise) * truth[j];
                edges.push(RotationEdge { i, j, i_from_j, weight: 1.0 });
            }
        }
        edges
    }

    fn rotations(count: usize, rng: &mut SeedRng) -> Vec<Rotation3<f64>> {
        poses(count, rng).into_iter().map(|pose| pose.rotation).collect()
    }

    /// By the first two edges of each scan, which are always there.
    fn chained(count: usize, edges: &[RotationEdge]) -> Vec<Rotation3<f64>> {
        let mut chained = vec![Rotation3::identity(); count];
        for j in 1..count {
            let edge = edges.iter().find(|e| e.j == j && e.i == j - 1).unwrap();
            chained[j] = chained[j - 1] * edge.i_from_j;
        }
        chained
    }

    fn solve(start: &[Rotation3<f64>], edges: &[RotationEdge]) -> Averaged<Rotation3<f64>> {
        with_control(|control| {
            average_rotations(start, edges, &AveragingOptions::with_scale(SCALE), control).unwrap()
        })
    }

    fn worst(found: &[Rotation3<f64>], truth: &[Rotation3<f64>]) -> f64 {
        found.iter().zip(truth).map(|(a, b)| a.angle_to(b)).fold(0.0, f64::max)
    }

    #[test]
    fn the_residual_changes_by_the_difference_of_the_perturbations() {
        let mut rng = rng(1);
        let truth = rotations(2, &mut rng);
        let edge = RotationEdge { i: 0, j: 1, i_from_j: truth[0].inverse() * truth[1], weight: 1.0 };
        let edges = [edge];
        let problem = Rotations(&edges);
        let h = 1e-6;
        for k in 0..3 {
            let by = Vector3::from_fn(|row, _| if row == k { h } else { 0.0 });
            for (node, sign) in [(0, 1.0), (1, -1.0)] {
                let mut nodes = truth.clone();
                nodes[node] = problem.moved(&nodes[node], &by);
                let slope = problem.residual(0, &nodes) / h;
                assert!((slope - by / h * sign).norm() < 1e-5, "{slope}");
            }
        }
    }

    #[test]
    fn exact_edges_give_the_truth_from_a_bad_start() {
        let mut rng = rng(2);
        let truth = rotations(20, &mut rng);
        let edges = edges(&truth, 1e-12, &mut rng);
        let start: Vec<_> = truth
            .iter()
            .enumerate()
            .map(|(k, r)| if k == 0 { *r } else { turn(&mut rng, 0.3) * r })
            .collect();
        let averaged = solve(&start, &edges);
        assert!(worst(&averaged.nodes, &truth) < 1e-6, "{}", worst(&averaged.nodes, &truth));
        assert!(averaged.weights.iter().all(|w| *w > 0.999_999));
    }

    #[test]
    fn one_wrong_edge_in_five_has_no_say() {
        let mut rng = rng(3);
        let truth = rotations(40, &mut rng);
        let mut edges = edges(&truth, 0.01, &mut rng);
        let start = chained(40, &edges);
        let mut wrong = Vec::new();
        for (index, edge) in edges.iter_mut().enumerate() {
            if edge.j > edge.i + 1 && rng.random_range(0.0..1.0) < 0.3 {
                edge.i_from_j = turn(&mut rng, 1.5) * edge.i_from_j;
                wrong.push(index);
            }
        }
        assert!(wrong.len() * 5 >= edges.len(), "{}", wrong.len());
        let averaged = solve(&start, &edges);
        assert!(worst(&averaged.nodes, &truth) < 0.05, "{}", worst(&averaged.nodes, &truth));
        assert!(worst(&averaged.nodes, &truth) < worst(&start, &truth));
        for index in wrong {
            let off = (averaged.residuals[index] > 0.2) == (averaged.weights[index] < 0.1);
            assert!(off, "{} {}", averaged.residuals[index], averaged.weights[index]);
        }
    }

    #[test]
    fn groups_are_averaged_apart_and_loners_stay() {
        let mut rng = rng(4);
        let truth = rotations(7, &mut rng);
        let link =
            |i: usize, j: usize| RotationEdge { i, j, i_from_j: truth[i].inverse() * truth[j], weight: 2.0 };
        let edges = [link(0, 2), link(2, 4), link(1, 3), link(3, 5)];
        let start: Vec<_> = truth.iter().map(|r| turn(&mut rng, 0.2) * r).collect();
        let averaged = solve(&start, &edges);
        for lowest in [0, 1, 6] {
            assert!(averaged.nodes[lowest] == start[lowest]);
        }
        assert!(averaged.residuals.iter().all(|r| *r < 1e-6), "{:?}", averaged.residuals);
    }

    #[test]
    fn edges_that_make_no_sense_are_refused() {
        let start = [Rotation3::identity(); 2];
        let good = RotationEdge { i: 0, j: 1, i_from_j: Rotation3::identity(), weight: 1.0 };
        let run = |edge: RotationEdge, scale: f64| {
            with_control(|control| {
                average_rotations(&start, &[edge], &AveragingOptions::with_scale(scale), control)
            })
        };
        assert!(run(good, SCALE).is_ok());
        assert!(matches!(run(good, 0.0), Err(AveragingError::Option(_))));
        assert!(matches!(run(RotationEdge { j: 2, ..good }, SCALE), Err(AveragingError::BadEnds { .. })));
        assert!(matches!(run(RotationEdge { j: 0, ..good }, SCALE), Err(AveragingError::BadEnds { .. })));
        let weightless = RotationEdge { weight: 0.0, ..good };
        assert_eq!(run(weightless, SCALE).unwrap_err(), AveragingError::NotFinite { edge: 0 });
    }
}
