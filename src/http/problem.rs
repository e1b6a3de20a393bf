//! Errors as RFC 9457 problem details.

use std::num::NonZeroU16;

use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::{Deserialize, Serialize};
use utoipa::{IntoResponses, ToSchema};

use crate::jobs::{ExportError, IntakeError};
use crate::project::{Fault, JobState};
use crate::storage::{Quota, StorageError, Trouble};

/// What went wrong with a request, for people (`title`, `detail`) and for programs (`type`, `field`, `limit`).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Problem {
    /// A stable name of the kind of problem, `urn:cairn:problem:` and a word.
    #[serde(rename = "type")]
    #[schema(examples("urn:cairn:problem:too-large"))]
    pub kind: String,
    /// The kind of problem in a few words.
    pub title: String,
    /// The HTTP status.
    pub status: u16,
    /// This very problem in a sentence.
    pub detail: String,
    /// The parameter, body field or header that is to blame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub field: Option<String>,
    /// The limit that was passed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub limit: Option<u64>,
    /// Seconds after which the same request may go better: the header `retry-after`.
    #[serde(skip)]
    pub retry_after: Option<NonZeroU16>,
}

/// The answers that every resource may give.
#[derive(IntoResponses)]
#[expect(dead_code, reason = "only describes answers; Problem gives them")]
pub(super) enum Problems {
    /// A parameter or the body is wrong; `field` says which.
    #[response(status = 400, content_type = "application/problem+json")]
    BadRequest(#[to_schema] Problem),
    /// There is no such thing.
    #[response(status = 404, content_type = "application/problem+json")]
    NotFound(#[to_schema] Problem),
    /// The service failed; the details are in its log, under the request id.
    #[response(status = 500, content_type = "application/problem+json")]
    Internal(#[to_schema] Problem),
    /// Its files or its database cannot be used just now; try again after `retry-after`.
    #[response(status = 503, content_type = "application/problem+json")]
    Unavailable(#[to_schema] Problem),
    /// It has no space left; nothing was changed.
    #[response(status = 507, content_type = "application/problem+json")]
    InsufficientStorage(#[to_schema] Problem),
}

impl Problem {
    /// A problem of a kind (`word`), with its status and a sentence.
    pub fn new(status: StatusCode, word: &str, detail: impl Into<String>) -> Self {
        Self {
            kind: format!("urn:cairn:problem:{word}"),
            title: word.replace('-', " "),
            status: status.as_u16(),
            detail: detail.into(),
            field: None,
            limit: None,
            retry_after: None,
        }
    }

    /// A wrong parameter, body field or header.
    pub fn invalid(field: &str, detail: impl Into<String>) -> Self {
        Self { field: Some(field.to_owned()), ..Self::new(StatusCode::BAD_REQUEST, "invalid-field", detail) }
    }

    /// Something that is not there.
    pub fn not_found(detail: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, "not-found", detail)
    }

    /// A failure of the service. The cause goes to the log, never to the client.
    pub fn internal(cause: impl std::fmt::Display) -> Self {
        tracing::error!(%cause, "a request failed");
        Self::new(
            StatusCode::INTERNAL_SERVER_ERROR,
            "internal-error",
            "the service failed; its log has the cause under the request id",
        )
    }

    /// The disk is nearly full, and what little is left is for the work that was taken on.
    pub(super) fn low_disk() -> Self {
        let detail = "the service has too little space left to take this in";
        Self {
            retry_after: NonZeroU16::new(30),
            ..Self::new(StatusCode::SERVICE_UNAVAILABLE, "low-disk", detail)
        }
    }

    /// The machine lacks something, and may have it again soon.
    fn unavailable(trouble: Trouble, cause: &StorageError) -> Self {
        tracing::error!(%cause, "a request could not be served");
        match trouble {
            Trouble::Full => Self::new(
                StatusCode::INSUFFICIENT_STORAGE,
                "insufficient-storage",
                "the service has no space left for this; nothing was changed, and it works again when there is space",
            ),
            Trouble::Busy => Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "busy",
                "the service's database is held by another process; try again",
            ),
            Trouble::Failing => Self::new(
                StatusCode::SERVICE_UNAVAILABLE,
                "storage-failing",
                "the service cannot read or write its files just now; nothing was changed",
            ),
        }
    }

    /// Why a job failed, in the same form as every other error.
    #[must_use]
    pub fn of_fault(fault: &Fault) -> Self {
        let status = match fault.code.as_str() {
            "unreadable-scan" | "unfit-scan" => StatusCode::UNPROCESSABLE_ENTITY,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self::new(status, &fault.code, fault.detail.clone())
    }
}

/// Travels with an answer for whoever counts: which kind of problem it is.
#[derive(Debug, Clone)]
pub(super) struct Reason(pub String);

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let status = StatusCode::from_u16(self.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
        let mut response = (status, axum::Json(&self)).into_response();
        let problem = HeaderValue::from_static("application/problem+json");
        response.headers_mut().insert(header::CONTENT_TYPE, problem);
        let word = self.kind.rsplit(':').next().unwrap_or("").to_owned();
        response.extensions_mut().insert(Reason(word));
        if let Some(seconds) = self.retry_after {
            response.headers_mut().insert(header::RETRY_AFTER, seconds.get().into());
        }
        if status == StatusCode::UNAUTHORIZED {
            response
                .headers_mut()
                .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer realm=\"cairn\""));
        }
        if matches!(status, StatusCode::SERVICE_UNAVAILABLE | StatusCode::INSUFFICIENT_STORAGE) {
            response.headers_mut().entry(header::RETRY_AFTER).or_insert(HeaderValue::from_static("5"));
        }
        response
    }
}

impl From<StorageError> for Problem {
    fn from(error: StorageError) -> Self {
        match error {
            StorageError::NoProject(_)
            | StorageError::NoScan(_)
            | StorageError::NoJob(_)
            | StorageError::NoDecision(_)
            | StorageError::NoUpload(_)
            | StorageError::NoKey(_)
            | StorageError::NoWebhook(_)
            | StorageError::NoVersion(..) => Self::not_found(error.to_string()),
            StorageError::JobEnded(_) => Self::new(
                StatusCode::CONFLICT,
                "job-ended",
                format!(
                    "{error}: only jobs that are {} or {} can be dismissed, and removals and decisions cannot",
                    JobState::Accepted.as_str(),
                    JobState::Running.as_str()
                ),
            ),
            StorageError::OverQuota { quota, limit, .. } => Self {
                limit: Some(limit),
                retry_after: NonZeroU16::new(match quota {
                    // These end by themselves; room for scans comes when somebody deletes some or raises the limit.
                    Quota::QueuedJobs => 10,
                    Quota::OpenUploads => 60,
                    Quota::Bytes | Quota::Scans => 3600,
                }),
                ..Self::new(StatusCode::TOO_MANY_REQUESTS, "over-quota", error.to_string())
            },
            StorageError::TooManyWebhooks { limit, .. } => Self {
                limit: Some(limit.into()),
                ..Self::new(StatusCode::CONFLICT, "too-many-webhooks", error.to_string())
            },
            StorageError::TooManyDecisions { limit, .. } => Self {
                limit: Some(limit.into()),
                ..Self::new(StatusCode::CONFLICT, "too-many-decisions", error.to_string())
            },
            StorageError::DamagedUpload { .. } => {
                Self::new(StatusCode::GONE, "upload-lost", format!("{error}; begin it anew"))
            }
            error => match error.trouble() {
                Some(trouble) => Self::unavailable(trouble, &error),
                None => Self::internal(error),
            },
        }
    }
}

impl From<IntakeError> for Problem {
    fn from(error: IntakeError) -> Self {
        let detail = error.to_string();
        match error {
            IntakeError::TooLarge { limit } => {
                Self { limit: Some(limit), ..Self::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", detail) }
            }
            IntakeError::Empty => Self::new(StatusCode::UNPROCESSABLE_ENTITY, "empty-upload", detail),
            IntakeError::UnknownFormat => {
                Self::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unknown-format", detail)
            }
            IntakeError::WrongExtension { .. } => Self {
                field: Some("name".to_owned()),
                ..Self::new(StatusCode::UNPROCESSABLE_ENTITY, "wrong-extension", detail)
            },
            IntakeError::Digest(_) => Self {
                field: Some("content-digest".to_owned()),
                ..Self::new(StatusCode::BAD_REQUEST, "digest-mismatch", detail)
            },
            IntakeError::Interrupted { .. } => {
                Self::new(StatusCode::BAD_REQUEST, "upload-interrupted", detail)
            }
            IntakeError::Stalled { .. } => Self::new(StatusCode::REQUEST_TIMEOUT, "upload-stalled", detail),
            IntakeError::LowDisk => Self::low_disk(),
            IntakeError::Storage(error) => error.into(),
        }
    }
}

impl From<ExportError> for Problem {
    fn from(error: ExportError) -> Self {
        match error {
            ExportError::NothingThere => Self::not_found(error.to_string()),
            ExportError::TooFine { limit, .. } => Self {
                field: Some("voxel".to_owned()),
                limit: Some(limit),
                ..Self::new(StatusCode::UNPROCESSABLE_ENTITY, "too-fine", error.to_string())
            },
            ExportError::LowDisk => Self::low_disk(),
            ExportError::Storage(error) => error.into(),
            other => Self::internal(other),
        }
    }
}
