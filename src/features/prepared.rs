//! A scan made ready for matching: everything the pair and mapping layers read, in two forms. [`PreparedScan`] is plain data, to be
//! stored; [`Scan`] adds the lookup grid and its points as lookups read them, to be computed with.

use std::sync::{Arc, OnceLock};

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::color::thinned_colors;
use super::fine::{FineSurface, Unpacked};
use super::fpfh::{Descriptor, fpfh};
use super::keypoints::select_keypoints;
use super::planes::PlaneProfile;
use super::range_image::RangeImage;
use super::resolution::extent;
use super::sensor::{Stance, Surfaces, viewpoint};
use super::signature::signature;
use super::surfel::Surfel;
use crate::cloud::{PointCloud, ScanKey, face, normals};
use crate::control::{Cancelled, Control, Seed};
use crate::geometry::{NearestGrid, NeighborIndex, Point, Pose, voxel_centroids};

/// Fewest points with normals that can be registered.
const MIN_POINTS: usize = 200;
/// Most voxels a scan may fill: more means that the resolution does not fit the scan.
pub(super) const MAX_POINTS: usize = 400_000;
/// Radius of normals and of descriptors, in voxels.
const NORMAL_RADIUS: f32 = 2.0;
const DESCRIPTOR_RADIUS: f32 = 5.0;
/// Half the voxel must give this many times the points, or there is nothing finer to be seen.
const FINER: f64 = 1.6;

/// How scans are prepared. Scans of one model must be prepared with equal options.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PrepareOptions {
    /// The voxel size v from which every length scale derives, metres.
    pub resolution: f64,
    /// Root of the random choices.
    pub seed: Seed,
    /// Keypoints a scan, at most.
    pub keypoints: usize,
}

impl PrepareOptions {
    /// The defaults at a resolution in metres.
    #[must_use]
    pub fn at(resolution: f64, seed: Seed) -> Self {
        Self { resolution, seed, keypoints: 2000 }
    }
}

/// Why a scan cannot be prepared.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PrepareError {
    /// The resolution is no length.
    #[error("the resolution is {0} m, but must be positive and finite")]
    Resolution(f64),
    /// Too few points remain for any registration.
    #[error(
        "the scan has {found} distinct surface points at a resolution of {resolution} m; registration needs at least {needed}"
    )]
    TooFewPoints {
        /// Occupied voxels with a normal.
        found: usize,
        /// The least number.
        needed: usize,
        /// Voxel size, metres.
        resolution: f64,
    },
    /// Far too many voxels.
    #[error(
        "the scan fills {found} voxels at a resolution of {resolution} m, more than {limit}: the resolution is too fine for it"
    )]
    TooManyPoints {
        /// Occupied voxels.
        found: usize,
        /// The largest number.
        limit: usize,
        /// Voxel size, metres.
        resolution: f64,
    },
    /// Stopped by the caller.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
}

/// A scan made ready for matching: serialisable, and a pure function of (cloud, stance of the sensor, options).
///
/// Its points live in the *local* frame: the axes of the scan's own frame, shifted by `origin` so that single precision holds.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct PreparedScan {
    /// Which scan.
    pub key: ScanKey,
    /// Voxel size v, metres.
    pub resolution: f64,
    /// Where the local frame's origin lies in the scan's own frame, metres.
    pub origin: [f64; 3],
    /// One point a voxel, metres.
    pub points: Vec<Point>,
    /// Unit normals of `points`, facing the sensor.
    pub normals: Vec<Point>,
    /// Colours of `points`, red, green, blue; none where the file has none.
    pub colors: Vec<[u8; 3]>,
    /// Indices of the keypoints in `points`, ascending.
    pub keypoints: Vec<u32>,
    /// Descriptors of the keypoints, one after the other, each [`DESCRIPTOR_LEN`](super::DESCRIPTOR_LEN) long.
    pub descriptors: Vec<f32>,
    /// The global signature.
    pub signature: Vec<f32>,
    /// What the sensor saw, when its position is known well enough.
    pub range_image: Option<RangeImage>,
    /// Its surfaces at half the voxel, where that gives 1.6 times the points and more, and there is a range image.
    pub fine: Option<FineSurface>,
    /// Where the sensor stood, as far as known; normals face it. Metres, local frame.
    pub viewpoint: Point,
    /// Share of the points that are hidden from the viewpoint.
    pub hidden_share: f64,
    /// Against gravity, a unit vector in the axes of both frames, if somebody said.
    pub up: Option<[f64; 3]>,
}

