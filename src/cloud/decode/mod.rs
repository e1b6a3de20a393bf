//! Decoders: the bytes of an uploaded file in, finite points in metres out.
//!
//! The content decides the format, never a name ([`sniff`]). Every decoder reads a stream once and believes no
//! count before the bytes are there: memory is bounded by what the file really holds, and a header that declares
//! 10^18 points costs nothing. Headers of PLY and PCD are read by `ply-rs-bw` and `pcd-rs`; payloads are read here,
//! record by record, because those libraries build a map per point or allocate what the header asks for.
//!
//! Used by ingest jobs and by the command line. Uses [`super::PointCloud`] and the cancellation token.

mod collector;
mod error;
mod format;
mod lzf;
mod options;
mod pcd;
mod ply;
mod records;
mod scalar;
mod source;
mod text;

#[cfg(test)]
mod hostile_tests;

use std::io::{BufRead, Read};

pub use error::DecodeError;
pub use format::{Format, sniff};
pub use options::{DecodeOptions, metres_per_unit};

use crate::cloud::PointCloud;
use crate::control::CancelToken;
use collector::Collector;
use source::Source;

/// What one file held.
#[derive(Debug, Clone, PartialEq)]
pub struct Decoded {
    /// At least one point, all finite, in metres.
    pub cloud: PointCloud,
    /// The format the content turned out to have.
    pub format: Format,
    /// Where the sensor stood, in metres in the frame of the file (not relative to `cloud.origin`): the VIEWPOINT of a
    /// PCD file when it is not the default one.
    pub sensor_position: Option<[f64; 3]>,
    /// Points left out because a coordinate was NaN, infinite or more than 10^8 m.
    pub dropped_non_finite: u64,
}

/// How much of the head of a file is read before its format is decided.
const HEAD_BYTES: u64 = 16 * 1024;

/// Decodes one file.
///
/// Coordinates are read as f64, scaled to metres, and stored relative to [`PointCloud::origin`], which is zero unless the
/// coordinates are so large (over 1 km) that f32 would lose tenths of a millimetre.
///
/// # Errors
/// [`DecodeError`] names what is wrong and where: the field, the line or byte offset, the limit. A file with no
/// finite point at all is an error; single points that are not finite are dropped and counted.
pub fn decode(
    reader: &mut dyn BufRead,
    options: &DecodeOptions,
    cancel: &CancelToken,
) -> Result<Decoded, DecodeError> {
    options.check()?;
    let mut head = Vec::new();
    Read::take(&mut *reader, HEAD_BYTES).read_to_end(&mut head)?;
    if head.is_empty() {
        return Err(DecodeError::Empty);
    }
    let format =
        sniff(&head).ok_or_else(|| DecodeError::UnknownFormat { looks_like: format::looks_like(&head) })?;
    let mut source = Source::new(head, reader, cancel);
    let mut collector = Collector::new(options);
    let sensor_position = match format {
        Format::Ply => {
            ply::read(&mut source, &mut collector)?;
            None
        }
        Format::Pcd => pcd::read(&mut source, &mut collector)?,
        Format::Xyz | Format::Pts => {
            text::read(&mut source, &mut collector, format)?;
            None
        }
    };
    let (cloud, dropped_non_finite) = collector.finish()?;
    Ok(Decoded {
        cloud,
        format,
        sensor_position: sensor_position.map(|p| p.map(|x| x * options.metres_per_unit)),
        dropped_non_finite,
    })
}
