//! The second stage of a registration: a batch of scans joins the model of their project.

use std::collections::HashMap;

use serde_json::{Value, json};

use super::JobError;
use super::parameters::{DECIDING_SCANS, Parameters};
use super::session::{Session, Task};
use crate::project::{Fault, JobId, ModelContent, Scan, ScanId, Standing, VersionNumber};
use crate::storage::StorageError;

/// Extends the model by the scans of the claim and publishes it. Each job gets its own outcome.
pub(super) async fn register(task: &Task) -> Result<(), JobError> {
    let mut session = Session::open(task, task.claim.job.project).await?;
    let scans = scans_of(task).await?;
    let subjects: HashMap<JobId, ScanId> = scans.iter().map(|s| (s.job, s.id)).collect();
    let parameters = Parameters::choose(&task.store, &session.project).await?;
    let undecided = session.before.scans.len() < DECIDING_SCANS as usize;
    if undecided && parameters != session.parameters && !session.before.scans.is_empty() {
        tracing::info!(
            from = session.parameters.resolution,
            to = parameters.resolution,
            "the first scans suggest another resolution; the model is made anew"
        );
        session.remake(task, parameters, scans).await?;
    } else {
        session.obey(task).await?;
        session.extend(task, scans).await?;
    }
    let unfit: HashMap<ScanId, Fault> = session.unfit.iter().cloned().collect();
    session.publish(task, |content, version, job| outcome(content, version, subjects.get(&job), &unfit)).await
}

async fn scans_of(task: &Task) -> Result<Vec<Scan>, JobError> {
    let mut scans = Vec::with_capacity(1 + task.claim.members.len());
    for job in std::iter::once(&task.claim.job).chain(&task.claim.members) {
        let Some(id) = job.scan else { continue };
        match task.store.scan(job.project, id).await {
            Ok(scan) => scans.push(scan),
            Err(StorageError::NoScan(_)) => return Err(JobError::Lost),
            Err(other) => return Err(other.into()),
        }
    }
    Ok(scans)
}

/// How one registration ends.
fn outcome(
    content: &ModelContent,
    version: VersionNumber,
    scan: Option<&ScanId>,
    unfit: &HashMap<ScanId, Fault>,
) -> Result<Value, Fault> {
    let missing =
        || Fault { code: "internal-error".to_owned(), detail: "the scan is not in the model".to_owned() };
    let scan = scan.ok_or_else(missing)?;
    if let Some(fault) = unfit.get(scan) {
        return Err(fault.clone());
    }
    match content.standing(*scan).ok_or_else(missing)? {
        Standing::Registered(place) => {
            Ok(json!({ "status": "registered", "component": place.component, "version": version }))
        }
        Standing::Waiting(reason) => {
            let mut outcome = json!({ "status": "waiting", "version": version, "reason": reason.reason });
            if let Value::Object(fields) = &mut outcome {
                fields.extend(reason.numbers.clone());
            }
            Ok(outcome)
        }
        Standing::Failed(fault) => Err(fault.clone()),
    }
}
