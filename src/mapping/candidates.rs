//! Candidate poses of one component against another (a scan on its own is a component of one): every hypothesis of every edge
//! between them proposes one; proposals that agree form a cluster; the cluster whose edges weigh most wins, and the heaviest
//! different cluster is its rival.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::Vector3;

use super::component::Component;
use super::decision::DecidedJoin;
use super::gravity::Gravity;
use super::options::MappingOptions;
use crate::cloud::ScanKey;
use crate::geometry::Pose;
use crate::graph::{ScanGraph, evidence};
use crate::pairwise::centred_difference;

/// Hypotheses with less evidence than this propose nothing.
const LEAST_EVIDENCE: f64 = 0.03;
/// An edge with this evidence says something: a likelihood of 0.63.
pub const LEAST_WORD: f64 = 1.0;
/// A pair that third scans talk up has a voice of its own with these log-odds: a likelihood of 0.27.
const OWN_VOICE: f64 = -1.0;
/// Proposals that are tried as the centre of a cluster, at most.
const MAX_CENTRES: usize = 200;

/// Clusters that are weighed against each other, at most.
pub const CLUSTERS: usize = 6;

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
    /// What its pair says for it, with the word of third scans.
    pub evidence: f64,
    /// What the hypothesis is worth to a rival: the same, or what the pair alone says if that is more. Third scans that are themselves
    /// misplaced can talk a score down, so a rival keeps its own word.
    pub doubt: f64,
    /// Log-odds that its pair alone gives it; of a member of a cluster, the most that the pair gives any pose there.
    pub alone: f64,
    /// Centroid of `in_b` in the frame of b, metres: where distances between poses are measured.
    pub(super) centroid: Vector3<f64>,
}

impl Proposal {
    /// Whether its pair has a voice of its own, and not only repeats what third scans say.
    #[must_use]
    pub fn has_own_voice(&self) -> bool {
        self.alone > OWN_VOICE
    }
}

/// The best cluster of proposals.
#[derive(Debug, Clone)]
pub struct Candidate {
    /// The centre of the cluster.
    pub a_from_b: Pose,
    /// Sum over edges of the best evidence in the cluster.
    pub support: f64,
    /// The same with what each pair says alone, where that is more: what the cluster weighs as a rival.
    pub doubt: f64,
    /// What the heaviest different cluster weighs as a rival.
    pub rival: f64,
    /// One proposal an edge, those in the cluster.
    pub members: Vec<Proposal>,
    /// A client decided it: nothing else is asked.
    pub decided: bool,
}

/// Stands for the support of a join that a client decided.
pub const DECIDED: f64 = 1e6;

impl Candidate {
    /// Whether more than one edge speaks for it, or a client.
    #[must_use]
    pub fn rests_on_several(&self) -> bool {
        self.decided || self.members.iter().filter(|member| member.evidence > LEAST_WORD).count() > 1
    }

    /// Support by pairs that have a voice of their own, or by a client: third scans that see the same surfaces repeat what one pair says.
    #[must_use]
    pub fn own_support(&self) -> f64 {
        let own = self.members.iter().filter(|member| member.has_own_voice());
        own.map(|member| member.evidence).sum()
    }

    /// Log-odds of its pairs by themselves, all together, without limit; those that doubt it take nothing away.
    #[must_use]
    pub fn alone(&self) -> f64 {
        self.members.iter().map(|member| member.alone.max(0.0)).sum()
    }

    /// The log-odds of the pair that is surest by itself.
    #[must_use]
    pub fn surest(&self) -> f64 {
        self.members.iter().map(|member| member.alone).fold(f64::NEG_INFINITY, f64::max)
    }

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
                let said = evidence(h.score);
                let doubt = evidence(h.score.max(h.hypothesis.logit));
                if doubt > LEAST_EVIDENCE {
                    let a_from_b = *a_from_local * motion * local_from_b;
                    found.push(Proposal {
                        a_from_b,
                        in_a,
                        in_b: *in_b,
                        in_a_from_in_b: motion,
                        evidence: said,
                        doubt,
                        alone: h.hypothesis.logit,
                        centroid,
                    });
                }
            }
        }
    }
    found.sort_by(|x, y| y.evidence.total_cmp(&x.evidence).then((x.in_a, x.in_b).cmp(&(y.in_a, y.in_b))));
    found
}

