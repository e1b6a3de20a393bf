//! Draws one view: splats with a depth buffer, depth shading, markers and a scale bar.

use super::glyphs::{draw_text, round_length, text_width};
use super::image::{BACKGROUND, Image};
use super::view::View;
use super::{Dot, quantile};
use crate::geometry::{Point, occupied_voxels};

/// Pixels of the buffer along each pixel of the picture: edges come out smooth.
const OVERSAMPLING: usize = 2;

/// Share of the panel that stays free at each side.
const MARGIN: f32 = 0.06;

/// Colour of text and bars.
const INK: [u8; 3] = [70, 74, 82];

/// A panel being drawn: depth and colour at a multiple of the final resolution.
struct Canvas {
    width: usize,
    height: usize,
    /// Metres away from the viewer; infinite where nothing is.
    depth: Vec<f32>,
    /// Of what is in front, before shading.
    color: Vec<Option<[f32; 3]>>,
    /// Pixels a metre.
    scale: f32,
    /// Right and up, metres, of the panel's centre.
    center: [f32; 2],
}

/// Draws the dots below `ceiling` in a panel of `width` x `height` pixels.
pub(super) fn draw(
    dots: &[Dot],
    stations: &[(Point, [u8; 3])],
    ceiling: f32,
    view: &View,
    width: usize,
    height: usize,
) -> Image {
    let shown: Vec<Dot> = dots
        .iter()
        .filter(|dot| dot.at[2] <= ceiling)
        .map(|dot| Dot { at: view.project(&dot.at), ..*dot })
        .collect();
    let Some(mut canvas) = Canvas::framing(&shown, width, height) else { return Image::blank(width, height) };
    let radius = (0.75 * spacing(dots) * canvas.scale).clamp(1.0, 8.0);
    let depth_range = {
        let depth = |share| quantile(shown.iter().map(|dot| dot.at[2]), share).unwrap_or_default();
        (depth(0.98) - depth(0.02)).max(radius / canvas.scale)
    };
    canvas.splat_depth(&shown, radius);
    // Noise of the sensors and of the poses is about this much of a scene.
    let slack = (2.0 * radius / canvas.scale).max(0.015 * depth_range);
    canvas.splat_color(&shown, radius, slack);
    let shade = canvas.shading(depth_range);
    let mut image = canvas.resolve(&shade);
    for (at, color) in stations {
        let [x, y] = canvas.pixel(&view.project(at));
        let at = [x / OVERSAMPLING as f32, y / OVERSAMPLING as f32];
        let size = width as f32 / 260.0;
        image.disc(at, 1.9 * size, [255; 3]);
        image.disc(at, 1.5 * size, INK);
        image.disc(at, 0.9 * size, *color);
    }
    scale_bar(&mut image, canvas.scale / OVERSAMPLING as f32);
    image
}

impl Canvas {
    /// A canvas on which almost all points fit; a few stray ones do not count. `None` without points.
    fn framing(shown: &[Dot], width: usize, height: usize) -> Option<Self> {
        let range = |axis: usize| {
            let value = |share| quantile(shown.iter().map(|dot| dot.at[axis]), share);
            Some((value(0.001)?, value(0.999)?))
        };
        let ((left, right), (low, high)) = (range(0)?, range(1)?);
        let (width, height) = (width * OVERSAMPLING, height * OVERSAMPLING);
        let free = 1.0 - 2.0 * MARGIN;
        let scale = (free * width as f32 / (right - left)).min(free * height as f32 / (high - low));
        // A single point, or points on top of each other, have no extent.
        let scale = if scale.is_finite() { scale } else { 100.0 };
        Some(Self {
            width,
            height,
            depth: vec![f32::INFINITY; width * height],
            color: vec![None; width * height],
            scale,
            center: [f32::midpoint(left, right), f32::midpoint(low, high)],
        })
    }

