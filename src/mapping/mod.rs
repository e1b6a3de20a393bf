//! The incremental mapper: from verified edges to a model that grows one join at a time.

mod live_model;
mod snapshot;

pub use live_model::{LiveModel, MappingOptions, RefinementReport, RestoreError};
pub use snapshot::{ComponentSummary, ModelSnapshot, RegisteredScan, ScanOutcome, WaitingReason};
