//! The surfaces of a scan at half its voxel, for close looks: what tells a right pose from one that only looks right is often
//! smaller than a voxel. Its points are kept packed, and unpacked where poses of a pair may be right, joins are weighed or pairs that contradict are heard.

use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use super::prepared::{PreparedScan, Scan};
use super::range_image::RangeImage;
use crate::geometry::Point;

/// A direction of length 1 in packed form.
const UNIT: f32 = 127.0;
/// Steps that a coordinate can make.
const STEPS: f32 = 65_535.0;
/// A step is at most this share of the fine voxel, or packing would show.
const LARGEST_STEP: f32 = 1.0 / 32.0;
/// Points on it, at most: as many voxels as a scan may fill.
const MOST: usize = super::prepared::MAX_POINTS;

/// Points with normals in ten bytes each, and what the sensor saw, all at half the voxel of the scan.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct FineSurface {
    /// Least coordinates, metres, local frame.
    low: Point,
    /// A step of a packed coordinate, metres.
    step: f32,
    surfels: Vec<PackedSurfel>,
    range_image: RangeImage,
}

/// A point in steps from the lowest, and the direction that its surface faces.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct PackedSurfel {
    position: [u16; 3],
    normal: [i8; 3],
}

impl FineSurface {
    /// Packs points (metres, local frame) with their unit normals: positions in steps of 1 / 65,535 of the longest edge of their box,
    /// normals to half a degree. `None` without points, with far too many, and where something lies so far off that a step would be more
    /// than 1/32 of the fine voxel (`resolution`, metres).
    #[must_use]
    pub fn new(
        points: &[Point],
        normals: &[Point],
        range_image: RangeImage,
        resolution: f32,
    ) -> Option<Self> {
        let least = |k: usize| points.iter().map(|p| p[k]).fold(f32::INFINITY, f32::min);
        let most = |k: usize| points.iter().map(|p| p[k]).fold(f32::NEG_INFINITY, f32::max);
        let low: Point = std::array::from_fn(least);
        let longest = (0..3).map(|k| most(k) - low[k]).fold(0.0, f32::max);
        let step = (longest / STEPS).max(f32::MIN_POSITIVE);
        if points.is_empty() || points.len() > MOST || step > LARGEST_STEP * resolution {
            return None;
        }
        let surfels = points.iter().zip(normals).map(|(point, normal)| PackedSurfel {
            position: std::array::from_fn(|k| ((point[k] - low[k]) / step).round() as u16),
            normal: normal.map(|x| (x * UNIT).round() as i8),
        });
        Some(Self { low, step, surfels: surfels.collect(), range_image })
    }

    /// Points on it.
    #[must_use]
    pub fn count(&self) -> usize {
        self.surfels.len()
    }

    /// The same scan with these surfaces, without keypoints and all that belongs to them.
    fn unpack(&self, of: &PreparedScan) -> Scan {
        let (points, normals): (Vec<Point>, Vec<Point>) = self
            .surfels
            .iter()
            .map(|surfel| {
                let normal = surfel.normal.map(f32::from);
                let length = normal.iter().map(|x| x * x).sum::<f32>().sqrt().max(1.0);
                let point: Point =
                    std::array::from_fn(|k| self.low[k] + f32::from(surfel.position[k]) * self.step);
                (point, normal.map(|x| x / length))
            })
            .unzip();
        Scan::new(PreparedScan {
            resolution: of.resolution / 2.0,
            origin: of.origin,
            points,
            normals,
            range_image: Some(self.range_image.clone()),
            viewpoint: of.viewpoint,
            hidden_share: of.hidden_share,
            up: of.up,
            ..PreparedScan::empty(of.key)
        })
    }
}

/// A scan's finer self, from when it is first asked for until it is forgotten. Clones start without.
#[derive(Debug, Default)]
pub(super) struct Unpacked(Mutex<Option<Arc<Scan>>>);

impl Clone for Unpacked {
    fn clone(&self) -> Self {
        Self::default()
    }
}

impl Unpacked {
    /// The finer scan; `None` where the data are no finer.
    pub fn get(&self, prepared: &PreparedScan) -> Option<Arc<Scan>> {
        let surface = prepared.fine.as_ref()?;
        let known = self.0.lock().unwrap_or_else(PoisonError::into_inner).clone();
        // Two threads may unpack it at once, and come to the same.
        Some(known.unwrap_or_else(|| {
            let scan = Arc::new(surface.unpack(prepared));
            *self.0.lock().unwrap_or_else(PoisonError::into_inner) = Some(Arc::clone(&scan));
            scan
        }))
    }