impl PreparedScan {
    /// A scan of which nothing is known but who it is.
    #[must_use]
    pub fn empty(key: ScanKey) -> Self {
        Self {
            key,
            resolution: 0.0,
            origin: [0.0; 3],
            points: Vec::new(),
            normals: Vec::new(),
            colors: Vec::new(),
            keypoints: Vec::new(),
            descriptors: Vec::new(),
            signature: Vec::new(),
            range_image: None,
            fine: None,
            viewpoint: [0.0; 3],
            hidden_share: 0.0,
            up: None,
        }
    }

    /// As bytes for a blob.
    pub fn to_bytes(&self) -> Result<Vec<u8>, postcard::Error> {
        postcard::to_stdvec(self)
    }

    /// From the bytes of [`PreparedScan::to_bytes`].
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, postcard::Error> {
        postcard::from_bytes(bytes)
    }

    /// Maps the scan's own frame into the local frame of `points`.
    #[must_use]
    pub fn local_from_scan(&self) -> Pose {
        Pose::from_translation(-Vector3::from(self.origin))
    }
}

/// A prepared scan with what is computed with it.
#[derive(Debug, Clone)]
pub struct Scan {
    /// The data.
    pub prepared: PreparedScan,
    /// Its points with their normals, in their order.
    pub surfels: Vec<Surfel>,
    /// Nearest points by position.
    pub grid: NearestGrid,
    /// Mean of the points, metres, local frame.
    pub centroid: Vector3<f64>,
    /// Root mean square distance of the points from their mean, metres.
    pub rms_radius: f64,
    planes: OnceLock<Option<PlaneProfile>>,
    unpacked: Unpacked,
}

impl Scan {
    /// Builds the lookup structures.
    #[must_use]
    pub fn new(prepared: PreparedScan) -> Self {
        let grid = NearestGrid::new(&prepared.points, prepared.resolution as f32);
        let n = prepared.points.len().max(1) as f64;
        let position = |p: &Point| Vector3::from(*p).cast::<f64>();
        let centroid = prepared.points.iter().map(position).sum::<Vector3<f64>>() / n;
        let square = prepared.points.iter().map(|p| (position(p) - centroid).norm_squared()).sum::<f64>() / n;
        let surfels = Surfel::of_all(&prepared.points, &prepared.normals);
        Self {
            prepared,
            surfels,
            grid,
            centroid,
            rms_radius: square.sqrt(),
            planes: OnceLock::new(),
            unpacked: Unpacked::default(),
        }
    }

    /// Its planes, where its normals concentrate in three orthogonal directions; found when they are first asked for.
    #[must_use]
    pub fn planes(&self) -> Option<&PlaneProfile> {
        let PreparedScan { points, normals, resolution, .. } = &self.prepared;
        self.planes.get_or_init(|| PlaneProfile::of(points, normals, *resolution as f32)).as_ref()
    }

    /// The same scan at half the voxel, surfaces alone; `None` where the data are no finer. It stays in memory until
    /// [`Scan::forget_fine`].
    #[must_use]
    pub fn fine(&self) -> Option<Arc<Self>> {
        self.unpacked.get(&self.prepared)
    }

    /// Whether [`Scan::fine`] holds memory.
    #[must_use]
    pub fn is_unpacked(&self) -> bool {
        self.unpacked.is_held()
    }

    /// Gives back the memory that [`Scan::fine`] took.
    pub fn forget_fine(&self) {
        self.unpacked.forget();
    }

    /// Which scan.
    #[must_use]
    pub fn key(&self) -> ScanKey {
        self.prepared.key
    }

    /// Position of a keypoint, metres, local frame.
    #[must_use]
    pub fn keypoint(&self, index: usize) -> Vector3<f64> {
        Vector3::from(self.prepared.points[self.prepared.keypoints[index] as usize]).cast()
    }
}

