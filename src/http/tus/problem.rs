//! Errors of the protocol as problem details.

use axum::http::StatusCode;

use crate::http::Problem;
use crate::jobs::{IntakeError, ResumableError};

/// The protocol's own status for bytes that are not those that were sent.
const CHECKSUM_MISMATCH: u16 = 460;

impl From<ResumableError> for Problem {
    fn from(error: ResumableError) -> Self {
        let detail = error.to_string();
        match error {
            ResumableError::Expired(_) => Self::new(StatusCode::GONE, "upload-expired", detail),
            ResumableError::Offset { .. } => Self {
                field: Some("upload-offset".to_owned()),
                ..Self::new(StatusCode::CONFLICT, "offset-mismatch", detail)
            },
            ResumableError::PastEnd { length } => {
                Self { limit: Some(length), ..Self::new(StatusCode::PAYLOAD_TOO_LARGE, "past-end", detail) }
            }
            ResumableError::Digest(_) => Self {
                status: CHECKSUM_MISMATCH,
                // The status that stands in for it is replaced.
                ..Self::new(StatusCode::BAD_REQUEST, "checksum-mismatch", detail)
            },
            ResumableError::Busy => Self::new(StatusCode::LOCKED, "upload-busy", detail),
            ResumableError::TakenOver => Self::new(StatusCode::CONFLICT, "taken-over", detail),
            ResumableError::Stopping => Self::new(StatusCode::SERVICE_UNAVAILABLE, "not-ready", detail),
            ResumableError::Intake(IntakeError::TooLarge { limit }) => Self {
                limit: Some(limit),
                field: Some("upload-length".to_owned()),
                ..Self::new(StatusCode::PAYLOAD_TOO_LARGE, "too-large", detail)
            },
            ResumableError::Intake(error) => error.into(),
        }
    }
}
