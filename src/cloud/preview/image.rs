//! A picture in memory, and its PNG file.

/// An RGB picture of 8 bits a channel, rows from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `3 * width * height` bytes.
    pub rgb: Vec<u8>,
}

/// The PNG encoder refused the picture.
#[derive(Debug, thiserror::Error)]
#[error("the picture cannot be encoded: {0}")]
pub struct ImageError(#[from] png::EncodingError);

/// The paper that pictures are drawn on.
pub(super) const BACKGROUND: [u8; 3] = [250, 250, 248];

impl Image {
    /// An empty sheet.
    pub(super) fn blank(width: usize, height: usize) -> Self {
        Self { width, height, rgb: BACKGROUND.repeat(width * height) }
    }

    /// Encodes the picture as a PNG file.
    ///
    /// # Errors
    /// Where the fields do not fit together, as `rgb` is free to be changed.
    pub fn to_png(&self) -> Result<Vec<u8>, ImageError> {
        let mut file = Vec::new();
        let mut encoder = png::Encoder::new(&mut file, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        let mut writer = encoder.write_header()?;
        writer.write_image_data(&self.rgb)?;
        writer.finish()?;
        Ok(file)
    }

    /// Sets a pixel; outside the picture nothing happens.
    pub(super) fn set(&mut self, x: usize, y: usize, color: [u8; 3]) {
        if x < self.width {
            let at = 3 * (y * self.width + x);
            if let Some(pixel) = self.rgb.get_mut(at..at + 3) {
                pixel.copy_from_slice(&color);
            }
        }
    }

    /// Draws another picture of the same height with its left edge at `left`.
    pub(super) fn paste(&mut self, panel: &Self, left: usize) {
        for (y, row) in panel.rgb.chunks_exact(3 * panel.width).enumerate() {
            for (x, pixel) in row.chunks_exact(3).enumerate() {
                self.set(left + x, y, [pixel[0], pixel[1], pixel[2]]);
            }
        }
    }

    /// A line from top to bottom.
    pub(super) fn vertical_line(&mut self, x: usize, color: [u8; 3]) {
        for y in 0..self.height {
            self.set(x, y, color);
        }
    }

    /// A filled rectangle from its upper left corner.
    pub(super) fn rectangle(&mut self, [x, y]: [usize; 2], [width, height]: [usize; 2], color: [u8; 3]) {
        for row in y..y + height {
            for column in x..x + width {
                self.set(column, row, color);
            }
        }
    }

    /// A filled disc.
    pub(super) fn disc(&mut self, [x, y]: [f32; 2], radius: f32, color: [u8; 3]) {
        let range =
            |at: f32| (at - radius).floor().max(0.0) as usize..=(at + radius).ceil().max(0.0) as usize;
        for row in range(y) {
            for column in range(x) {
                let (dx, dy) = (column as f32 + 0.5 - x, row as f32 + 0.5 - y);
                if dx * dx + dy * dy <= radius * radius {
                    self.set(column, row, color);
                }
            }
        }
    }
}
