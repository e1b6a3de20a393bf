//! An upload that arrives in several requests, as plain data.

use super::{Interpretation, JobId, KeyId, Name, ProjectId, ScanId, Timestamp, UploadId};

/// What a client announces before it sends the first byte.
#[derive(Debug, Clone, PartialEq)]
pub struct NewUpload {
    /// The project that will own the scan.
    pub project: ProjectId,
    /// What the scan will be called.
    pub name: Name,
    /// How the bytes will be read.
    pub interpretation: Interpretation,
    /// The announcement, word for word, to be shown again.
    pub metadata: String,
    /// How many bytes will come; at least one.
    pub length: u64,
    /// The key that announced it: the scan will be on its account, whoever sends the rest.
    pub sender: Option<KeyId>,
}

/// A scan that an upload became.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UploadEnd {
    /// The scan.
    pub scan: ScanId,
    /// The job that registers it, as the upload was answered.
    pub job: JobId,
    /// Whether the project had the content already.
    pub duplicate: bool,
}

/// An upload under way, or complete and not yet forgotten.
#[derive(Debug, Clone, PartialEq)]
pub struct Upload {
    /// Its id.
    pub id: UploadId,
    /// What was announced.
    pub announced: NewUpload,
    /// Bytes that are safe on disk. All of them only once the scan is acknowledged, so that a client that sees this may
    /// throw its file away.
    pub received: u64,
    /// Hash of all bytes, hexadecimal, once they have come.
    pub blob: Option<String>,
    /// The scan, once it is acknowledged.
    pub end: Option<UploadEnd>,
    /// When it was announced.
    pub created: Timestamp,
    /// When it is forgotten unless more comes.
    pub expires: Timestamp,
}

impl Upload {
    /// Bytes that are still to come.
    #[must_use]
    pub fn missing(&self) -> u64 {
        self.announced.length.saturating_sub(self.received)
    }
}
