//! What a sensor saw, as a cube map of depths: six pinhole faces around the sensor, so that a depth camera and a
//! panoramic scanner are the same code and no direction is special.

use std::sync::Arc;

use multiversion::multiversion;
use serde::{Deserialize, Serialize};

use crate::geometry::{Point, whole};

/// Pixels of the finest image are this wide at unit depth (tangent of the angle); coarser images come from distance.
const PIXEL_RANGE: (f32, f32) = (0.002, 0.02);
/// Half the width of a face, as a tangent: slightly over 45 degrees, so that a 3 x 3 window never leaves its face.
const HALF_WIDTH: f32 = 1.04;
/// Of the nine pixels around one, this many must have depths for it to be judged.
const MIN_FILLED: f32 = 5.0;
/// Depth tolerance: a part that follows the voxel size and a part that follows the pixel's footprint.
const MARGIN_VOXELS: f32 = 2.0;
const MARGIN_PIXELS: f32 = 1.5;

/// How a point relates to what the sensor saw in its direction.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Visibility {
    /// The sensor saw nothing there (out of its view, or too few returns).
    Unknown,
    /// The sensor saw a surface clearly behind the point: the point stands in free space.
    InFront,
    /// The sensor saw a surface at the point's depth.
    OnSurface,
    /// The sensor saw a surface in front of the point.
    Hidden,
}

/// One face: a rectangle of pixels that covers what was seen through it.
#[derive(Debug, Clone, Default, Serialize, Deserialize)]
struct Face {
    column: u32,
    row: u32,
    columns: u32,
    rows: u32,
    /// Least depth in each pixel's 3 x 3 window, or 0 where too little was seen. Metres along the face's axis.
    depths: Vec<f32>,
}

/// The range image of a scan as seen from one point. Clones share its pixels.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct RangeImage {
    sensor: Point,
    pixel: f32,
    margin: f32,
    faces: Arc<[Face]>,
}

impl RangeImage {
    /// Renders `points` as seen from `sensor` (both in the scan's frame, metres), with pixels as wide as a voxel of
    /// `resolution` metres at the median depth. Also gives the share of the points that lie hidden behind others: a sensor sees
    /// what it scans, so a large share says that it did not stand there.
    #[must_use]
    pub fn render(points: &[Point], sensor: Point, resolution: f32) -> (Self, f64) {
        let depth = |p: &Point| (0..3).map(|k| (p[k] - sensor[k]).abs()).fold(0.0, f32::max);
        let mut depths: Vec<f32> = points.iter().map(depth).filter(|d| is_depth(*d)).collect();
        let middle = depths.len() / 2;
        let median =
            if depths.is_empty() { 1.0 } else { *depths.select_nth_unstable_by(middle, f32::total_cmp).1 };
        let pixel = (resolution / median).clamp(PIXEL_RANGE.0, PIXEL_RANGE.1);
        let width = (2.0 * HALF_WIDTH / pixel).ceil() as u32;
        let mut hits: Vec<Vec<(u32, u32, f32)>> = vec![Vec::new(); 6];
        let mut pixels = Pixels::default();
        for points in points.chunks(Pixels::MOST) {
            let mut axes = [[0.0; Pixels::MOST]; 3];
            for (i, point) in points.iter().enumerate() {
                for (axis, x) in axes.iter_mut().zip(point) {
                    axis[i] = *x;
                }
            }
            let [x, y, z] = axes.each_ref().map(|axis| &axis[..points.len()]);
            find_pixels(x, y, z, &sensor, pixel, &mut pixels);
            for i in (0..points.len()).filter(|i| pixels.depth[*i] > 0.0) {
                let [column, row] = [pixels.column[i], pixels.row[i]].map(|at| at.min(width - 1));
                hits[pixels.face[i] as usize % 6].push((column, row, pixels.depth[i]));
            }
        }
        let margin = MARGIN_VOXELS * resolution;
        let (mut judged, mut hidden) = (0_usize, 0_usize);
        let faces = hits
            .iter()
            .map(|hits| {
                let (face, farthest) = Face::from_hits(hits, width);
                for &(column, row, depth) in hits {
                    // Behind everything in its window: an edge or a slope alone does not make a point hidden.
                    let seen = face.value(&farthest, column, row);
                    judged += usize::from(seen > 0.0);
                    hidden +=
                        usize::from(seen > 0.0 && depth > seen + margin + MARGIN_PIXELS * pixel * depth);
                }
                face
            })
            .collect();
        (Self { sensor, pixel, margin, faces }, hidden as f64 / judged.max(1) as f64)
    }

