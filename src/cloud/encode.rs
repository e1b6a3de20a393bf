//! Writes points as binary little-endian PLY, a point at a time: exports of merged clouds and of single scans.
//!
//! Uses the standard library's streams only. The number of points need not be known before: the header leaves room for it
//! and [`PlyWriter::finish`] fills it in.

use std::io::{self, Seek, SeekFrom, Write};

use crate::geometry::Point;

/// Room for any `u64`: the count is written as spaces and digits, which every reader splits at.
const COUNT_WIDTH: usize = 20;

/// A PLY file being written: float x, y, z in metres and, if asked for, uchar red, green, blue.
///
/// ```
/// use cairn::cloud::PlyWriter;
/// let mut file = std::io::Cursor::new(Vec::new());
/// let mut ply = PlyWriter::new(&mut file, false, &["a square"])?;
/// for corner in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]] {
///     ply.point(corner)?;
/// }
/// assert_eq!(ply.finish()?, 4);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Debug)]
pub struct PlyWriter<W: Write + Seek> {
    out: W,
    with_colors: bool,
    count_at: u64,
    count: u64,
}

impl<W: Write + Seek> PlyWriter<W> {
    /// Writes the header. Line breaks in comments become spaces, so that a comment cannot add header lines.
    /// Give a buffered writer: points are written one by one.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn new(mut out: W, with_colors: bool, comments: &[&str]) -> io::Result<Self> {
        out.write_all(b"ply\nformat binary_little_endian 1.0\n")?;
        for comment in comments {
            let line: String = comment.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
            writeln!(out, "comment {line}")?;
        }
        out.write_all(b"element vertex ")?;
        let count_at = out.stream_position()?;
        writeln!(out, "{:>COUNT_WIDTH$}", 0)?;
        out.write_all(b"property float x\nproperty float y\nproperty float z\n")?;
        if with_colors {
            out.write_all(b"property uchar red\nproperty uchar green\nproperty uchar blue\n")?;
        }
        out.write_all(b"end_header\n")?;
        Ok(Self { out, with_colors, count_at, count: 0 })
    }

    /// Writes a point; black, if the file has colours.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn point(&mut self, point: Point) -> io::Result<()> {
        self.colored_point(point, [0; 3])
    }

    /// Writes a point and its colour, which is left out if the file has none.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn colored_point(&mut self, [x, y, z]: Point, color: [u8; 3]) -> io::Result<()> {
        let mut record = [0; 15];
        let (position, rgb) = record.split_at_mut(12);
        for (to, value) in position.chunks_exact_mut(4).zip([x, y, z]) {
            to.copy_from_slice(&value.to_le_bytes());
        }
        rgb.copy_from_slice(&color);
        let length = if self.with_colors { 15 } else { 12 };
        self.out.write_all(record.get(..length).unwrap_or_default())?;
        self.count += 1;
        Ok(())
    }

    /// Writes the count into the header and flushes. Returns the count. A file that is not finished declares no points.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn finish(mut self) -> io::Result<u64> {
        self.out.seek(SeekFrom::Start(self.count_at))?;
        write!(self.out, "{:>COUNT_WIDTH$}", self.count)?;
        self.out.seek(SeekFrom::End(0))?;
        self.out.flush()?;
        Ok(self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud::{DecodeOptions, decode};
    use crate::control::CancelToken;

    #[test]
    fn what_is_written_is_read_back() {
        let points: Vec<Point> = (0..1000u16).map(|i| [f32::from(i) * 0.01, -1.5, f32::from(i)]).collect();
        for with_colors in [false, true] {
            let mut file = io::Cursor::new(Vec::new());
            let mut ply =
                PlyWriter::new(&mut file, with_colors, &["made by a test\nelement face 7"]).unwrap();
            for (i, &point) in points.iter().enumerate() {
                ply.colored_point(point, [i as u8, 2, 3]).unwrap();
            }
            assert_eq!(ply.finish().unwrap(), 1000);
            let bytes = file.into_inner();
            let cloud =
                decode(&mut bytes.as_slice(), &DecodeOptions::default(), &CancelToken::new()).unwrap().cloud;
            assert_eq!(cloud.points, points);
            assert_eq!(cloud.colors.get(258), with_colors.then_some(&[2, 2, 3]));
        }
    }
}
