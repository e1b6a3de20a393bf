//! All state on disk: SQL rows ([`Store`]) and content-addressed files ([`BlobStore`]). Nothing else in the crate
//! speaks SQL or opens files of the data directory.
//!
//! Uses [`crate::project`]; used by `jobs` and `http`. Every change of state is one short `BEGIN IMMEDIATE`
//! transaction with `synchronous = FULL`: what was answered to a client survives a power cut.

mod backup;
mod blob_reader;
mod blob_writer;
mod blobs;
mod checks;
mod claims;
mod damage;
mod decisions;
mod derived;
mod error;
mod figures;
mod folders;
mod garbage;
mod hold;
mod idempotency;
mod integrity;
#[cfg(test)]
mod job_machine_tests;
mod job_rows;
mod keys;
#[cfg(test)]
mod lease_tests;
mod ledger;
mod orphans;
mod pins;
mod projects;
mod publication;
mod quotas;
mod references;
mod removals;
mod rows;
mod scans;
mod setbacks;
mod store;
#[cfg(test)]
pub(crate) mod testing;
mod thinning;
mod turns;
mod upload_files;
mod uploads;
mod versions;
mod webhooks;

pub use backup::{Copied, Sharing, backup, restore};
pub use blob_reader::BlobReader;
pub use blob_writer::BlobWriter;
pub use blobs::{BlobId, BlobStore, StoredBlob};
pub use claims::{Claim, Held, Lease, Measures};
pub use damage::Damage;
pub use derived::Owner;
pub use error::{StorageError, Trouble};
pub use figures::{EndedJob, Figures};
pub use hold::Hold;
pub use idempotency::{Answer, KeptAnswer, Receipt, Seal};
pub use job_rows::JobFilter;
pub use keys::{Keys, NewKey};
pub use ledger::Finding;
pub use pins::FreshBlob;
pub use publication::{NewVersion, Publication, ScanChange};
pub use quotas::{Holder, Quota};
pub use references::{Reference, Role};
pub use scans::{Admission, NewScan};
pub use setbacks::{Overdue, Retry};
pub use store::{Page, Store};
pub use thinning::KEPT_WHOLE;
pub use upload_files::{UploadFile, UploadFiles};
pub use versions::{pack, unpack};
pub use webhooks::{Attempt, DueDelivery};