    /// Whether it is in memory.
    pub fn is_held(&self) -> bool {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).is_some()
    }

    /// Gives its memory back.
    pub fn forget(&self) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = None;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{PointCloud, ScanKey};
    use crate::control::{CancelToken, Control, Seed, Silent};
    use crate::features::{PrepareOptions, SensorPosition, prepare};

    /// A closed box of 3 m by 3 m by 3 m around the origin with a point every 5 cm, at a resolution in metres, for a scanner that is said to
    /// have stood at a place.
    fn room(resolution: f64, sensor: [f64; 3]) -> PreparedScan {
        let mut cloud = PointCloud::default();
        let along = |i: usize| 0.05 * i as f32 - 1.475;
        for (k, i, j) in (0..3).flat_map(|k| (0..3600).map(move |at| (k, at / 60, at % 60))) {
            for side in [-1.5, 1.5] {
                let mut point = [side; 3];
                (point[(k + 1) % 3], point[(k + 2) % 3]) = (along(i), along(j));
                cloud.points.push(point);
            }
        }
        let token = CancelToken::new();
        let control = Control { cancel: &token, observer: &Silent };
        let options = PrepareOptions::at(resolution, Seed(0));
        prepare(ScanKey(1), &cloud, SensorPosition::Known(sensor), &options, control).expect("a room")
    }

    #[test]
    fn only_what_is_dense_at_half_the_voxel_and_seen_from_its_sensor_has_finer_surfaces() {
        let dense = room(0.2, [0.0; 3]);
        let finer = dense.fine.as_ref().expect("a point every 5 cm fills voxels of 10 cm");
        assert!(dense.range_image.is_some() && finer.count() > 3 * dense.points.len());
        let sparse = room(0.05, [0.0; 3]);
        assert!(sparse.range_image.is_some() && sparse.fine.is_none(), "nothing is finer than its points");
        let unseen = room(0.2, [9.0, 8.0, 7.0]);
        assert!(unseen.range_image.is_none() && unseen.fine.is_none(), "hidden {}", unseen.hidden_share);
    }

    #[test]
    fn what_is_forgotten_gives_its_memory_back_and_is_unpacked_anew() {
        let scan = Scan::new(room(0.2, [0.0; 3]));
        let first = scan.fine().expect("the room is dense");
        assert!(Arc::ptr_eq(&first, &scan.fine().expect("it is kept")));
        let (points, held) = (first.prepared.points.clone(), Arc::downgrade(&first));
        drop(first);
        assert!(held.upgrade().is_some(), "it is kept for whoever asks next");
        assert!(scan.is_unpacked());
        scan.forget_fine();
        assert!(!scan.is_unpacked());
        assert!(held.upgrade().is_none(), "nobody holds it any more");
        let again = scan.fine().expect("the room is as dense as before");
        assert_eq!(again.prepared.points, points);
        assert!(!Arc::ptr_eq(&again, &scan.clone().fine().expect("a clone unpacks its own")));
    }

    #[test]
    fn what_is_packed_comes_out_as_it_went_in() {
        let points: Vec<Point> = (0..3000)
            .map(|i| {
                let i = i as f32;
                [(0.37 * i).sin() * 9.0 - 3.0, (0.11 * i).cos() * 4.0 + 100.0, 0.001 * i]
            })
            .collect();
        let normals: Vec<Point> = points
            .iter()
            .map(|p| {
                let length = p.iter().map(|x| x * x).sum::<f32>().sqrt();
                p.map(|x| x / length)
            })
            .collect();
        let (image, _) = RangeImage::render(&points, [0.0; 3], 0.1);
        let surface = FineSurface::new(&points, &normals, image, 0.1).expect("a step is small");
        let of = PreparedScan { resolution: 0.2, ..PreparedScan::empty(ScanKey(1)) };
        let scan = surface.unpack(&of);
        assert!((scan.prepared.resolution - 0.1).abs() < 1e-12);
        for (i, (point, normal)) in points.iter().zip(&normals).enumerate() {
            for k in 0..3 {
                assert!((point[k] - scan.prepared.points[i][k]).abs() < 0.51 * 18.0 / STEPS);
                assert!((normal[k] - scan.prepared.normals[i][k]).abs() < 0.01);
            }
        }
    }

    #[test]
    fn what_cannot_be_packed_well_is_not_packed() {
        let (image, _) = RangeImage::render(&[[1.0, 0.0, 0.0]], [0.0; 3], 0.1);
        let of = PreparedScan { resolution: 0.2, ..PreparedScan::empty(ScanKey(1)) };
        assert!(FineSurface::new(&[], &[], image.clone(), 0.1).is_none());
        let one = FineSurface::new(&[[1.0, 2.0, 3.0]], &[[0.0, 0.0, 1.0]], image.clone(), 0.1);
        assert_eq!(one.expect("one point").unpack(&of).prepared.points, [[1.0, 2.0, 3.0]]);
        // A stray point 5 km off would leave steps of 8 cm.
        let stray = [[0.0; 3], [5000.0, 0.0, 0.0]];
        assert!(FineSurface::new(&stray, &[[0.0, 0.0, 1.0]; 2], image, 0.1).is_none());
    }
}
