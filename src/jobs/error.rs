//! Why a job stops before its end: what a worker then does with it.

use super::Panicked;
use crate::cloud::DecodeError;
use crate::control::Cancelled;
use crate::features::PrepareError;
use crate::mapping::RestoreError;
use crate::project::Fault;
use crate::storage::{Retry, StorageError};

/// The code of faults that come of damaged data on our own disk.
pub(super) const DAMAGED: &str = "damaged-data";

/// Why a job stops before its end.
#[derive(Debug, thiserror::Error)]
pub enum JobError {
    /// Somebody else has it now, or it was dismissed: nothing is to be done.
    #[error("the job is no longer ours")]
    Lost,
    /// It was told to stop, by a shutdown or because it was lost.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// It cannot be done, or (`retry`) not now.
    #[error("{}: {}", fault.code, fault.detail)]
    Failed {
        /// What the client is told.
        fault: Fault,
        /// Whether another attempt may go better.
        retry: Retry,
    },
}

impl JobError {
    /// A failure that every attempt would meet.
    #[must_use]
    #[expect(
        clippy::needless_pass_by_value,
        reason = "an error ends here, and `map_err` hands it over whole"
    )]
    pub fn for_good(code: &str, detail: impl ToString) -> Self {
        Self::Failed {
            fault: Fault { code: code.to_owned(), detail: detail.to_string() },
            retry: Retry::Never,
        }
    }

    /// A failure that may pass.
    #[must_use]
    #[expect(
        clippy::needless_pass_by_value,
        reason = "an error ends here, and `map_err` hands it over whole"
    )]
    pub fn for_now(code: &str, detail: impl ToString) -> Self {
        Self::Failed {
            fault: Fault { code: code.to_owned(), detail: detail.to_string() },
            retry: Retry::AFewTimes,
        }
    }
}

impl From<StorageError> for JobError {
    fn from(error: StorageError) -> Self {
        match error {
            StorageError::Fenced { .. } | StorageError::NoProject(_) | StorageError::NoJob(_) => Self::Lost,
            error if error.is_damage() => Self::for_good(DAMAGED, error),
            // The text goes to clients: what exactly failed is for the log only.
            other => {
                tracing::error!(error = %other, "storage failed under a job");
                let detail = "the service could not read or write its data".to_owned();
                let fault = Fault { code: "storage".to_owned(), detail };
                // Trouble of the machine is not the job's doing.
                let retry = other.trouble().map_or(Retry::AFewTimes, |_| Retry::UntilItPasses);
                Self::Failed { fault, retry }
            }
        }
    }
}

impl From<Panicked> for JobError {
    fn from(Panicked(message): Panicked) -> Self {
        tracing::error!(%message, "a computation panicked");
        Self::for_now("internal-error", "the computation failed in a way that is a fault of this program")
    }
}

impl From<DecodeError> for JobError {
    fn from(error: DecodeError) -> Self {
        match error {
            DecodeError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::for_good("unreadable-scan", other),
        }
    }
}

impl From<PrepareError> for JobError {
    fn from(error: PrepareError) -> Self {
        match error {
            PrepareError::Cancelled(cancelled) => Self::Cancelled(cancelled),
            other => Self::for_good("unfit-scan", other),
        }
    }
}

impl From<RestoreError> for JobError {
    fn from(error: RestoreError) -> Self {
        Self::for_good(DAMAGED, error)
    }
}
