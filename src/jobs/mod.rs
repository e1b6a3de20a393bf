//! The work behind the API: taking uploads in, the queue's workers, one file per kind of job, and the files that are
//! made for download.
//!
//! Uses `storage` for all state and the core for all computation; `http` calls [`Intake`] and [`Exports`], `app` runs
//! the [`Workers`]. The only bridge from tokio to rayon is in `compute`.

mod audit;
mod compute;
mod content;
mod decide;
mod demand;
mod digest;
mod error;
mod exports;
mod ingest;
mod intake;
mod isolated;
mod merge;
mod model_cache;
mod originals;
mod pace;
mod parameters;
mod perform;
mod picture;
mod precedence;
mod prepared;
mod progress;
mod reason;
mod refine;
mod register;
mod remove;
mod resumable;
#[cfg(test)]
mod resumable_tests;
mod session;
mod turnstile;
pub mod webhooks;
mod workers;

pub use crate::cloud::metres_per_unit;
pub use audit::undecodable;
pub use compute::{Compute, Panicked};
pub use demand::{Connected, Demand};
pub use digest::{DigestAlgorithm, DigestMismatch, ExpectedDigest};
pub use error::JobError;
pub use exports::{ComponentChoice, ExportError, ExportLimits, Exports, Part};
pub use intake::{Intake, IntakeError, IntakeLimits, UploadRequest};
pub use isolated::{Isolated, Isolation, NOT_NOW, Order, Report, work_for_service};
pub(crate) use pace::Pace;
pub use parameters::DECIDING_SCANS;
pub use precedence::{answer_promptly, yield_to_clients};
pub use reason::{reason_of, reason_of_refusal};
pub use resumable::{Continuation, Resumable, ResumableError};
pub use workers::{WorkerOptions, Workers};
