//! A picture of a registered model for a person: from above with the ceiling cut away, and obliquely.
//!
//! Orthographic, with a depth buffer and depth shading, each scan in its colour, a scale bar and the places of the
//! sensors. The same parts always give the same picture. Uses [`crate::geometry`]; used by the preview endpoint, the
//! command line and the demo.

mod canvas;
mod glyphs;
mod image;
mod kept;
mod palette;
mod upright;
mod view;

pub use image::{Image, ImageError};
pub use kept::PreviewScan;
pub use palette::scan_color;

use crate::geometry::{Point, Pose};
use nalgebra::Vector3;
use upright::Upright;
use view::View;

/// One scan of the model.
#[derive(Debug, Clone, Copy)]
pub struct PreviewPart<'a> {
    /// Points in the scan's frame.
    pub points: &'a [Point],
    /// Where the scan lies in the model.
    pub model_from_scan: Pose,
    /// What it is drawn in.
    pub color: PartColor<'a>,
    /// Where the sensor stood, in the scan's frame; marked in the picture.
    pub sensor_in_scan: Option<Point>,
}

/// The colour of a part.
#[derive(Debug, Clone, Copy)]
pub enum PartColor<'a> {
    /// One for all points, as [`scan_color`] gives.
    Uniform([u8; 3]),
    /// One a point, in their order; points beyond the end of the list are grey.
    PerPoint(&'a [[u8; 3]]),
}

impl PartColor<'_> {
    fn of(&self, index: usize) -> [u8; 3] {
        match self {
            Self::Uniform(color) => *color,
            Self::PerPoint(colors) => colors.get(index).copied().unwrap_or([150; 3]),
        }
    }
}

/// Size of the picture in pixels. Both are brought into 64..=4096.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PreviewOptions {
    /// Both views side by side.
    pub width: u32,
    /// Height of each.
    pub height: u32,
}

impl Default for PreviewOptions {
    fn default() -> Self {
        Self { width: 1600, height: 800 }
    }
}

/// More points than this are thinned evenly: the picture has far fewer pixels.
const MAX_DRAWN: usize = 6_000_000;

/// Enough points to find directions and extents.
const MAX_PROBED: usize = 200_000;

/// A point ready to be drawn.
#[derive(Debug, Clone, Copy)]
struct Dot {
    /// In the upright frame: x along the longer side, z up, metres.
    at: Point,
    color: [u8; 3],
    /// Which part it is of.
    part: u32,
}

