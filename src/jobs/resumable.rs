//! Uploads that arrive in several requests: announced, continued as often as the network breaks, and at the end a scan
//! like any other.
//!
//! Bytes are synced before a row says that they are there ([`crate::storage::UploadFiles`]); the last step, which makes
//! all bytes count as received, is the one that acknowledges the scan. One request at a time writes to an upload.
//! Used by `http/tus`.

use std::fmt::Display;
use std::time::{Duration, Instant};

use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use tokio_util::sync::CancellationToken;

use super::digest::{DigestCheck, DigestMismatch, ExpectedDigest};
use super::intake::{HEAD_BYTES, Intake, IntakeError, recognise, scan_of};
use super::pace::Pace;
use super::turnstile::{Turn, Turnstile};
use crate::project::{NewUpload, Timestamp, Upload, UploadEnd, UploadId};
use crate::storage::{BlobId, FreshBlob, Seal, StorageError, Store, StoredBlob, UploadFile};

/// Why an upload cannot be announced, continued or looked at.
#[derive(Debug, thiserror::Error)]
pub enum ResumableError {
    /// It was not continued in time, or ended long ago.
    #[error("upload {0} has expired")]
    Expired(UploadId),
    /// The request continues at another place than where the bytes end.
    #[error("the upload has {found} bytes, so it cannot be continued at {given}")]
    Offset {
        /// Bytes that are there.
        found: u64,
        /// Where the request would go on.
        given: u64,
    },
    /// More bytes than announced.
    #[error("the request goes past the {length} bytes that were announced; nothing of it is kept")]
    PastEnd {
        /// Bytes that were announced.
        length: u64,
    },
    /// The bytes of the request are not those that were sent.
    #[error(transparent)]
    Digest(#[from] DigestMismatch),
    /// Another request holds the upload and does not let go.
    #[error("another request is finishing this upload; look at it again in a moment")]
    Busy,
    /// A later request took the upload over.
    #[error("a later request has taken this upload over")]
    TakenOver,
    /// The service stops. What came so far is safe.
    #[error("the service is stopping; what came so far is safe")]
    Stopping,
    /// As for any upload. If the content is to blame, the upload is gone.
    #[error(transparent)]
    Intake(#[from] IntakeError),
}

impl From<StorageError> for ResumableError {
    fn from(error: StorageError) -> Self {
        Self::Intake(error.into())
    }
}

/// A request that continues an upload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Continuation {
    /// Where it says that it goes on.
    pub offset: u64,
    /// How many bytes it brings, if it says so.
    pub declared: Option<u64>,
    /// What they hash to, if it says so. Then all of them are kept or none.
    pub digests: Vec<ExpectedDigest>,
}

/// Takes uploads in that arrive in several requests. Clones share everything.
#[derive(Debug, Clone)]
pub struct Resumable {
    store: Store,
    intake: Intake,
    lifetime: Duration,
    stop: CancellationToken,
    turnstile: Turnstile,
}

/// How long the holder of an upload may take to let go of it: it may be syncing or hashing.
const PATIENCE: Duration = Duration::from_secs(10);
/// Bytes after which a long request is made safe so far.
const CHECKPOINT: u64 = 32 << 20;

impl Resumable {
    /// Uploads under the limits of `intake`; one that is not continued for `lifetime` is forgotten. Requests end when
    /// `stop` is cancelled.
    #[must_use]
    pub fn new(store: Store, intake: Intake, lifetime: Duration, stop: CancellationToken) -> Self {
        Self { store, intake, lifetime, stop, turnstile: Turnstile::default() }
    }

    /// The largest upload, bytes.
    #[must_use]
    pub fn max_bytes(&self) -> u64 {
        self.intake.max_bytes()
    }

    /// How long a request may bring nothing.
    #[must_use]
    pub fn idle(&self) -> Duration {
        self.intake.idle()
    }

    /// Notes an upload that will come, and keeps the answer to its announcement.
    pub async fn create(&self, new: NewUpload, seal: Seal<'_, Upload>) -> Result<Upload, ResumableError> {
        let limit = self.max_bytes();
        if new.length > limit {
            return Err(IntakeError::TooLarge { limit }.into());
        }
        if new.length == 0 {
            return Err(IntakeError::Empty.into());
        }
        self.intake.check_room(new.length)?;
        Ok(self.store.create_upload(new, self.expiry(), seal).await?)
    }

    /// How far an upload has come, without disturbing who writes to it.
    pub async fn peek(&self, id: UploadId) -> Result<Upload, ResumableError> {
        let upload = self.store.upload(id).await?;
        if upload.expires <= Timestamp::now() { Err(ResumableError::Expired(id)) } else { Ok(upload) }
    }

    /// Where an upload can be continued. A request that still writes to it is asked to leave.
    pub async fn resume(&self, id: UploadId) -> Result<Upload, ResumableError> {
        let (_turn, upload) = self.take(id).await?;
        Ok(upload)
    }

