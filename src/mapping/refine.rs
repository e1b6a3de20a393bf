//! Refinement of one component: bundle adjustment over landmarks (local and global), the pose graph with graduated
//! non-convexity, and the joint dense adjustment.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::component::Component;
use super::options::MappingOptions;
use super::surfaces::ComponentSurfaces;
use super::tracks::{TrackObservation, aggregate};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control, Stage};
use crate::geometry::{Kernel, Pose};
use crate::graph::{ScanGraph, softplus};
use crate::optimize::{
    BundleError, BundleOptions, DenseError, DenseOptions, DenseProblem, EdgeMetric, MinimiseError,
    Observation, PoseEdge, PoseGraphError, PoseGraphOptions, Report, Track, adjust_bundle, adjust_dense,
    adjust_pose_graph,
};
use crate::pairwise::centred_difference;

/// Points of each scan in each overlapping pair of a dense adjustment.
pub const DENSE_POINTS: usize = 1000;
/// Last gate of the dense adjustment in voxels, and gate of its held-out measure.
const LAST_GATE_VOXELS: f64 = 1.6;
pub const HELD_OUT_GATE_VOXELS: f64 = 2.0;
/// The weight of landmarks beside surfaces, at least, for surfaces that fit far better than keypoints repeat, and at most.
const LANDMARK_WEIGHTS: (f64, f64) = (0.01, 1.0);
/// Scale of the robust loss on landmark distances, in voxels.
const LANDMARK_KERNEL_VOXELS: f64 = 1.0;
/// Rounds of adjust, complete, merge, filter in a global bundle adjustment …
const GLOBAL_ROUNDS: usize = 5;
/// … until fewer than this share of the observations change.
const CHANGED_SHARE: f64 = 0.0005;

/// How far from right an adjustment expects the poses to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reach {
    /// Scale at which the pose graph believes an edge, in voxels.
    pose_graph_voxels: f64,
    /// First gate of the dense adjustment, in voxels.
    first_gate_voxels: f64,
    /// An edge takes part in the pose graph up to this many times as far from the poses as what makes a rival.
    edge_rivals: f64,
}

impl Reach {
    /// A little off, as a model is that only grew.
    pub const NEAR: Self = Self { pose_graph_voxels: 1.6, first_gate_voxels: 4.0, edge_rivals: 1.0 };
    /// Bent by accumulated errors of edges, each small: edges share them out instead of breaking at one, and an edge that closes a loop
    /// takes part however far the errors around the loop have carried its ends.
    pub const FAR: Self = Self { pose_graph_voxels: 8.0, first_gate_voxels: 16.0, edge_rivals: 3.0 };
}

/// The scans of a component by index, as the optimisers count them.
struct Indexed {
    keys: Vec<ScanKey>,
    poses: Vec<Pose>,
    index: BTreeMap<ScanKey, usize>,
}

impl Indexed {
    fn new(component: &Component) -> Self {
        let keys: Vec<ScanKey> = component.poses.keys().copied().collect();
        let index = keys.iter().enumerate().map(|(i, key)| (*key, i)).collect();
        Self { poses: component.poses.values().copied().collect(), keys, index }
    }

    fn held_but(&self, free: impl Fn(&ScanKey) -> bool) -> Vec<bool> {
        self.keys.iter().map(|key| !free(key)).collect()
    }

    fn tracks(&self, component: &Component, keep: impl Fn(&[TrackObservation]) -> bool) -> Vec<Track> {
        component
            .tracks
            .iter()
            .filter(|landmark| keep(&landmark.observations))
            .map(|landmark| Track {
                observations: landmark
                    .observations
                    .iter()
                    .filter_map(|o| {
                        let scan = *self.index.get(&o.scan)?;
                        Some(Observation { scan, point_in_scan: o.point_in_scan, weight: 1.0 })
                    })
                    .collect(),
                held_landmark: None,
            })
            .collect()
    }
}

