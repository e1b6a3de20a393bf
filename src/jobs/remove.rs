//! Taking a deleted scan out of the model.

use serde_json::json;

use super::JobError;
use super::session::{Session, Task};

/// Publishes a version without the scan, if the model holds it.
pub(super) async fn remove(task: &Task) -> Result<(), JobError> {
    let mut session = Session::open(task, task.claim.job.project).await?;
    let id = task.claim.job.scan.ok_or(JobError::Lost)?;
    let scans = task.store.scans_ever(session.project.id).await?;
    let Some((scan, _)) = scans.iter().find(|(scan, _)| scan.id == id) else {
        return Err(JobError::Lost);
    };
    let was_there = session.remove(scan, &scans);
    session.forgotten.push(id);
    session.obey(task).await?;
    session
        .publish(task, |_, version, _| {
            Ok(json!({ "status": if was_there { "removed" } else { "unchanged" }, "version": version }))
        })
        .await
}
