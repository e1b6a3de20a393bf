//! What a project is, as plain data: ids, settings, scans, jobs, model versions. No SQL, no HTTP, no engine.
//!
//! Uses [`crate::geometry`]; `storage` keeps these types, `jobs` works on them and `http` shows them.

mod decision;
mod id;
mod job;
mod key;
mod model;
mod name;
mod open_join;
mod scan;
mod settings;
mod time;
mod token;
mod upload;
mod webhook;

pub use decision::{BadMotion, Decision, KeptDecision, Verdict, motion};
pub use id::{BadId, DecisionId, JobId, KeyId, ProjectId, ScanId, UploadId, VersionNumber, WebhookId};
pub use job::{BadJobKind, Fault, Job, JobKind, JobState, Lane};
pub use key::{Key, Limits, Reach, Scope};
pub use model::{Component, Edge, ModelContent, Placement, Reason, Standing, Version};
pub use name::{BadName, Name};
pub use open_join::{OpenJoin, RivalPose, Undone};
pub use scan::{BadInterpretation, ContentKey, Interpretation, Scan, ScanState, three_numbers};
pub use settings::{BadSettings, Project, ProjectSettings};
pub use time::Timestamp;
pub use token::{BadToken, Digest, Token};
pub use upload::{NewUpload, Upload, UploadEnd};
pub use webhook::{Delivery, DeliveryState, SigningSecret, Webhook};