fn write_back(component: &mut Component, keys: &[ScanKey], poses: &[Pose]) {
    for (key, pose) in keys.iter().zip(poses) {
        component.poses.insert(*key, pose.renormalised());
    }
}

/// The scan and its most covisible neighbours: what a local adjustment moves.
#[must_use]
pub fn neighborhood(component: &Component, scan: ScanKey, options: &MappingOptions) -> Vec<ScanKey> {
    let mut covisible: BTreeMap<ScanKey, usize> = BTreeMap::new();
    for landmark in component.tracks.iter() {
        if landmark.observations.iter().any(|o| o.scan == scan) {
            for o in &landmark.observations {
                *covisible.entry(o.scan).or_default() += 1;
            }
        }
    }
    covisible.remove(&scan);
    let mut ranked: Vec<(usize, ScanKey)> = covisible.into_iter().map(|(key, count)| (count, key)).collect();
    ranked.sort_by(|x, y| y.0.cmp(&x.0).then(x.1.cmp(&y.1)));
    let mut free: Vec<ScanKey> = ranked.iter().take(options.local_neighbors).map(|(_, key)| *key).collect();
    free.push(scan);
    free
}

/// Local bundle adjustment: the scan and its most covisible neighbours vary with the tracks they share, all else is held.
pub fn local_bundle_adjustment(
    component: &mut Component,
    scan: ScanKey,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<(), Cancelled> {
    let _adjusting = control.begin(Stage::BundleAdjustment);
    let gauge = component.gauge;
    let free = neighborhood(component, scan, options);
    let indexed = Indexed::new(component);
    let held = indexed.held_but(|key| free.contains(key) && *key != gauge);
    let tracks =
        indexed.tracks(component, |observations| observations.iter().any(|o| free.contains(&o.scan)));
    let kernel = Kernel::Cauchy(LANDMARK_KERNEL_VOXELS * voxel);
    let bundle = BundleOptions { kernel, ..BundleOptions::default() };
    match adjust_bundle(&indexed.poses, &tracks, &held, &bundle, control) {
        Ok(adjusted) => write_back(component, &indexed.keys, &adjusted.poses),
        Err(BundleError::Minimise(MinimiseError::Cancelled(cancelled))) => return Err(cancelled),
        // Too few landmarks hold the scan: its pose from the join stays.
        Err(_) => {}
    }
    Ok(())
}

/// Global bundle adjustment: rounds of adjusting all poses, completing and merging tracks, and filtering observations. `None`
/// when there is nothing to adjust.
pub fn global_bundle_adjustment(
    graph: &ScanGraph,
    component: &mut Component,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<Report>, Cancelled> {
    let _adjusting = control.begin(Stage::BundleAdjustment);
    let tolerance = options.track_voxels * voxel;
    let mut last = None;
    for round in 0..GLOBAL_ROUNDS {
        // Robust first, against what filtering has not seen yet; then plain least squares.
        let kernel =
            if round == 0 { Kernel::Cauchy(LANDMARK_KERNEL_VOXELS * voxel) } else { Kernel::Squared };
        match adjust_landmarks(component, kernel, control)? {
            Some(report) => last = Some(report),
            None => break,
        }
        let before = component.tracks.observations();
        let dropped = component.tracks.filter(&component.poses, tolerance, options.track_length);
        let linked = component.complete_tracks(graph, options);
        if ((dropped + linked) as f64) < CHANGED_SHARE * before as f64 {
            break;
        }
    }
    Ok(last)
}

/// One adjustment of all poses of a component to its landmarks.
pub fn adjust_landmarks(
    component: &mut Component,
    kernel: Kernel,
    control: Control<'_>,
) -> Result<Option<Report>, Cancelled> {
    let indexed = Indexed::new(component);
    let gauge = component.gauge;
    let held = indexed.held_but(|key| *key != gauge);
    let tracks = indexed.tracks(component, |_| true);
    let bundle = BundleOptions { kernel, ..BundleOptions::default() };
    match adjust_bundle(&indexed.poses, &tracks, &held, &bundle, control) {
        Ok(adjusted) => {
            write_back(component, &indexed.keys, &adjusted.poses);
            Ok(Some(adjusted.report))
        }
        Err(BundleError::Minimise(MinimiseError::Cancelled(cancelled))) => Err(cancelled),
        Err(_) => Ok(None),
    }
}

/// Pose graph over the edges that agree with the component, with graduated non-convexity: spreads loop errors before surfaces can
/// lock on.
pub fn pose_graph(
    graph: &ScanGraph,
    component: &mut Component,
    reach: Reach,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<(), Cancelled> {
    let _adjusting = control.begin(Stage::DenseRefinement);
    let indexed = Indexed::new(component);
    let mut edges = Vec::new();
    for edge in graph.edges() {
        let (Some(&i), Some(&j)) = (indexed.index.get(&edge.pair.a), indexed.index.get(&edge.pair.b)) else {
            continue;
        };
        let Some(b) = graph.scan(edge.pair.b) else { continue };
        let now = indexed.poses[i].inverse() * indexed.poses[j];
        let (most_angle, most_distance) =
            (reach.edge_rivals * options.rival_angle, reach.edge_rivals * options.rival_voxels * voxel);
        let agreeing = edge.hypotheses.iter().find(|h| {
            let (angle, distance) = centred_difference(&h.hypothesis.a_from_b, &now, &b.centroid);
            angle < most_angle && distance < most_distance
        });
        if let Some(h) = agreeing.filter(|h| h.score > 0.0) {
            edges.push(PoseEdge {
                i,
                j,
                i_from_j: h.hypothesis.a_from_b,
                centroid_in_j: Vector3::new(b.centroid.x, b.centroid.y, b.centroid.z),
                weight: softplus(h.score) * f64::from(h.hypothesis.evidence.both().inliers).sqrt(),
                metric: EdgeMetric::LeverArm(b.rms_radius),
            });
        }
    }
    let gauge = component.gauge;
    let held = indexed.held_but(|key| *key != gauge);
    let settings = PoseGraphOptions::with_final_scale(reach.pose_graph_voxels * voxel);
    match adjust_pose_graph(&indexed.poses, &edges, &held, &settings, control) {
        Ok(adjusted) => write_back(component, &indexed.keys, &adjusted.poses),
        Err(PoseGraphError::Minimise(MinimiseError::Cancelled(cancelled))) => return Err(cancelled),
        // Without believable edges the poses of the joins stay.
        Err(_) => {}
    }
    Ok(())
}

/// Joint dense adjustment of all overlapping pairs and the landmarks. With `free`, only those scans move and only
/// their pairs count. How the last round ended; `None` when nothing overlaps or the adjustment fails, and the poses stay.
pub fn dense(
    graph: &ScanGraph,
    component: &mut Component,
    free: Option<&[ScanKey]>,
    reach: Reach,
    voxel: f64,
    control: Control<'_>,
) -> Result<Option<Report>, Cancelled> {
    let _adjusting = control.begin(Stage::DenseRefinement);
    let indexed = Indexed::new(component);
    let is_free = |key: &ScanKey| free.is_none_or(|free| free.contains(key));
    let surfaces = ComponentSurfaces::new(graph, component, is_free, DENSE_POINTS);
    let gauge = component.gauge;
    let held = indexed.held_but(|key| *key != gauge && is_free(key));
    let tracks = indexed.tracks(component, |observations| observations.iter().any(|o| is_free(&o.scan)));
    let surface_rms = surfaces.held_out_rms(&indexed.poses, HELD_OUT_GATE_VOXELS * voxel);
    let seen = component.tracks.iter().map(|landmark| landmark.observations.as_slice());
    let seen = seen.filter(|observations| observations.iter().any(|o| is_free(&o.scan)));
    let settings = DenseOptions {
        landmark_weight: landmark_weight(seen, &component.poses, surface_rms),
        ..DenseOptions::with_gates(reach.first_gate_voxels * voxel, LAST_GATE_VOXELS * voxel)
    };
    let problem = DenseProblem { poses: &indexed.poses, held: &held, surfaces: &surfaces, tracks: &tracks };
    match adjust_dense(&problem, &settings, control) {
        Ok(adjusted) => {
            write_back(component, &indexed.keys, &adjusted.poses);
            Ok(adjusted.rounds.last().map(|round| round.report))
        }
        Err(DenseError::Minimise(MinimiseError::Cancelled(cancelled))) => Err(cancelled),
        Err(_) => Ok(None),
    }
}

/// What an observation of a landmark weighs against a correspondence of surfaces: the variance of the distances of surfaces, whose root mean square
/// is given (metres), over that of observations from their landmark, along an axis. Rigid scans of a good scanner lie on each other far better
/// than keypoints repeat; where scans are bent, as those that were fused while a camera moved, one overlap's surfaces pull them together there and
/// apart elsewhere, and landmarks are the better guide.
fn landmark_weight<'t>(
    landmarks: impl Iterator<Item = &'t [TrackObservation]>,
    poses: &BTreeMap<ScanKey, Pose>,
    surface_rms: f64,
) -> f64 {
    let (mut squares, mut freedom) = (0.0, 0.0);
    for observations in landmarks {
        let Some(mean) = aggregate(observations, poses) else { continue };
        let apart = |o: &TrackObservation| poses[&o.scan].transform(&o.point_in_scan) - mean;
        squares += observations.iter().map(|o| apart(o).norm_squared()).sum::<f64>();
        freedom += 3.0 * (observations.len() as f64 - 1.0);
    }
    let (least, most) = LANDMARK_WEIGHTS;
    let ratio = surface_rms * surface_rms * freedom / squares;
    if ratio.is_nan() { least } else { ratio.clamp(least, most) }
}

/// Held-out RMS of a component as it stands, metres.
#[must_use]
pub fn held_out(graph: &ScanGraph, component: &Component, voxel: f64) -> f64 {
    let poses: Vec<Pose> = component.poses.values().copied().collect();
    ComponentSurfaces::new(graph, component, |_| true, DENSE_POINTS)
        .held_out_rms(&poses, HELD_OUT_GATE_VOXELS * voxel)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn landmarks_weigh_what_their_spread_is_worth_against_that_of_surfaces() {
        let poses = [Pose::identity(), Pose::from_translation(Vector3::new(1.0, -2.0, 3.0))];
        // Two observations of each landmark, 20 cm apart along one axis: a variance of 1/150 m^2 along an axis.
        let observed = |k: usize| {
            let point: Vector3<f64> = Vector3::new(k as f64, 2.0, -1.0);
            let mut apart = Vector3::zeros();
            apart[k % 3] = 0.2;
            let in_scans = [point, poses[1].inverse().transform(&(point + apart))];
            let observation =
                |(scan, point_in_scan)| TrackObservation { scan, keypoint: k as u16, point_in_scan };
            [1, 2].map(ScanKey).into_iter().zip(in_scans).map(observation).collect::<Vec<_>>()
        };
        let landmarks: Vec<Vec<TrackObservation>> = (0..30).map(observed).collect();
        let poses = [1, 2].map(ScanKey).into_iter().zip(poses).collect();
        let weight = |rms: f64| landmark_weight(landmarks.iter().map(Vec::as_slice), &poses, rms);
        assert!((weight(0.02) - 0.0004 * 150.0).abs() < 1e-9, "{}", weight(0.02));
        let (least, most) = LANDMARK_WEIGHTS;
        assert_eq!(weight(1e-4), least);
        assert_eq!(weight(1.0), most);
        assert_eq!(landmark_weight(std::iter::empty(), &poses, 0.02), least, "there is nothing to weigh");
    }
}