    /// Where a projected point falls, in pixels of the canvas.
    fn pixel(&self, at: &[f32; 3]) -> [f32; 2] {
        [
            self.width as f32 / 2.0 + (at[0] - self.center[0]) * self.scale,
            self.height as f32 / 2.0 - (at[1] - self.center[1]) * self.scale,
        ]
    }

    /// Calls `visit(index of the pixel)` for the pixels of a disc.
    fn disc(&self, [x, y]: [f32; 2], radius: f32, mut visit: impl FnMut(usize)) {
        let (reach_x, reach_y) = (self.width as f32 + radius, self.height as f32 + radius);
        if !(x > -radius && y > -radius && x < reach_x && y < reach_y) {
            return;
        }
        let range = |at: f32, limit: usize| {
            (at - radius).round().max(0.0) as usize..((at + radius).round().max(0.0) as usize).min(limit)
        };
        for row in range(y, self.height) {
            for column in range(x, self.width) {
                let (dx, dy) = (column as f32 + 0.5 - x, row as f32 + 0.5 - y);
                if dx * dx + dy * dy <= radius * radius + 0.25 {
                    visit(row * self.width + column);
                }
            }
        }
    }

    fn splat_depth(&mut self, shown: &[Dot], radius: f32) {
        let mut depth = std::mem::take(&mut self.depth);
        for dot in shown {
            self.disc(self.pixel(&dot.at), radius, |index| {
                if let Some(nearest) = depth.get_mut(index) {
                    *nearest = nearest.min(dot.at[2]);
                }
            });
        }
        self.depth = depth;
    }

    /// Colours each pixel by the points within `slack` metres of the front one: mostly by those of the first scan among
    /// them, so that each scan shows as an even patch, and a little by all.
    fn splat_color(&mut self, shown: &[Dot], radius: f32, slack: f32) {
        let mut first = vec![u32::MAX; self.depth.len()];
        let visible =
            |dot: &Dot, index: usize| self.depth.get(index).is_some_and(|front| dot.at[2] <= front + slack);
        for dot in shown {
            self.disc(self.pixel(&dot.at), radius, |index| {
                if let Some(part) = first.get_mut(index).filter(|_| visible(dot, index)) {
                    *part = dot.part.min(*part);
                }
            });
        }
        let mut of_first = vec![[0.0; 4]; self.depth.len()];
        let mut of_all = vec![[0.0; 4]; self.depth.len()];
        let add = |sums: &mut [[f32; 4]], index: usize, color: [u8; 3]| {
            if let Some(sum) = sums.get_mut(index) {
                let [red, green, blue] = color.map(f32::from);
                *sum = [sum[0] + red, sum[1] + green, sum[2] + blue, sum[3] + 1.0];
            }
        };
        for dot in shown {
            self.disc(self.pixel(&dot.at), radius, |index| {
                if visible(dot, index) {
                    add(&mut of_all, index, dot.color);
                    if first.get(index) == Some(&dot.part) {
                        add(&mut of_first, index, dot.color);
                    }
                }
            });
        }
        for (color, (one, all)) in self.color.iter_mut().zip(of_first.iter().zip(&of_all)) {
            if one[3] > 0.0 {
                let blend = |k: usize| 0.8 * one[k] / one[3] + 0.2 * all[k] / all[3];
                *color = Some([blend(0), blend(1), blend(2)]);
            }
        }
    }