    /// Where the sensor stood, in the scan's frame, metres.
    #[must_use]
    pub fn sensor(&self) -> Point {
        self.sensor
    }

    /// Judges a point given in the scan's frame, metres.
    #[inline]
    #[must_use]
    pub fn judge(&self, point: &Point) -> Visibility {
        let Some((face, at, depth)) = project(point, &self.sensor) else { return Visibility::Unknown };
        let [column, row] = at.map(|t| ((t + HALF_WIDTH) / self.pixel) as u32);
        let seen = self.faces[face].depth(column, row);
        if seen <= 0.0 {
            return Visibility::Unknown;
        }
        let margin = self.margin + MARGIN_PIXELS * self.pixel * depth;
        if depth < seen - margin {
            Visibility::InFront
        } else if depth > seen + margin {
            Visibility::Hidden
        } else {
            Visibility::OnSurface
        }
    }

    /// How many of many points [`RangeImage::judge`] finds in front of what was seen, and how many on it. Points are given as one
    /// array a coordinate, in the scan's frame, metres.
    #[must_use]
    pub fn judge_all(&self, points: [&[f32]; 3]) -> (u32, u32) {
        let (mut in_front, mut on_surface) = (0, 0);
        let mut pixels = Pixels::default();
        for first in (0..points[0].len()).step_by(Pixels::MOST) {
            let last = (first + Pixels::MOST).min(points[0].len());
            let [x, y, z] = points.map(|axis| &axis[first..last]);
            find_pixels(x, y, z, &self.sensor, self.pixel, &mut pixels);
            for i in 0..last - first {
                let depth = pixels.depth[i];
                let seen = self.faces[pixels.face[i] as usize % 6].depth(pixels.column[i], pixels.row[i]);
                let margin = self.margin + MARGIN_PIXELS * self.pixel * depth;
                let known = (seen > 0.0) && (depth > 0.0);
                let before = depth < seen - margin;
                let behind = depth > seen + margin;
                in_front += u32::from(known && before);
                on_surface += u32::from(known && !before && !behind);
            }
        }
        (in_front, on_surface)
    }
}

/// Where some points are in the range image: the results of [`project`], one array each. Depth 0 is a point that has no place.
struct Pixels {
    face: [u32; Self::MOST],
    column: [u32; Self::MOST],
    row: [u32; Self::MOST],
    depth: [f32; Self::MOST],
}

impl Pixels {
    const MOST: usize = 256;
}

impl Default for Pixels {
    fn default() -> Self {
        let none = [0; Self::MOST];
        Self { face: none, column: none, row: none, depth: [0.0; Self::MOST] }
    }
}

/// [`project`] without branches, so that it runs on many points at once.
#[multiversion(targets("x86_64+avx512f+avx512dq", "x86_64+avx2", "aarch64+neon"))]
fn find_pixels(x: &[f32], y: &[f32], z: &[f32], sensor: &Point, width: f32, pixels: &mut Pixels) {
    let n = x.len().min(Pixels::MOST);
    let (x, y, z) = (&x[..n], &y[..n], &z[..n]);
    let (faces, columns) = (&mut pixels.face[..n], &mut pixels.column[..n]);
    let (rows, depths) = (&mut pixels.row[..n], &mut pixels.depth[..n]);
    for i in 0..n {
        let (dx, dy, dz) = (x[i] - sensor[0], y[i] - sensor[1], z[i] - sensor[2]);
        let (sx, sy, sz) = (dx.abs(), dy.abs(), dz.abs());
        let on_x = (sx >= sy) && (sx >= sz);
        let on_y = !on_x && (sy >= sz);
        let (along, u, v, axis) = if on_x {
            (dx, dy, dz, 0)
        } else if on_y {
            (dy, dz, dx, 2)
        } else {
            (dz, dx, dy, 4)
        };
        let depth = along.abs();
        let valid = is_depth(depth);
        faces[i] = axis + u32::from(along < 0.0);
        columns[i] = whole((u / depth + HALF_WIDTH) / width);
        rows[i] = whole((v / depth + HALF_WIDTH) / width);
        depths[i] = if valid { depth } else { 0.0 };
    }
}

