//! All state on disk: SQL rows ([`Store`]) and content-addressed files ([`BlobStore`]). Nothing else in the crate
//! speaks SQL or opens files of the data directory.
//!
//! Uses [`crate::project`]; used by `jobs` and `http`. Every change of state is one short `BEGIN IMMEDIATE`
//! transaction with `synchronous = FULL`: what was answered to a client survives a power cut.

mod blobs;
mod claims;
mod decisions;
mod derived;
mod error;
mod garbage;
mod idempotency;
mod job_rows;
mod keys;
#[cfg(test)]
mod lease_tests;
mod pins;
mod projects;
mod publication;
mod rows;
mod scans;
mod store;
mod upload_files;
mod uploads;
mod versions;

pub use blobs::{BlobId, BlobReader, BlobStore, BlobWriter, StoredBlob};
pub use claims::{Claim, Lease, Measures};
pub use derived::Owner;
pub use error::StorageError;
pub use idempotency::KeptAnswer;
pub use job_rows::JobFilter;
pub use keys::{Keys, NewKey};
pub use pins::FreshBlob;
pub use publication::{NewVersion, Publication, ScanChange};
pub use scans::{Admission, NewScan};
pub use store::{Page, Store};
pub use upload_files::{UploadFile, UploadFiles};