/// Clusters the proposals between two components, the best supported first; every one differs from those before it by more than
/// the rival distance. `voxel` in metres.
#[must_use]
pub fn candidates(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    voxel: f64,
    options: &MappingOptions,
    most: usize,
) -> Vec<Candidate> {
    if let Some(join) = options.decisions.join_between(graph, a, b) {
        return vec![decided(&join, graph, b)];
    }
    let mut proposals = proposals(graph, a, b);
    if options.decisions.forbid_any() {
        proposals.retain(|p| !options.decisions.forbids(graph, a, b, &p.a_from_b, options));
    }
    if !proposals.is_empty()
        && let Some(gravity) = Gravity::between(graph, a, b)
    {
        proposals.retain(|p| gravity.admits(&p.a_from_b));
    }
    let reach = options.cluster_voxels * voxel;
    let sums = |centre: usize| {
        members(&proposals, centre, options.cluster_angle, reach)
            .fold((0.0, 0.0), |(evidence, doubt), p| (evidence + p.evidence, doubt + p.doubt))
    };
    let clusters: Vec<(f64, f64, usize)> = centres(&proposals)
        .into_iter()
        .map(|centre| {
            let (evidence, doubt) = sums(centre);
            (evidence, doubt, centre)
        })
        .collect();
    let differ = |x: usize, y: usize| {
        let (x, y, apart) = (&proposals[x], &proposals[y], options.rival_voxels * voxel);
        !within(x, y, options.rival_angle, apart) || !within(y, x, options.rival_angle, apart)
    };
    let mut kept: Vec<(f64, f64, usize)> = Vec::new();
    // First the best supported, then those that are most to be feared.
    for (room, weight) in [(most.div_ceil(2), 0), (most, 1)] {
        let mut ranked = clusters.clone();
        let of = |c: &(f64, f64, usize)| if weight == 0 { c.0 } else { c.1 };
        ranked.sort_by(|x, y| of(y).total_cmp(&of(x)).then(x.2.cmp(&y.2)));
        for cluster in ranked {
            if kept.len() < room && kept.iter().all(|k| differ(k.2, cluster.2)) {
                kept.push(cluster);
            }
        }
    }
    kept.sort_by(|x, y| y.0.total_cmp(&x.0).then(x.2.cmp(&y.2)));
    let rival_of = |centre: usize| {
        let others = clusters.iter().filter(|(_, _, c)| differ(centre, *c));
        others.map(|(_, doubt, _)| *doubt).fold(0.0, f64::max)
    };
    kept.into_iter()
        .map(|(support, doubt, centre)| Candidate {
            a_from_b: proposals[centre].a_from_b,
            support,
            doubt,
            rival: rival_of(centre),
            members: with_surest(&proposals, centre, options.cluster_angle, reach),
            decided: false,
        })
        .collect()
}

/// The best supported candidate. `None` without proposals.
#[must_use]
pub fn best_candidate(
    graph: &ScanGraph,
    a: &Component,
    b: &Component,
    voxel: f64,
    options: &MappingOptions,
) -> Option<Candidate> {
    candidates(graph, a, b, voxel, options, 1).into_iter().next()
}

/// The proposals around which clusters are sought: those of most evidence, and those that are most to be feared as rivals. Ascending.
fn centres(proposals: &[Proposal]) -> BTreeSet<usize> {
    let mut by_doubt: Vec<usize> = (0..proposals.len()).collect();
    by_doubt.sort_by(|x, y| proposals[*y].doubt.total_cmp(&proposals[*x].doubt).then(x.cmp(y)));
    (0..proposals.len().min(MAX_CENTRES)).chain(by_doubt.into_iter().take(MAX_CENTRES / 2)).collect()
}

