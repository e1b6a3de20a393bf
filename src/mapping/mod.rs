//! The incremental mapper: from verified edges to a model that grows one join at a time. Uses `graph` and `optimize`; the
//! service and the command line see only [`LiveModel`] and [`ModelSnapshot`].
//!
//! Beside the paper: the scan graph is `graph`; `initial_pair` starts a component; `next_scan` ranks what comes next;
//! `candidates` clusters the poses that the neighbours propose; `join` pools the cluster's matches, fits and verifies; `tracks`
//! continue, are created and merge, with closed-form and robust aggregation; `refine` is local and global bundle adjustment, pose graph
//! and joint dense adjustment; `track_refinement` moves keypoints; `mapper` has one method a step and `policy` their order.

mod belief;
mod bent_join;
mod borne_out;
mod candidates;
mod close_look;
mod component;
mod consistency;
mod cuts;
mod decision;
mod denial;
mod filter;
mod finding;
mod gravity;
mod guarded;
mod hearing;
mod initial_pair;
mod intrusion;
mod join;
mod live_model;
mod mapper;
mod moves;
mod next_scan;
mod open_join;
mod options;
mod parting;
mod policy;
mod reclaim;
mod refine;
mod refusals;
mod settle;
mod snapshot;
mod surfaces;
#[cfg(test)]
mod test_hall;
mod testimony;
mod track_refinement;
mod tracks;
mod undecided;
mod undo;
mod violation;
mod voice;
mod waiting_reason;
mod widening;

pub use decision::{Decision, Decisions, Verdict};
pub use join::Refusal;
pub use live_model::{LiveModel, RefinementReport, RestoreError};
pub use open_join::{OpenJoin, RivalPose, Undone};
pub use options::{JoinLevel, MappingOptions};
pub use snapshot::{ComponentSnapshot, ModelSnapshot, RegisteredScan, ScanOutcome, WaitingReason};
pub use tracks::{Landmark, TrackObservation, Tracks, aggregate, aggregate_robustly};