    /// Forgets an upload and its bytes; a scan that it became stays.
    pub async fn terminate(&self, id: UploadId) -> Result<(), ResumableError> {
        let _turn = self.turnstile.take(id, PATIENCE).await.ok_or(ResumableError::Busy)?;
        self.peek(id).await?;
        Ok(self.store.delete_upload(id).await?)
    }

    /// Continues an upload. When this returns, the bytes are synced; when the last one has come, the scan is
    /// acknowledged. After an error, what came is kept unless the error says otherwise.
    pub async fn append<E: Display>(
        &self,
        id: UploadId,
        request: Continuation,
        body: impl Stream<Item = Result<Bytes, E>> + Send,
    ) -> Result<Upload, ResumableError> {
        let (turn, upload) = self.take(id).await?;
        if request.offset != upload.received {
            return Err(ResumableError::Offset { found: upload.received, given: request.offset });
        }
        let length = upload.announced.length;
        if request.declared.is_some_and(|bytes| bytes > upload.missing()) {
            return Err(ResumableError::PastEnd { length });
        }
        let mut body = std::pin::pin!(body);
        if upload.missing() == 0 {
            // Complete: only an empty request fits.
            return match body.next().await {
                Some(Ok(piece)) if !piece.is_empty() => Err(ResumableError::PastEnd { length }),
                _ => Ok(upload),
            };
        }
        self.keep_alive(&upload).await?;
        let mut arrival = Arrival {
            head: self.store.uploads.head(id, HEAD_BYTES.min(upload.received as usize)).await?,
            file: self.store.uploads.at(id, upload.received).await?,
            written: upload.received,
            kept: upload.received,
            check: DigestCheck::new(request.digests),
            noted: Instant::now(),
        };
        let ended = self.receive(&turn, &upload, &mut arrival, body).await;
        match self.conclude(upload, arrival, ended).await {
            Err(ResumableError::Intake(
                error @ (IntakeError::UnknownFormat | IntakeError::WrongExtension { .. }),
            )) => {
                // No later byte can make it right.
                self.store.delete_upload(id).await?;
                Err(error.into())
            }
            other => other,
        }
    }

    /// Writes what comes, until it ends or something is wrong. As long as it comes, the upload does not expire, even where nothing of it
    /// is noted before its digest is known.
    async fn receive<E: Display>(
        &self,
        turn: &Turn,
        upload: &Upload,
        arrival: &mut Arrival,
        mut body: impl Stream<Item = Result<Bytes, E>> + Unpin + Send,
    ) -> Result<(), ResumableError> {
        let (length, idle) = (upload.announced.length, self.intake.idle());
        let mut pace = Pace::new(idle);
        loop {
            let received = arrival.written;
            let next = tokio::select! {
                biased;
                () = turn.leave.cancelled() => return Err(ResumableError::TakenOver),
                () = self.stop.cancelled() => return Err(ResumableError::Stopping),
                next = pace.next(&mut body) => next,
            };
            let Some(piece) = next.map_err(|_| IntakeError::Stalled { received, idle })? else {
                return Ok(());
            };
            let piece = piece.map_err(|e| IntakeError::Interrupted { received, reason: e.to_string() })?;
            if received + piece.len() as u64 > length {
                return Err(ResumableError::PastEnd { length });
            }
            arrival.take(&piece).await?;
            self.stay_alive(upload.id, arrival).await?;
            if received < HEAD_BYTES as u64 && arrival.written >= HEAD_BYTES as u64 {
                // Known early, so that a wrong file of many gigabytes is refused after its first few kilobytes.
                recognise(&arrival.head, &upload.announced.name)?;
            }
            let unsafe_bytes = arrival.written - arrival.kept;
            if unsafe_bytes < CHECKPOINT || arrival.written == length {
                continue;
            }
            self.intake.check_room(0)?;
            if arrival.check.is_empty() {
                arrival.file.sync().await?;
                self.advance(upload.id, arrival.written).await?;
                (arrival.kept, arrival.noted) = (arrival.written, Instant::now());
            }
        }
    }

    /// Makes safe what may be kept, and ends the upload if that is all of it.
    async fn conclude(
        &self,
        upload: Upload,
        arrival: Arrival,
        ended: Result<(), ResumableError>,
    ) -> Result<Upload, ResumableError> {
        let Arrival { head, mut file, written, kept, check, .. } = arrival;
        let whole = written == upload.announced.length;
        let ended = match ended {
            // The last byte came: how the request ended after it does not matter.
            Err(error) if whole && error.leaves_good_bytes() => Ok(()),
            other => other,
        };
        let all_or_nothing = !check.is_empty();
        match ended.and_then(|()| Ok(check.finish()?)) {
            Err(error) if all_or_nothing || !error.leaves_good_bytes() => {
                if let Err(cause) = file.cut(kept).await {
                    // The row says what counts; the file is cut when it is opened next.
                    tracing::warn!(%cause, upload = %upload.id, "an upload could not be cut");
                }
                Err(error)
            }
            ended => {
                file.sync().await?;
                drop(file);
                if whole {
                    return self.finish(upload, &head).await;
                }
                let expires = self.advance(upload.id, written).await?;
                ended.map(|()| Upload { received: written, expires, blob: None, ..upload })
            }
        }
    }