fn decided(join: &DecidedJoin, graph: &ScanGraph, b: &Component) -> Candidate {
    let place = |pose: &Pose| graph.scan(join.in_b).map(|scan| pose.transform(&scan.centroid));
    let member = Proposal {
        a_from_b: join.a_from_b,
        in_a: join.in_a,
        in_b: join.in_b,
        in_a_from_in_b: join.in_a_from_in_b,
        evidence: DECIDED,
        doubt: DECIDED,
        alone: DECIDED,
        centroid: b.poses.get(&join.in_b).and_then(place).unwrap_or_default(),
    };
    Candidate {
        a_from_b: join.a_from_b,
        support: DECIDED,
        doubt: DECIDED,
        rival: 0.0,
        members: vec![member],
        decided: true,
    }
}

/// What edges between two components say for a pose that is already known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Backing {
    /// Sum over edges of the evidence.
    pub support: f64,
    /// Edges that say something.
    pub edges: usize,
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
) -> Backing {
    let mut proposals = proposals(graph, a, b);
    for p in &mut proposals {
        // The known pose stands in as the centre, seen from each proposal's own scan.
        if !agree(a_from_b, &p.a_from_b, &p.centroid, options.cluster_angle, options.cluster_voxels * voxel) {
            p.evidence = 0.0;
        }
    }
    let mut backing = Backing { support: 0.0, edges: 0 };
    for p in best_by_edge(proposals.iter()) {
        backing.support += p.evidence;
        backing.edges += usize::from(p.evidence > LEAST_WORD);
    }
    backing
}

/// The members of a cluster, each with the surest word that its pair has there by itself.
fn with_surest(proposals: &[Proposal], centre: usize, angle: f64, reach: f64) -> Vec<Proposal> {
    let mut surest: BTreeMap<(ScanKey, ScanKey), f64> = BTreeMap::new();
    for p in proposals.iter().filter(|p| within(&proposals[centre], p, angle, reach)) {
        let known = surest.entry((p.in_a, p.in_b)).or_insert(p.alone);
        *known = known.max(p.alone);
    }
    let alone = |p: &Proposal| surest.get(&(p.in_a, p.in_b)).copied().unwrap_or(p.alone);
    members(proposals, centre, angle, reach).map(|p| Proposal { alone: alone(p), ..*p }).collect()
}

/// One proposal an edge: those that agree with the centre, the strongest of each edge.
fn members(proposals: &[Proposal], centre: usize, angle: f64, reach: f64) -> impl Iterator<Item = &Proposal> {
    let centre = &proposals[centre];
    best_by_edge(proposals.iter().filter(move |p| within(centre, p, angle, reach)))
}

/// The first proposal of each edge in the order given. Proposals come strongest first.
fn best_by_edge<'p>(proposals: impl Iterator<Item = &'p Proposal>) -> impl Iterator<Item = &'p Proposal> {
    let mut seen = BTreeSet::new();
    let kept: Vec<&Proposal> = proposals.filter(|p| seen.insert((p.in_a, p.in_b))).collect();
    kept.into_iter()
}

/// Whether a pose between two components agrees with a proposal. `voxel` in metres.
#[must_use]
pub fn near(a_from_b: &Pose, proposal: &Proposal, voxel: f64, options: &MappingOptions) -> bool {
    let reach = options.cluster_voxels * voxel;
    agree(a_from_b, &proposal.a_from_b, &proposal.centroid, options.cluster_angle, reach)
}

/// Whether two poses of a component put one of its scans at different places, as rivals are. `voxel` in metres.
#[must_use]
pub fn moved(
    graph: &ScanGraph,
    part: &Component,
    x: &Pose,
    y: &Pose,
    voxel: f64,
    options: &MappingOptions,
) -> bool {
    part.poses.iter().any(|(scan, pose)| {
        graph.scan(*scan).is_some_and(|scan| {
            let (angle, distance) = centred_difference(&(*x * *pose), &(*y * *pose), &scan.centroid);
            angle > options.rival_angle || distance > options.rival_voxels * voxel
        })
    })
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
