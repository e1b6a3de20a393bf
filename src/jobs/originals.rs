//! Reading uploads back: the blob of a scan, checked against its hash, decoded as the client said.

use std::io::BufReader;

use super::JobError;
use crate::cloud::{DecodeOptions, Decoded, decode};
use crate::control::CancelToken;
use crate::features::{SensorPosition, Stance};
use crate::project::Scan;
use crate::storage::{BlobId, BlobStore};

/// A decoded upload.
pub(super) struct Original {
    /// Points and what the file said about them.
    pub decoded: Decoded,
    /// How the sensor stood: the request's word, else the file's.
    pub stance: Stance,
}

/// Decodes the upload of a scan. Blocks; belongs into the thread pool.
pub(super) fn read_original(
    blobs: &BlobStore,
    scan: &Scan,
    max_points: u64,
    cancel: &CancelToken,
) -> Result<Original, JobError> {
    let id = BlobId::parse(&scan.blob)?;
    let mut reader = BufReader::with_capacity(1 << 18, blobs.reader(id)?);
    let options = DecodeOptions { metres_per_unit: scan.interpretation.metres_per_unit, max_points };
    let result = decode(&mut reader, &options, cancel);
    if matches!(&result, Err(crate::cloud::DecodeError::Cancelled(_))) {
        return Err(crate::control::Cancelled.into());
    }
    // Damage on our disk must not be blamed on the client's file, so the hash is checked before the decoder is heard.
    reader.into_inner().verify()?;
    let decoded = result?;
    let said = scan.interpretation.sensor_position.or(decoded.sensor_position);
    let position = said.map_or(SensorPosition::Assumed, SensorPosition::Known);
    Ok(Original { decoded, stance: Stance { position, up: scan.interpretation.up } })
}