/// What a row of three pixels or a window of three rows holds.
#[derive(Clone, Copy)]
struct Window {
    least: f32,
    greatest: f32,
    /// Pixels with a depth.
    filled: f32,
}

impl Window {
    fn of_pixel(depth: f32) -> Self {
        let is_filled = depth < f32::INFINITY;
        Self {
            least: depth,
            greatest: if is_filled { depth } else { 0.0 },
            filled: if is_filled { 1.0 } else { 0.0 },
        }
    }

    fn of_three([a, b, c]: [Self; 3]) -> Self {
        Self {
            least: a.least.min(b.least).min(c.least),
            greatest: a.greatest.max(b.greatest).max(c.greatest),
            filled: a.filled + b.filled + c.filled,
        }
    }
}

/// The least and the greatest depth in the window of each pixel that is not in the margin, 0 where too few are filled. `nearest` has rows
/// of `wide` pixels, infinite where nothing was seen.
fn windows(nearest: &[f32], wide: usize) -> (Vec<f32>, Vec<f32>) {
    let rows: Vec<Vec<Window>> = nearest
        .chunks_exact(wide)
        .map(|row| {
            row.windows(3).map(|of| Window::of_three([of[0], of[1], of[2]].map(Window::of_pixel))).collect()
        })
        .collect();
    rows.windows(3)
        .flat_map(|of| (0..wide - 2).map(|x| Window::of_three([of[0][x], of[1][x], of[2][x]])))
        .map(|window| if window.filled >= MIN_FILLED { (window.least, window.greatest) } else { (0.0, 0.0) })
        .unzip()
}

impl Face {
    /// The face, and the greatest depth in each pixel's window.
    fn from_hits(hits: &[(u32, u32, f32)], width: u32) -> (Self, Vec<f32>) {
        if hits.is_empty() {
            return (Self::default(), Vec::new());
        }
        let span = |of: fn(&(u32, u32, f32)) -> u32| {
            hits.iter().map(of).fold((u32::MAX, 0), |(low, high), x| (low.min(x), high.max(x)))
        };
        let (columns, rows) = (span(|h| h.0), span(|h| h.1));
        let (column, row) = (columns.0.saturating_sub(1), rows.0.saturating_sub(1));
        let (columns, rows) = ((columns.1 + 2).min(width) - column, (rows.1 + 2).min(width) - row);
        // With a margin of one pixel around.
        let (wide, high) = (columns as usize + 2, rows as usize + 2);
        let mut nearest = vec![f32::INFINITY; wide * high];
        for &(x, y, depth) in hits {
            let pixel = &mut nearest[(y - row + 1) as usize * wide + (x - column + 1) as usize];
            *pixel = pixel.min(depth);
        }
        let (depths, farthest) = windows(&nearest, wide);
        (Self { column, row, columns, rows, depths }, farthest)
    }

    #[inline]
    fn depth(&self, column: u32, row: u32) -> f32 {
        self.value(&self.depths, column, row)
    }

    /// The entry of an array over this face's pixels, 0 outside.
    #[inline]
    fn value(&self, of: &[f32], column: u32, row: u32) -> f32 {
        let (x, y) = (column.wrapping_sub(self.column), row.wrapping_sub(self.row));
        if x < self.columns && y < self.rows { of[(y * self.columns + x) as usize] } else { 0.0 }
    }
}

