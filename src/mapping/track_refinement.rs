//! Track refinement: keypoints are samples of a surface, so two of them that show "the same point" differ by the sampling gap. Around
//! each keypoint of a track lies a patch; the point of the reference patch that is found again best in all other patches, by
//! point-wise features, becomes the landmark, and in every patch the best-scoring point with its neighbours the refined
//! keypoint. Then all poses are adjusted to the moved keypoints.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::component::Component;
use super::options::MappingOptions;
use super::refine::adjust_landmarks;
use super::tracks::{Landmark, TrackObservation, aggregate};
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::features::{Descriptor, Scan, fpfh};
use crate::geometry::{Kernel, NeighborIndex, Point};
use crate::graph::ScanGraph;
use crate::optimize::Report;

/// Radius of a patch, and of the features on its points, in voxels.
const PATCH_VOXELS: f32 = 2.5;
const FEATURE_VOXELS: f32 = 3.5;
/// Sharpness of the weights around the best-scoring point.
const SHARPNESS: f32 = 40.0;

/// The points of one scan with a feature each.
struct Features<'s> {
    scan: &'s Scan,
    descriptors: Vec<Descriptor>,
    index: NeighborIndex,
}

impl<'s> Features<'s> {
    fn new(scan: &'s Scan) -> Self {
        let points = &scan.prepared.points;
        let radius = FEATURE_VOXELS * scan.prepared.resolution as f32;
        Self {
            scan,
            descriptors: fpfh(points, &scan.prepared.normals, radius),
            index: NeighborIndex::new(points, PATCH_VOXELS * scan.prepared.resolution as f32),
        }
    }

    /// Points of the patch around a keypoint, the nearest first.
    fn patch(&self, keypoint: u16) -> Vec<usize> {
        let prepared = &self.scan.prepared;
        let at: Point = prepared.points[prepared.keypoints[keypoint as usize] as usize];
        let mut found = Vec::new();
        self.index.within(&at, PATCH_VOXELS * prepared.resolution as f32, |index, square| {
            found.push((square, index));
        });
        found.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        found.into_iter().map(|(_, index)| index).collect()
    }

    fn position(&self, index: usize) -> Vector3<f64> {
        Vector3::from(self.scan.prepared.points[index]).cast()
    }
}

/// Moves the keypoints of all tracks onto each other, then adjusts all poses. `None` when there is nothing to adjust.
pub fn refine_tracks(
    graph: &ScanGraph,
    component: &mut Component,
    voxel: f64,
    options: &MappingOptions,
    control: Control<'_>,
) -> Result<Option<Report>, Cancelled> {
    let features: BTreeMap<ScanKey, Features<'_>> = component
        .poses
        .par_iter()
        .filter_map(|(key, _)| graph.scan(*key).map(|scan| (*key, scan)))
        .map(|(key, scan)| {
            control.check()?;
            Ok((key, Features::new(scan)))
        })
        .collect::<Result<_, Cancelled>>()?;
    let poses = &component.poses;
    component.tracks.rebuild(|landmark| {
        let observations =
            refined(&landmark.observations, &features).unwrap_or_else(|| landmark.observations.clone());
        let position = aggregate(&observations, poses)?;
        Some(Landmark { position, observations })
    });
    control.check()?;
    adjust_landmarks(component, Kernel::Cauchy(voxel), control)?;
    component.tracks.filter(&component.poses, options.track_voxels * voxel, options.track_length);
    adjust_landmarks(component, Kernel::Squared, control)
}

/// The observations of one track with their points moved.
fn refined(
    observations: &[TrackObservation],
    features: &BTreeMap<ScanKey, Features<'_>>,
) -> Option<Vec<TrackObservation>> {
    let patches: Vec<(&Features<'_>, Vec<usize>)> = observations
        .iter()
        .map(|o| features.get(&o.scan).map(|f| (f, f.patch(o.keypoint))))
        .collect::<Option<_>>()?;
    // Every member is tried as the reference: its points are scored by how well all other patches show them.
    let mut best: Option<(f32, &Descriptor)> = None;
    for (reference, patch) in &patches {
        for &point in patch {
            let descriptor = &reference.descriptors[point];
            let score: f32 = patches.iter().map(|(f, patch)| best_in(f, patch, descriptor)).sum();
            if best.is_none_or(|(most, _)| score > most) {
                best = Some((score, descriptor));
            }
        }
    }
    let (_, target) = best?;
    let moved = observations
        .iter()
        .zip(&patches)
        .map(|(o, (f, patch))| {
            let top = best_in(f, patch, target);
            let mut sum = Vector3::zeros();
            let mut total = 0.0;
            for &point in patch {
                let weight = f64::from((SHARPNESS * (dot(&f.descriptors[point], target) - top)).exp());
                sum += weight * f.position(point);
                total += weight;
            }
            TrackObservation { point_in_scan: sum / total, ..*o }
        })
        .collect();
    Some(moved)
}

fn best_in(features: &Features<'_>, patch: &[usize], target: &Descriptor) -> f32 {
    patch.iter().map(|&point| dot(&features.descriptors[point], target)).fold(-1.0, f32::max)
}

fn dot(x: &Descriptor, y: &Descriptor) -> f32 {
    x.iter().zip(y).map(|(x, y)| x * y).sum()
}