/// Prepares one scan: voxels, normals towards the sensor, descriptors, keypoints, signature, range image.
pub fn prepare(
    key: ScanKey,
    cloud: &PointCloud,
    sensor: impl Into<Stance>,
    options: &PrepareOptions,
    control: Control<'_>,
) -> Result<PreparedScan, PrepareError> {
    let (resolution, stance) = (options.resolution, sensor.into());
    if !(resolution > 0.0 && resolution.is_finite()) {
        return Err(PrepareError::Resolution(resolution));
    }
    let v = resolution as f32;
    // Half-size voxels carry the normals and the range image: finer than the result, cheaper than the raw points.
    let fine = voxel_centroids(&cloud.points, v / 2.0);
    control.check()?;
    let coarse = voxel_centroids(&fine, v);
    if coarse.len() > MAX_POINTS {
        return Err(PrepareError::TooManyPoints { found: coarse.len(), limit: MAX_POINTS, resolution });
    }
    let reach = NORMAL_RADIUS * v;
    let raw_normals = normals(&coarse, &NeighborIndex::new(&fine, reach), reach);
    control.check()?;

    let frame_origin = cloud.origin.map(|x| -x as f32);
    let surfaces = Surfaces {
        points: &fine,
        samples: &coarse,
        normals: &raw_normals,
        resolution: v,
        extent: extent(&fine) as f32,
    };
    let view = viewpoint(&surfaces, stance.position, frame_origin);
    control.check()?;
    let mut colors = thinned_colors(&cloud.points, &cloud.colors, &coarse, v);
    let mut has_normal = raw_normals.iter().map(Option::is_some);
    colors.retain(|_| has_normal.next() == Some(true));
    let (points, normals): (Vec<Point>, Vec<Point>) = coarse
        .iter()
        .zip(raw_normals)
        .filter_map(|(point, normal)| normal.map(|n| (*point, face(n, point, &view.position))))
        .unzip();
    if points.len() < MIN_POINTS {
        return Err(PrepareError::TooFewPoints { found: points.len(), needed: MIN_POINTS, resolution });
    }
    control.check()?;
    let is_finer = |count: usize| count as f64 > FINER * points.len() as f64;
    let fine_surface = view
        .range_image
        .as_ref()
        .filter(|_| is_finer(fine.len()))
        .and_then(|_| fine_surface(cloud, &view.position, &fine, v))
        .filter(|finer| is_finer(finer.count()));
    control.check()?;
    let all = fpfh(&points, &normals, DESCRIPTOR_RADIUS * v);
    control.check()?;
    let mut rng = options.seed.derive("keypoints", key.0);
    let keypoints = select_keypoints(&mut rng, &all, options.keypoints);
    let chosen: Vec<Descriptor> = keypoints.iter().map(|keypoint| all[*keypoint as usize]).collect();
    let signature = signature(&chosen);
    let descriptors = chosen.concat();
    Ok(PreparedScan {
        key,
        resolution,
        origin: cloud.origin,
        points,
        normals,
        colors,
        keypoints,
        descriptors,
        signature,
        range_image: view.range_image,
        fine: fine_surface,
        viewpoint: view.position,
        hidden_share: view.hidden_share,
        up: stance.up.and_then(|up| Some(Vector3::from(up).try_normalize(f64::MIN_POSITIVE)?.into())),
    })
}

/// The surfaces at the voxels of half the size that `fine` fills (metres, local frame), seen from the viewpoint.
fn fine_surface(cloud: &PointCloud, viewpoint: &Point, fine: &[Point], v: f32) -> Option<FineSurface> {
    // As for the scan itself, what is half as large again carries the normals and the range image.
    let finer = voxel_centroids(&cloud.points, v / 4.0);
    let reach = NORMAL_RADIUS * v / 2.0;
    let normals = normals(fine, &NeighborIndex::new(&finer, reach), reach);
    let (points, normals): (Vec<Point>, Vec<Point>) = fine
        .iter()
        .zip(normals)
        .filter_map(|(point, normal)| normal.map(|n| (*point, face(n, point, viewpoint))))
        .unzip();
    let (range_image, _) = RangeImage::render(&finer, *viewpoint, v / 2.0);
    FineSurface::new(&points, &normals, range_image, v / 2.0)
}
