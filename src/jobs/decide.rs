//! What clients decided, handed to the engine; and the job that makes the model obey it.
//!
//! The table of decisions is the truth. Every job that changes a model reads it when it opens the model ([`Session::obey`]), so a
//! decision holds for whatever runs first after it; the job made here only sees to it that something does.

use std::collections::HashMap;

use super::JobError;
use super::parameters::scan_key;
use super::refine::whole_model;
use super::session::{Session, Task};
use crate::mapping;
use crate::project::{ContentKey, KeptDecision, Scan, ScanId, Verdict};

/// Publishes a version that obeys all decisions, unless the newest does already.
pub(super) async fn decide(task: &Task) -> Result<(), JobError> {
    let mut session = Session::open(task, task.claim.job.project).await?;
    session.obey(task).await?;
    session.publish(task, |content, version, _| Ok(whole_model(content, version))).await
}

/// Decisions in the engine's terms.
pub(super) fn engine_decisions(
    kept: &[KeptDecision],
    by_key: &HashMap<ContentKey, Scan>,
) -> Vec<mapping::Decision> {
    let keys: HashMap<ScanId, ContentKey> = by_key.values().map(|scan| (scan.id, scan.key)).collect();
    let decision = |kept: &KeptDecision| {
        let a = scan_key(*keys.get(&kept.decision.scan_a)?);
        let b = scan_key(*keys.get(&kept.decision.scan_b)?);
        Some(match kept.decision.verdict {
            Verdict::Join { a_from_b } => mapping::Decision::join(a, b, &a_from_b),
            Verdict::Forbid { a_from_b } => mapping::Decision::forbid(a, b, a_from_b.as_ref()),
        })
    };
    kept.iter().filter_map(decision).collect()
}
