//! Work on the whole model that a client asks for.

use serde_json::{Value, json};

use super::JobError;
use super::session::{Session, Task};
use crate::mapping::RefinementReport;
use crate::project::{JobKind, ModelContent, VersionNumber};

/// Runs one operation on the whole model and publishes what it improved.
pub(super) async fn refine(task: &Task) -> Result<(), JobError> {
    let mut session = Session::open(task, task.claim.job.project).await?;
    session.obey(task).await?;
    let kind = task.claim.job.kind;
    let report = session
        .change(task, move |model, control| {
            Ok::<_, JobError>(match kind {
                JobKind::GlobalBundleAdjustment => Some(model.global_bundle_adjustment(control)?),
                JobKind::TrackRefinement => Some(model.track_refinement(control)?),
                JobKind::DenseRefinement => Some(model.dense_refinement(control)?),
                JobKind::Rebuild | JobKind::Registration | JobKind::Removal | JobKind::Decision => {
                    model.rebuild(control)?;
                    None
                }
            })
        })
        .await??;
    session
        .publish(task, |content, version, _| {
            let mut outcome = whole_model(content, version);
            if let (Value::Object(fields), Some(report)) = (&mut outcome, &report) {
                fields.extend(words(report));
            }
            Ok(outcome)
        })
        .await
}

/// How work on the whole model ends.
pub(super) fn whole_model(content: &ModelContent, version: VersionNumber) -> Value {
    json!({
        "status": "done",
        "version": version,
        "components": content.components.len(),
        "registered": content.placed(None).count(),
        "open_joins": content.open_joins.len(),
        "undone": content.undone.len(),
    })
}

fn words(report: &RefinementReport) -> serde_json::Map<String, Value> {
    match serde_json::to_value(report) {
        Ok(Value::Object(fields)) => fields,
        _ => serde_json::Map::new(),
    }
}
