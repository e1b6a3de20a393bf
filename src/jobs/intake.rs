//! Taking an upload in: bytes to disk as they come, a first look at them, then the scan and its job in one stroke.

use std::fmt::Display;
use std::time::Duration;

use bytes::Bytes;
use futures_util::{Stream, StreamExt};

use crate::cloud::{Format, ScanKey, sniff};
use crate::project::{Interpretation, KeyId, Name, ProjectId};
use crate::storage::{Admission, NewScan, StorageError, Store, StoredBlob};

use super::digest::{DigestCheck, DigestMismatch, ExpectedDigest};
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
    /// Nothing came for too long.
    #[error("no byte came for {} s, after {received} bytes", idle.as_secs())]
    Stalled {
        /// Bytes until then.
        received: u64,
        /// How long was waited.
        idle: Duration,
    },
    /// It could not be stored.
    #[error(transparent)]
    Storage(#[from] StorageError),
}

/// Takes uploads in.
#[derive(Debug, Clone)]
pub struct Intake {
    store: Store,
    max_bytes: u64,
    idle: Duration,
}

/// As much of an upload as is looked at to recognise its format.
pub(super) const HEAD_BYTES: usize = 16 * 1024;

impl Intake {
    /// Takes uploads of at most `max_bytes` in; gives one up when nothing comes for `idle`.
    #[must_use]
    pub fn new(store: Store, max_bytes: u64, idle: Duration) -> Self {
        Self { store, max_bytes, idle }
    }

    /// Receives one upload. When this returns, its bytes are synced and its row is committed.
    pub async fn receive<E: Display>(
        &self,
        request: UploadRequest,
        body: impl Stream<Item = Result<Bytes, E>> + Send,
    ) -> Result<Admission, IntakeError> {
        let limit = self.max_bytes;
        if request.declared_bytes.is_some_and(|n| n > limit) {
            return Err(IntakeError::TooLarge { limit });
        }
        self.store.project(request.project).await?;
        let declared = request.declared_bytes.unwrap_or(1);
        self.store.check_upload(request.project, request.sender, declared).await?;
        let mut writer = self.store.blobs.writer();
        let mut head = Vec::new();
        let mut format = None;
        let mut check = DigestCheck::new(request.digests);
        let mut body = std::pin::pin!(body);
        loop {
            let received = writer.bytes();
            let next = tokio::time::timeout(self.idle, body.next())
                .await
                .map_err(|_| IntakeError::Stalled { received, idle: self.idle })?;
            let Some(piece) = next else { break };
            let piece = piece.map_err(|e| IntakeError::Interrupted { received, reason: e.to_string() })?;
            if received + piece.len() as u64 > limit {
                return Err(IntakeError::TooLarge { limit });
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
        self.max_bytes
    }

    /// How long nothing may come.
    pub(super) fn idle(&self) -> Duration {
        self.idle
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