    /// All bytes of the upload are synced in its file: it becomes a blob, and the scan is acknowledged.
    async fn finish(&self, upload: Upload, head: &[u8]) -> Result<Upload, ResumableError> {
        recognise(head, &upload.announced.name)?;
        let stored = self.store.uploads.hash(upload.id).await?;
        // Pinned until the row names it.
        let fresh = self.store.settle_upload(upload.id, stored).await?;
        self.admit(upload, &fresh, head).await
    }

    async fn admit(&self, upload: Upload, fresh: &FreshBlob, head: &[u8]) -> Result<Upload, ResumableError> {
        let NewUpload { project, name, interpretation, length, sender, .. } = &upload.announced;
        let format = recognise(head, name)?;
        let new = scan_of(*project, name.clone(), *interpretation, format, **fresh, *sender);
        let expires = self.expiry();
        let admission = self.store.admit_upload(upload.id, &new, expires).await?;
        let end =
            UploadEnd { scan: admission.scan.id, job: admission.job.id, duplicate: admission.duplicate };
        let blob = Some(fresh.id.to_string());
        Ok(Upload { received: *length, end: Some(end), blob, expires, ..upload })
    }

    /// The right to write to an upload that is alive. One whose last step was interrupted is ended first.
    async fn take(&self, id: UploadId) -> Result<(Turn, Upload), ResumableError> {
        self.peek(id).await?;
        let turn = self.turnstile.take(id, PATIENCE).await.ok_or(ResumableError::Busy)?;
        let upload = self.peek(id).await?;
        let (None, Some(blob)) = (upload.end, &upload.blob) else { return Ok((turn, upload)) };
        let stored = StoredBlob { id: BlobId::parse(blob)?, bytes: upload.announced.length };
        let Some(fresh) = self.store.held_upload(stored) else { return Ok((turn, upload)) };
        let head = self.store.blobs.head(stored.id, HEAD_BYTES).await?;
        Ok((turn, self.admit(upload, &fresh, &head).await?))
    }

    /// Sees to it that an upload does not expire while it is written to.
    async fn keep_alive(&self, upload: &Upload) -> Result<(), ResumableError> {
        if upload.expires < Timestamp::now().plus(self.lifetime / 2) {
            self.advance(upload.id, upload.received).await?;
        }
        Ok(())
    }

    /// The same while bytes come.
    async fn stay_alive(&self, id: UploadId, arrival: &mut Arrival) -> Result<(), ResumableError> {
        if arrival.noted.elapsed() >= self.lifetime / 4 {
            self.advance(id, arrival.kept).await?;
            arrival.noted = Instant::now();
        }
        Ok(())
    }

    /// Notes how many bytes of an upload are safe. Returns when it expires from now on.
    async fn advance(&self, id: UploadId, received: u64) -> Result<Timestamp, ResumableError> {
        let expires = self.expiry();
        match self.store.advance_upload(id, received, expires).await {
            // Its client is told whether it has expired.
            Err(gone @ StorageError::NoUpload(_)) => Err(self.peek(id).await.err().unwrap_or(gone.into())),
            other => Ok(other.map(|()| expires)?),
        }
    }

    fn expiry(&self) -> Timestamp {
        Timestamp::now().plus(self.lifetime)
    }
}

impl ResumableError {
    /// Whether what came before is as good as if the client had sent no more.
    #[must_use]
    pub fn leaves_good_bytes(&self) -> bool {
        matches!(
            self,
            Self::TakenOver
                | Self::Stopping
                | Self::Intake(
                    IntakeError::Stalled { .. } | IntakeError::Interrupted { .. } | IntakeError::LowDisk
                )
        )
    }
}

/// What one request has brought so far.
struct Arrival {
    /// The first bytes of the upload, for a look at the format.
    head: Vec<u8>,
    file: UploadFile,
    /// Bytes of the upload in the file.
    written: u64,
    /// Those of them that are synced and noted.
    kept: u64,
    check: DigestCheck,
    /// When the upload's row was last written, at the latest.
    noted: Instant,
}

impl Arrival {
    async fn take(&mut self, piece: &[u8]) -> Result<(), StorageError> {
        self.head.extend(piece.iter().take(HEAD_BYTES - self.head.len()));
        self.check.update(piece);
        self.file.write(piece).await?;
        self.written += piece.len() as u64;
        Ok(())
    }
}