    /// Eye-dome lighting (Boucheny 2009): a pixel is darker the further it lies behind its neighbours, on two scales.
    fn shading(&self, depth_range: f32) -> Vec<f32> {
        let mut shade = vec![1.0; self.width * self.height];
        for (y, row) in shade.chunks_exact_mut(self.width).enumerate() {
            for (x, value) in row.iter_mut().enumerate() {
                let Some(here) = self.depth.get(y * self.width + x).copied().filter(|d| d.is_finite()) else {
                    continue;
                };
                let mut behind = 0.0;
                for (step, weight) in [(2isize, 1.0f32), (6, 0.6)] {
                    for (dx, dy) in [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1)] {
                        let there = self.depth_at(x as isize + dx * step, y as isize + dy * step);
                        if there.is_finite() {
                            // Steps below 0.4 % of the scene are noise; above 5 % they grow no darker.
                            let drop = (here - there) / depth_range;
                            behind += weight * (drop - 0.004).clamp(0.0, 0.05);
                        }
                    }
                }
                *value = (-5.5 * behind).exp().max(0.3);
            }
        }
        shade
    }

    fn depth_at(&self, x: isize, y: isize) -> f32 {
        let inside = x >= 0 && y >= 0 && (x as usize) < self.width && (y as usize) < self.height;
        let index = if inside { y as usize * self.width + x as usize } else { usize::MAX };
        self.depth.get(index).copied().unwrap_or(f32::INFINITY)
    }

    /// Shaded colours at the final resolution.
    fn resolve(&self, shade: &[f32]) -> Image {
        let (width, height) = (self.width / OVERSAMPLING, self.height / OVERSAMPLING);
        let mut image = Image::blank(width, height);
        for y in 0..height {
            for x in 0..width {
                let mut sum = [0.0; 3];
                for sub in 0..OVERSAMPLING * OVERSAMPLING {
                    let row = y * OVERSAMPLING + sub / OVERSAMPLING;
                    let index = row * self.width + x * OVERSAMPLING + sub % OVERSAMPLING;
                    let light = shade.get(index).copied().unwrap_or(1.0);
                    let pixel = match self.color.get(index) {
                        Some(Some(color)) => color.map(|c| c * light),
                        _ => BACKGROUND.map(f32::from),
                    };
                    for (total, channel) in sum.iter_mut().zip(pixel) {
                        *total += channel;
                    }
                }
                image.set(x, y, sum.map(|c| (c / (OVERSAMPLING * OVERSAMPLING) as f32).round() as u8));
            }
        }
        image
    }
}

/// The distance of neighbouring points of one scan, metres, as if they were spread evenly: the root of its surface (occupied
/// voxels) per point. The median over some scans.
fn spacing(dots: &[Dot]) -> f32 {
    let parts: Vec<&[Dot]> = dots.chunk_by(|a, b| a.part == b.part).collect();
    let of_parts = parts.iter().step_by(parts.len().div_ceil(15).max(1)).filter_map(|part| {
        let points: Vec<Point> = part.iter().take(100_000).map(|dot| dot.at).collect();
        let extents = (0..3).filter_map(|axis| {
            let value = |share| quantile(points.iter().map(|at| at[axis]), share);
            Some(value(0.98)? - value(0.02)?)
        });
        let size = extents.fold(0.0, f32::max) / 50.0;
        let surface = occupied_voxels(&points, size) as f32 * size * size;
        (size.is_finite() && size > 0.0).then(|| (surface / points.len() as f32).sqrt())
    });
    quantile(of_parts, 0.5).unwrap_or_default()
}

/// A bar of a round length in the lower left corner.
fn scale_bar(image: &mut Image, pixels_per_metre: f32) {
    let unit = (image.width / 400).max(1);
    let Some((length, name)) = round_length(f64::from(image.width as f32 * 0.25 / pixels_per_metre)) else {
        return;
    };
    let pixels = (length * f64::from(pixels_per_metre)).round() as usize;
    let (left, bottom) = (10 * unit, image.height.saturating_sub(9 * unit));
    image.rectangle([left, bottom], [pixels, unit], INK);
    for end in [left, left + pixels] {
        image.rectangle([end, bottom.saturating_sub(2 * unit)], [unit, 5 * unit], INK);
    }
    let text_left = left + pixels.saturating_sub(text_width(&name, unit)) / 2;
    draw_text(image, &name, [text_left, bottom.saturating_sub(11 * unit)], unit, INK);
}