/// Draws the parts. Without any point the picture is blank.
#[must_use]
pub fn render(parts: &[PreviewPart<'_>], options: PreviewOptions) -> Image {
    let (width, height) = (options.width.clamp(64, 4096) as usize, options.height.clamp(64, 4096) as usize);
    let mut image = Image::blank(width, height);
    let probe = gather(parts, MAX_PROBED, &Pose::identity());
    let Some(center) = center(&probe) else { return image };
    let rotations: Vec<_> = parts.iter().map(|part| part.model_from_scan.rotation).collect();
    let relative: Vec<Vector3<f32>> = probe.iter().map(|dot| Vector3::from(dot.at) - center).collect();
    let upright = upright::estimate(&relative, &rotations);
    let upright_from_model = Pose::new(upright.rotation, -(upright.rotation * center.cast()));
    let dots = gather(parts, MAX_DRAWN, &upright_from_model);
    let ceiling = ceiling(&dots, &upright);
    let stations: Vec<(Point, [u8; 3])> = parts
        .iter()
        .filter_map(|part| {
            let at = (upright_from_model * part.model_from_scan).transform_point(part.sensor_in_scan?);
            Some((at, part.color.of(0)))
        })
        .collect();
    let split = width / 2;
    for (view, left, right) in [(View::top(), 0, split), (View::oblique(), split, width)] {
        let panel = canvas::draw(&dots, &stations, ceiling, &view, right - left, height);
        image.paste(&panel, left);
    }
    image.vertical_line(split, [222, 224, 228]);
    image
}

/// Points of all parts in another frame, evenly thinned to at most `limit`.
fn gather(parts: &[PreviewPart<'_>], limit: usize, frame_from_model: &Pose) -> Vec<Dot> {
    let total: usize = parts.iter().map(|part| part.points.len()).sum();
    let step = total.div_ceil(limit).max(1);
    let mut dots = Vec::with_capacity(total.div_ceil(step));
    let mut index = 0;
    for (number, part) in (0..).zip(parts) {
        let frame_from_scan = *frame_from_model * part.model_from_scan;
        for (i, &point) in part.points.iter().enumerate() {
            if index % step == 0 {
                let at = frame_from_scan.transform_point(point);
                if at.iter().all(|x| x.is_finite()) {
                    dots.push(Dot { at, color: part.color.of(i), part: number });
                }
            }
            index += 1;
        }
    }
    dots
}

/// The median of each coordinate.
fn center(dots: &[Dot]) -> Option<Vector3<f32>> {
    let axis = |axis: usize| quantile(dots.iter().map(|dot| dot.at[axis]), 0.5);
    Some(Vector3::new(axis(0)?, axis(1)?, axis(2)?))
}

/// The height above which points are left out, so that rooms can be looked into.
fn ceiling(dots: &[Dot], upright: &Upright) -> f32 {
    let height = |share| quantile(dots.iter().map(|dot| dot.at[2]), share).unwrap_or_default();
    if upright.has_rooms {
        let (low, high) = (height(0.01), height(0.99));
        height(0.85).min(low + 0.8 * (high - low))
    } else {
        f32::INFINITY
    }
}

/// The value below which a share of the values lies. `None` without values.
fn quantile(values: impl Iterator<Item = f32>, share: f64) -> Option<f32> {
    let mut values: Vec<f32> = values.collect();
    let last = values.len().checked_sub(1)?;
    let at = (last as f64 * share).round() as usize;
    Some(*values.select_nth_unstable_by(at.min(last), f32::total_cmp).1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    /// A room of 6 x 4 x 2.5 m, one point each 5 cm, floor to ceiling.
    fn room() -> Vec<Point> {
        let mut points = Vec::new();
        let grid = |n: u16| (0..=n).map(|i| f32::from(i) * 0.05);
        for x in grid(120) {
            points.extend(grid(80).flat_map(|y| [[x, y, 0.0], [x, y, 2.5]]));
            points.extend(grid(50).flat_map(|z| [[x, 0.0, z], [x, 4.0, z]]));
        }
        for y in grid(80) {
            points.extend(grid(50).flat_map(|z| [[0.0, y, z], [6.0, y, z]]));
        }
        points
    }

    fn part(points: &[Point], model_from_scan: Pose) -> PreviewPart<'_> {
        let color = PartColor::Uniform(scan_color(0));
        PreviewPart { points, model_from_scan, color, sensor_in_scan: Some([3.0, 2.0, 1.5]) }
    }

    #[test]
    fn a_turned_room_is_drawn_upright_without_its_ceiling_and_always_the_same() {
        let points = room();
        let turned = Pose::new(Rotation3::new(Vector3::new(1.0, 0.4, -0.6)), Vector3::new(100.0, -20.0, 7.0));
        let options = PreviewOptions { width: 400, height: 200 };
        let image = render(&[part(&points, turned)], options);
        assert_eq!((image.width, image.height, image.rgb.len()), (400, 200, 400 * 200 * 3));
        assert_eq!(image, render(&[part(&points, turned)], options));
        let inked = image.rgb.chunks(3).filter(|pixel| pixel.iter().any(|&c| c < 200)).count();
        assert!(inked > 8000 && inked < 60_000, "{inked} pixels are inked");
        let decoder = png::Decoder::new(std::io::Cursor::new(image.to_png().unwrap()));
        let mut reader = decoder.read_info().unwrap();
        let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut rgb).unwrap();
        assert_eq!(rgb, image.rgb);
    }

    #[test]
    fn nothing_or_broken_points_give_a_blank_picture() {
        let blank = render(&[], PreviewOptions::default());
        assert!(blank.rgb.iter().all(|&c| c > 240));
        let one =
            render(&[part(&[[1.0, 2.0, 3.0]], Pose::identity())], PreviewOptions { width: 0, height: 9999 });
        assert_eq!((one.width, one.height), (64, 4096));
        let broken =
            render(&[part(&[[f32::NAN; 3], [1e30, 0.0, 0.0]], Pose::identity())], PreviewOptions::default());
        assert_eq!(broken.rgb.len(), 1600 * 800 * 3);
    }
}
