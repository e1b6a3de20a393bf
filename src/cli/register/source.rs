//! Reading scans from files: hashed while they are decoded, so that a scan is known by its content.

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::Path;

use serde::Serialize;

use crate::cloud::{DecodeError, DecodeOptions, Decoded, ScanKey, decode};
use crate::control::{CancelToken, Cancelled};
use crate::features::{PrepareError, SensorPosition, Stance};
use crate::project::Interpretation;

/// Why a scan takes no part, in the words of the service.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub(in crate::cli) struct Failure {
    /// `unreadable-scan` or `unfit-scan`.
    pub reason: &'static str,
    /// What is wrong with it.
    pub detail: String,
}

/// A failure, or the wish to stop.
#[derive(Debug)]
pub(in crate::cli) enum Refusal {
    Failed(Failure),
    Cancelled(Cancelled),
}

impl Refusal {
    fn unreadable(detail: &impl ToString) -> Self {
        Self::Failed(Failure { reason: "unreadable-scan", detail: detail.to_string() })
    }

    /// The failure, to be reported; a cancellation is passed on.
    pub fn failure(self) -> Result<Failure, Cancelled> {
        match self {
            Self::Failed(failure) => Ok(failure),
            Self::Cancelled(cancelled) => Err(cancelled),
        }
    }
}

impl From<DecodeError> for Refusal {
    fn from(error: DecodeError) -> Self {
        match error {
            DecodeError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::unreadable(&other),
        }
    }
}

impl From<io::Error> for Refusal {
    fn from(error: io::Error) -> Self {
        Self::unreadable(&error)
    }
}

impl From<PrepareError> for Refusal {
    fn from(error: PrepareError) -> Self {
        match error {
            PrepareError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::Failed(Failure { reason: "unfit-scan", detail: other.to_string() }),
        }
    }
}

/// A decoded file.
pub(in crate::cli) struct Source {
    /// What the engine knows it by: the same as the service's for the same bytes read the same way.
    pub key: ScanKey,
    /// Its points.
    pub decoded: Decoded,
}

impl Source {
    /// Reads a file to its end.
    pub fn read(path: &Path, interpretation: &Interpretation, cancel: &CancelToken) -> Result<Self, Refusal> {
        let file = Hashing { inner: File::open(path)?, hasher: blake3::Hasher::new() };
        let mut reader = BufReader::with_capacity(1 << 18, file);
        let options = DecodeOptions { metres_per_unit: interpretation.metres_per_unit, ..Default::default() };
        let decoded = decode(&mut reader, &options, cancel)?;
        // The decoder stops where the points end; the hash is of the whole file.
        io::copy(&mut reader, &mut io::sink())?;
        let hash = reader.into_inner().hasher.finalize();
        Ok(Self { key: ScanKey::of_hash(&hash, &interpretation.to_bytes()), decoded })
    }

    /// Reads a file again, which must still be what it was.
    pub fn read_again(
        path: &Path,
        key: ScanKey,
        interpretation: &Interpretation,
        cancel: &CancelToken,
    ) -> Result<Self, Refusal> {
        let source = Self::read(path, interpretation, cancel)?;
        if source.key == key {
            Ok(source)
        } else {
            Err(Refusal::unreadable(&"the file changed while it was used"))
        }
    }

    /// How the sensor stood: as the command line or the file says.
    pub fn stance(&self, interpretation: &Interpretation) -> Stance {
        let said = interpretation.sensor_position.or(self.decoded.sensor_position);
        let position = said.map_or(SensorPosition::Assumed, SensorPosition::Known);
        Stance { position, up: interpretation.up }
    }
}

struct Hashing<R> {
    inner: R,
    hasher: blake3::Hasher,
}

impl<R: Read> Read for Hashing<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let taken = self.inner.read(buffer)?;
        self.hasher.update(buffer.get(..taken).unwrap_or_default());
        Ok(taken)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scan_is_known_by_all_its_bytes_and_by_how_they_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.xyz");
        let key = |bytes: &str, metres_per_unit| {
            std::fs::write(&path, bytes).unwrap();
            let interpretation = Interpretation { metres_per_unit, ..Interpretation::default() };
            Source::read(&path, &interpretation, &CancelToken::new()).map(|source| source.key)
        };
        let bytes = "1 2 3\n4 5 6\n";
        let first = key(bytes, 1.0).ok().unwrap();
        assert_eq!(first, ScanKey::of_hash(&blake3::hash(bytes.as_bytes()), &[]));
        assert_ne!(first, key("1 2 3\n4 5 6\n\n", 1.0).ok().unwrap());
        assert_ne!(first, key(bytes, 0.001).ok().unwrap());
        let Err(Refusal::Failed(failure)) = key("1 2\n", 1.0) else { panic!("two columns are no points") };
        assert_eq!(failure.reason, "unreadable-scan");
    }
}
