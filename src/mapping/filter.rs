//! Filtering: scans that belong elsewhere by now are taken out and may register again.

use super::candidates::{best_candidate, support_of};
use super::component::Component;
use super::mapper::Mapper;
use super::options::MappingOptions;
use super::tracks::Tracks;
use crate::cloud::ScanKey;
use crate::control::{Cancelled, Control};
use crate::geometry::Pose;
use crate::graph::ScanGraph;
use crate::pairwise::centred_difference;

/// A scan is filtered at most this often while the model does not forget.
const MAX_FILTERED: usize = 2;
/// A scan is filtered only from components of at least this many scans.
const FILTER_FROM: usize = 4;
/// … and only if another place has this much more support than the one it has.
const FILTER_MARGIN: f64 = 2.0;

impl Mapper {
    /// Filtering: takes out scans that have clearly more support at another pose than at their own. They wait, and may register
    /// again. Returns how many.
    pub fn filter_scans(
        &mut self,
        graph: &ScanGraph,
        voxel: f64,
        options: &MappingOptions,
        control: Control<'_>,
    ) -> Result<usize, Cancelled> {
        let mut misplaced: Vec<ScanKey> = Vec::new();
        for component in self.components.iter().filter(|c| c.len() >= FILTER_FROM) {
            // Poses are all that is asked of the rest.
            let mut rest = Component {
                gauge: component.gauge,
                poses: component.poses.clone(),
                tracks: Tracks::default(),
            };
            for (scan, pose) in &component.poses {
                control.check()?;
                if self.filtered.get(scan).copied().unwrap_or(0) >= MAX_FILTERED {
                    continue;
                }
                let single = Component::single(*scan);
                rest.poses.remove(scan);
                let best = best_candidate(graph, &rest, &single, voxel, options);
                let own = support_of(graph, &rest, &single, pose, voxel, options).support;
                rest.poses.insert(*scan, *pose);
                if best.is_some_and(|best| {
                    best.support > own + FILTER_MARGIN
                        && differs(&best.a_from_b, pose, *scan, graph, voxel, options)
                }) {
                    misplaced.push(*scan);
                }
            }
        }
        for scan in &misplaced {
            *self.filtered.entry(*scan).or_default() += 1;
            for component in &mut self.components {
                component.remove(*scan, options);
            }
            self.add_waiting(*scan);
        }
        self.dissolve_small();
        Ok(misplaced.len())
    }
}

fn differs(
    x: &Pose,
    y: &Pose,
    scan: ScanKey,
    graph: &ScanGraph,
    voxel: f64,
    options: &MappingOptions,
) -> bool {
    let Some(scan) = graph.scan(scan) else { return false };
    let (angle, distance) = centred_difference(x, y, &scan.centroid);
    angle > options.rival_angle || distance > options.rival_voxels * voxel
}
