//! Taking an upload in: bytes to disk as they come, a first look at them, then the scan and its job in one stroke.

use std::fmt::Display;
use std::time::Duration;

use bytes::Bytes;
use futures_util::Stream;

use crate::cloud::{Format, ScanKey, sniff};
use crate::project::{Interpretation, KeyId, Name, ProjectId};
use crate::storage::{Admission, NewScan, StorageError, Store, StoredBlob};

use super::digest::{DigestCheck, DigestMismatch, ExpectedDigest};
use super::pace::Pace;
use super::parameters::content_key;

/// What a client says about the bytes that it sends.
#[derive(Debug, Clone, PartialEq)]
pub struct UploadRequest {
    /// Where the scan belongs.
    pub project: ProjectId,
    /// What it is called.
    pub name: Name,
    /// How the bytes are to be read.
    pub interpretation: Interpretation,
    /// How many bytes there will be, if the client said so.
    pub declared_bytes: Option<u64>,
    /// What they will hash to, if the client said so.
    pub digests: Vec<ExpectedDigest>,
    /// The key that they come with.
    pub sender: Option<KeyId>,
}

/// Why an upload is not taken in. Nothing of it is kept.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    /// More bytes than allowed.
    #[error("the upload has more than {limit} bytes, which is the limit")]
    TooLarge {
        /// The limit, bytes.
        limit: u64,
    },
    /// No bytes.
    #[error("the upload is empty")]
    Empty,
    /// The first bytes belong to no format that is known here.
    #[error("the content is in no known format; PLY, PCD, XYZ and PTS are known")]
    UnknownFormat,
    /// Name and content disagree.
    #[error("the name `{name}` ends in .{extension}, but the content is {found}")]
    WrongExtension {
        /// The scan's name.
        name: Name,
        /// Its ending.
        extension: String,
        /// What the content is.
        found: String,
    },
    /// The bytes that came are not those that were sent.
    #[error(transparent)]
    Digest(#[from] DigestMismatch),
    /// The connection broke.
    #[error("the upload broke off after {received} bytes: {reason}")]
    Interrupted {
        /// Bytes until then.
        received: u64,
        /// What the connection said.
        reason: String,
    },
    /// Nothing came for too long, or next to nothing.
    #[error("nearly nothing came for {} s, after {received} bytes", idle.as_secs())]
    Stalled {
        /// Bytes until then.
        received: u64,
        /// How long was waited.
        idle: Duration,
    },
    /// It would leave too little disk for the work that was taken on.
    #[error("the service has too little space left to take this in")]
    LowDisk,
    /// It could not be stored.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

/// What is taken in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IntakeLimits {
    /// The largest upload, bytes.
    pub max_bytes: u64,
    /// How long next to nothing may come.
    pub idle: Duration,
    /// Bytes of disk that must stay free.
    pub free_bytes: u64,
}

/// Takes uploads in.
#[derive(Debug, Clone)]
pub struct Intake {
    store: Store,
    limits: IntakeLimits,
}

/// As much of an upload as is looked at to recognise its format.
pub(super) const HEAD_BYTES: usize = 16 * 1024;
/// Bytes after which it is asked again whether there is room for more.
const ASK_EVERY: u64 = 32 << 20;

impl Intake {
    /// Takes uploads in within these limits.
    #[must_use]
    pub fn new(store: Store, limits: IntakeLimits) -> Self {
        Self { store, limits }
    }