/// Whether a point at this distance along an axis can be seen, metres.
#[inline]
fn is_depth(depth: f32) -> bool {
    (depth > 1e-9) && (depth < f32::INFINITY)
}

/// The face through which a point is seen, its two tangents there, and its depth along the face's axis.
#[inline]
fn project(point: &Point, sensor: &Point) -> Option<(usize, [f32; 2], f32)> {
    let d: [f32; 3] = std::array::from_fn(|k| point[k] - sensor[k]);
    let size = d.map(f32::abs);
    let axis = if size[0] >= size[1] && size[0] >= size[2] {
        0
    } else if size[1] >= size[2] {
        1
    } else {
        2
    };
    let depth = size[axis];
    if !is_depth(depth) {
        return None;
    }
    let face = axis * 2 + usize::from(d[axis] < 0.0);
    let others = [(axis + 1) % 3, (axis + 2) % 3];
    Some((face, others.map(|k| d[k] / depth), depth))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall 2 m in front of the sensor along x, seen densely.
    fn wall() -> RangeImage {
        let points: Vec<Point> = (0..10_000)
            .map(|i| [2.0, (i % 100) as f32 * 0.02 - 1.0, (i / 100) as f32 * 0.02 - 1.0])
            .collect();
        RangeImage::render(&points, [0.0; 3], 0.04).0
    }

    #[test]
    fn points_before_on_and_behind_a_wall_are_told_apart() {
        let image = wall();
        assert_eq!(image.judge(&[1.0, 0.1, 0.1]), Visibility::InFront);
        assert_eq!(image.judge(&[2.0, 0.5, -0.5]), Visibility::OnSurface);
        assert_eq!(image.judge(&[3.0, 0.1, 0.1]), Visibility::Hidden);
        assert_eq!(image.judge(&[-1.0, 0.0, 0.0]), Visibility::Unknown);
        assert_eq!(image.judge(&[2.0, 1.9, 0.0]), Visibility::Unknown);
        assert_eq!(image.judge(&[f32::NAN, 0.0, 0.0]), Visibility::Unknown);
    }

    #[test]
    fn many_points_at_once_are_judged_as_each_alone() {
        let points: Vec<Point> = (0..700)
            .map(|i| [0.01 * i as f32 - 1.0, (i % 7) as f32 * 0.2 - 0.5, (i % 11) as f32 - 0.1])
            .collect();
        let (ball, _) = RangeImage::render(&points, [0.1, 0.2, 0.3], 0.3);
        let axis =
            |k: usize| -> Vec<f32> { points.iter().map(|p| p[k] * 0.9).chain([f32::NAN, 0.1]).collect() };
        let axes = [axis(0), axis(1), axis(2)];
        let mut some = 0;
        for image in [wall(), ball] {
            let single: Vec<_> =
                (0..points.len() + 2).map(|i| image.judge(&[axes[0][i], axes[1][i], axes[2][i]])).collect();
            let count = |kind| single.iter().filter(|seen| **seen == kind).count() as u32;
            let all = image.judge_all([&axes[0], &axes[1], &axes[2]]);
            assert_eq!(all, (count(Visibility::InFront), count(Visibility::OnSurface)));
            some += all.0;
        }
        assert!(some > 0);
    }

    #[test]
    fn a_scan_hides_nothing_from_its_own_sensor_and_much_from_a_wrong_one() {
        let mut points = Vec::new();
        for i in 0..5000 {
            let (a, b) = ((i % 100) as f32 * 0.02 - 1.0, (i / 100) as f32 * 0.03);
            points.push([a, 1.0, b]);
            points.push([a, 3.0, 1.2 * b + 2.3]);
        }
        let (_, right) = RangeImage::render(&points, [0.0, -2.0, 0.5], 0.04);
        let (_, wrong) = RangeImage::render(&points, [0.0, 9.0, 9.0], 0.04);
        assert!(right < 0.02, "{right}");
        assert!(wrong > 0.2, "{wrong}");
    }
}
