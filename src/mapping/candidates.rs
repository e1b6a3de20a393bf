//! Candidate poses of one component against another (a scan on its own is a component of one): every hypothesis of every edge
//! between them proposes one; proposals that agree form a cluster; the cluster whose edges weigh most wins, and the heaviest
//! different cluster is its rival.

use nalgebra::Vector3;

use super::component::Component;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::{ScanGraph, softplus};

/// Hypotheses with less evidence than this propose nothing.
const LEAST_EVIDENCE: f64 = 0.03;
/// Proposals that are tried as the centre of a cluster, at most.
const MAX_CENTRES: usize = 200;

/// The pose that one hypothesis of one edge implies.
#[derive(Debug, Clone, Copy)]
pub struct Proposal {
    /// Maps component b into component a.
    pub a_from_b: Pose,
    /// The edge's end in a.
    pub in_a: ScanKey,
    /// The edge's end in b.
    pub in_b: ScanKey,
    /// The hypothesis, from the local frame of `in_b` to that of `in_a`.
    pub in_a_from_in_b: Pose,
    /// softplus(score).
    pub evidence: f64,
    /// Centroid of `in_b` in the frame of b, metres: where distances between poses are measured.
    centroid: Vector3<f64>,
}

/// The best cluster of proposals.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The centre of the cluster.
    pub a_from_b: Pose,
    /// Sum over edges of the best evidence in the cluster.
    pub support: f64,
    /// The same of the heaviest different cluster.
    pub rival: f64,
    /// One proposal an edge, those in the cluster.
    pub members: Vec<Proposal>,
}

impl Candidate {
    /// Support with the rival's share taken off: what joins are ranked and judged by.
    #[must_use]
    pub fn margin(&self, options: &MappingOptions) -> f64 {
        self.support - options.rival_share * self.rival
    }
}

/// All proposals between two components, the strongest first.
#[must_use]
pub fn proposals(graph: &ScanGraph, a: &Component, b: &Component) -> Vec<Proposal> {
    let mut found = Vec::new();
    for (in_b, b_from_local) in &b.poses {
        let Some(scan) = graph.scan(*in_b) else { continue };
        let centroid = b_from_local.transform(&scan.centroid);
        let local_from_b = b_from_local.inverse();
        for in_a in graph.neighbors(*in_b) {
            let (Some(a_from_local), Some(edge)) = (a.poses.get(&in_a), graph.edge(in_a, *in_b)) else {
                continue;
            };
            for (motion, h) in edge.motions_from(*in_b) {
                let evidence = softplus(h.score);
                if evidence > LEAST_EVIDENCE {
                    let a_from_b = *a_from_local * motion * local_from_b;
                    found.push(Proposal {
                        a_from_b,
                        in_a,
                        in_b: *in_b,
                        in_a_from_in_b: motion,
                        evidence,
                        centroid,
                    });
                }
            }
        }
    }
    found.sort_by(|x, y| y.evidence.total_cmp(&x.evidence).then((x.in_a, x.in_b).cmp(&(y.in_a, y.in_b))));
    found
}

/// Clusters the proposals between two components. `voxel` in metres. `None` without proposals.
#[must_use]
pub fn best_candidate(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    voxel: f64,
    options: &MappingOptions,
) -> Option<Candidate> {
    let proposals = proposals(graph, a, b);
    let reach = options.cluster_voxels * voxel;
    let clusters: Vec<(f64, usize)> = (0..proposals.len().min(MAX_CENTRES))
        .map(|centre| {
            (members(&proposals, centre, options.cluster_angle, reach).map(|p| p.evidence).sum(), centre)
        })
        .collect();
    let &(support, centre) = clusters.iter().max_by(|x, y| x.0.total_cmp(&y.0).then(y.1.cmp(&x.1)))?;
    let best = &proposals[centre];
    let differs = |p: &Proposal| {
        !within(best, p, options.rival_angle, options.rival_voxels * voxel)
            || !within(p, best, options.rival_angle, options.rival_voxels * voxel)
    };
    let rival = clusters
        .iter()
        .filter(|(_, c)| differs(&proposals[*c]))
        .map(|(support, _)| *support)
        .fold(0.0, f64::max);
    let members = members(&proposals, centre, options.cluster_angle, reach).copied().collect();
    Some(Candidate { a_from_b: best.a_from_b, support, rival, members })
}

/// The support that edges between two components give to a pose that is already known.
#[must_use]
pub fn support_of(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    a_from_b: &Pose,
    voxel: f64,
    options: &MappingOptions,
) -> f64 {
    let mut proposals = proposals(graph, a, b);
    for p in &mut proposals {
        // The known pose stands in as the centre, seen from each proposal's own scan.
        if !agree(a_from_b, &p.a_from_b, &p.centroid, options.cluster_angle, options.cluster_voxels * voxel) {
            p.evidence = 0.0;
        }
    }
    best_by_edge(proposals.iter()).map(|p| p.evidence).sum()
}

/// One proposal an edge: those that agree with the centre, the strongest of each edge.
fn members(proposals: &[Proposal], centre: usize, angle: f64, reach: f64) -> impl Iterator<Item = &Proposal> {
    let centre = &proposals[centre];
    best_by_edge(proposals.iter().filter(move |p| within(centre, p, angle, reach)))
}

/// The first proposal of each edge in the order given. Proposals come strongest first.
fn best_by_edge<'p>(proposals: impl Iterator<Item = &'p Proposal>) -> impl Iterator<Item = &'p Proposal> {
    let mut seen = std::collections::BTreeSet::new();
    let kept: Vec<&Proposal> = proposals.filter(|p| seen.insert((p.in_a, p.in_b))).collect();
    kept.into_iter()
}

fn within(x: &Proposal, y: &Proposal, angle: f64, reach: f64) -> bool {
    agree(&x.a_from_b, &y.a_from_b, &y.centroid, angle, reach)
}

fn agree(x: &Pose, y: &Pose, at: &Vector3<f64>, angle: f64, reach: f64) -> bool {
    if (x.transform(at) - y.transform(at)).norm_squared() > reach * reach {
        return false;
    }
    // cos(angle) of R_x^T R_y from its trace.
    let trace = x.rotation.matrix().component_mul(y.rotation.matrix()).sum();
    0.5 * (trace - 1.0) > angle.cos()
}
