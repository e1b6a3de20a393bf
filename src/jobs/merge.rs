//! Putting the uploads of registered scans into one frame, one after another: only one is in memory at a time.

use std::collections::HashMap;

use nalgebra::Vector3;

use super::ExportError;
use super::originals::read_original;
use crate::control::CancelToken;
use crate::geometry::Point;
use crate::project::{Placement, Scan};
use crate::storage::BlobStore;

/// The scans of an export.
pub(super) struct Merge {
    /// Where their uploads are.
    pub blobs: BlobStore,
    /// In order of arrival, each with its place.
    pub placed: Vec<(Scan, Placement)>,
    /// Points that one of them may have.
    pub max_points: u64,
}

/// Colour of points whose scan has none, in a file that has colours.
const GREY: [u8; 3] = [160; 3];
/// Beyond this distance from zero single precision loses millimetres, and the file gets an offset, metres.
const FAR: f64 = 5_000.0;

/// Cubes that a thinned cloud may have: all are in memory at once, in a table that doubles when seven eighths of it are full. These fill
/// one of 2^22 places; while it is made of one with half as many, both take 0.56 GB.
const MOST_CUBES: u64 = 7 << 19;

/// A component, and the cube in its frame.
type Cube = (usize, [i64; 3]);

/// Points of one cube.
#[derive(Default)]
struct Cell {
    sum: Vector3<f64>,
    color: [u64; 3],
    points: u64,
}

impl Merge {
    /// Whether any of the scans has colours.
    pub fn colored(&self) -> bool {
        self.placed.iter().any(|(scan, _)| scan.colored == Some(true))
    }

    /// What to subtract from every point so that single precision holds it, whole metres; zero unless the model's
    /// coordinates are as large as georeferenced ones.
    pub fn offset(&self) -> [f64; 3] {
        let positions = self.placed.iter().map(|(_, place)| place.model_from_scan.translation);
        let farthest = positions.fold(
            Vector3::zeros(),
            |far: Vector3<f64>, t| {
                if t.amax() > far.amax() { t } else { far }
            },
        );
        if farthest.amax() > FAR { farthest.map(f64::round).into() } else { [0.0; 3] }
    }

    /// Hands every point to `each`: the component, the point relative to `offset` (metres), the colour.
    pub fn visit(
        &self,
        offset: &[f64; 3],
        mut each: impl FnMut(usize, Vector3<f64>, [u8; 3]) -> Result<(), ExportError>,
    ) -> Result<(), ExportError> {
        let offset = Vector3::from(*offset);
        for (scan, place) in &self.placed {
            let cloud = read_original(&self.blobs, scan, self.max_points, &CancelToken::new())?.decoded.cloud;
            let origin = Vector3::from(cloud.origin);
            for (i, point) in cloud.points.iter().enumerate() {
                let in_scan = Vector3::from(*point).cast::<f64>() + origin;
                let color = cloud.colors.get(i).copied().unwrap_or(GREY);
                each(place.component, place.model_from_scan.transform(&in_scan) - offset, color)?;
            }
        }
        Ok(())
    }

    /// One point for each occupied cube of this edge (metres): the mean of the points in it, in the order of the cubes.
    pub fn thinned(&self, offset: &[f64; 3], edge: f64) -> Result<Vec<(Point, [u8; 3])>, ExportError> {
        let mut cells: HashMap<Cube, Cell> = HashMap::new();
        let mut left = MOST_CUBES;
        self.visit(offset, |component, point, color| {
            let cube = (point / edge).map(|x| x.floor() as i64);
            let cell = cells.entry((component, cube.into())).or_default();
            if cell.points == 0 {
                left = left.checked_sub(1).ok_or(ExportError::TooFine { edge, limit: MOST_CUBES })?;
            }
            cell.sum += point;
            cell.points += 1;
            for (sum, c) in cell.color.iter_mut().zip(color) {
                *sum += u64::from(c);
            }
            Ok(())
        })?;
        // Means are half as large as what they are made of, and the table is in memory until all have left it.
        let mut means: Vec<(Cube, _)> = cells.into_iter().map(|(cube, cell)| (cube, cell.mean())).collect();
        means.sort_unstable_by_key(|(cube, _)| *cube);
        Ok(means.into_iter().map(|(_, mean)| mean).collect())
    }
}

impl Cell {
    fn mean(&self) -> (Point, [u8; 3]) {
        let mean = self.sum / self.points as f64;
        let color = self.color.map(|sum| u8::try_from(sum / self.points.max(1)).unwrap_or(u8::MAX));
        ([mean.x as f32, mean.y as f32, mean.z as f32], color)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes that are stated in docs/operations.md.
    const STATED: usize = 600_000_000;

    #[test]
    fn a_thinned_cloud_takes_no_more_memory_than_is_stated() {
        // A place of the table is an entry and a byte that says whether it is taken.
        let (entry, mean) = (size_of::<(Cube, Cell)>() + 1, size_of::<(Cube, (Point, [u8; 3]))>());
        let most = MOST_CUBES as usize;
        let full = HashMap::<Cube, Cell>::with_capacity(most);
        assert_eq!(full.capacity(), most, "the table is as full as it may be");
        let places = most / 7 * 8;
        assert!((places + places / 2) * entry < STATED, "while it grows");
        assert!(places * entry + most * mean < STATED, "while means are made of it");
    }
}