    /// Receives one upload. When this returns, its bytes are synced and its row is committed.
    pub async fn receive<E: Display>(
        &self,
        request: UploadRequest,
        body: impl Stream<Item = Result<Bytes, E>> + Send,
    ) -> Result<Admission, IntakeError> {
        let limit = self.limits.max_bytes;
        if request.declared_bytes.is_some_and(|n| n > limit) {
            return Err(IntakeError::TooLarge { limit });
        }
        self.store.project(request.project).await?;
        let declared = request.declared_bytes.unwrap_or(1);
        self.store.check_upload(request.project, request.sender, declared).await?;
        self.check_room(declared)?;
        let mut writer = self.store.blobs.writer();
        let mut head = Vec::new();
        let mut format = None;
        let mut check = DigestCheck::new(request.digests);
        let (mut body, mut pace) = (std::pin::pin!(body), Pace::new(self.limits.idle));
        let mut asked = 0;
        loop {
            let received = writer.bytes();
            let stalled = |_| IntakeError::Stalled { received, idle: self.limits.idle };
            let Some(piece) = pace.next(&mut body).await.map_err(stalled)? else { break };
            let piece = piece.map_err(|e| IntakeError::Interrupted { received, reason: e.to_string() })?;
            if received + piece.len() as u64 > limit {
                return Err(IntakeError::TooLarge { limit });
            }
            if received - asked >= ASK_EVERY {
                asked = received;
                self.check_room(0)?;
                if request.declared_bytes.is_none() {
                    self.store.check_upload(request.project, request.sender, received).await?;
                }
            }
            check.update(&piece);
            writer.write(&piece).await?;
            if format.is_none() {
                head.extend(piece.iter().take(HEAD_BYTES - head.len()));
                if head.len() == HEAD_BYTES {
                    // Known early, so that a wrong file of many gigabytes is refused after its first few kilobytes.
                    format = Some(recognise(&head, &request.name)?);
                }
            }
        }
        if writer.bytes() == 0 {
            return Err(IntakeError::Empty);
        }
        check.finish()?;
        let format = format.map_or_else(|| recognise(&head, &request.name), Ok)?;
        // Pinned until the end of this function: the row comes last.
        let stored = writer.finish().await?;
        let new =
            scan_of(request.project, request.name, request.interpretation, format, *stored, request.sender);
        Ok(self.store.admit_scan(&new).await?)
    }

    /// The largest upload, bytes.
    pub(super) fn max_bytes(&self) -> u64 {
        self.limits.max_bytes
    }

    /// How long next to nothing may come.
    pub(super) fn idle(&self) -> Duration {
        self.limits.idle
    }

    /// Fails if so many bytes more would leave too little disk.
    pub(super) fn check_room(&self, bytes: u64) -> Result<(), IntakeError> {
        let left = self.store.free_bytes()?.checked_sub(bytes);
        if left.is_some_and(|left| left >= self.limits.free_bytes) {
            Ok(())
        } else {
            Err(IntakeError::LowDisk)
        }
    }
}

/// The scan that a stored upload is to become.
pub(super) fn scan_of(
    project: ProjectId,
    name: Name,
    interpretation: Interpretation,
    format: Format,
    stored: StoredBlob,
    sender: Option<KeyId>,
) -> NewScan {
    let key = content_key(ScanKey::of_hash(&stored.id.0, &interpretation.to_bytes()));
    let (format, blob, bytes) = (word(format), stored.id, stored.bytes);
    NewScan { project, key, name, format, blob, bytes, interpretation, sender }
}

/// The format of a content, unless the name claims another one.
pub(super) fn recognise(head: &[u8], name: &Name) -> Result<Format, IntakeError> {
    let found = sniff(head).ok_or(IntakeError::UnknownFormat)?;
    let Some((_, extension)) = name.as_str().rsplit_once('.') else { return Ok(found) };
    let claimed = Format::from_extension(&extension.to_ascii_lowercase());
    let text = |f: Format| matches!(f, Format::Xyz | Format::Pts);
    match claimed {
        // Columns of numbers look alike, whatever they are called.
        Some(claimed) if claimed != found && !(text(claimed) && text(found)) => {
            let (name, extension) = (name.clone(), extension.to_owned());
            Err(IntakeError::WrongExtension { name, extension, found: word(found) })
        }
        _ => Ok(found),
    }
}

fn word(format: Format) -> String {
    format!("{format:?}").to_ascii_lowercase()
}
