//! The first stage of a registration: one scan alone, any number of them at once.

use super::JobError;
use super::originals::read_original;
use super::parameters::Parameters;
use super::prepared::{make, remember};
use super::session::Task;
use crate::control::Stage;
use crate::features::{extent, natural_resolution};
use crate::project::Scan;
use crate::storage::{Measures, StorageError};

/// Decodes the upload, measures it, and prepares it under the resolution that the scans so far suggest (the mapper
/// prepares it again in the rare case that later ones suggest another).
pub(super) async fn ingest(task: &Task) -> Result<(), JobError> {
    let scan = scan_of(task).await?;
    let (blobs, max_points) = (task.store.blobs.clone(), task.options.max_points);
    let (original, measures) = {
        let scan = scan.clone();
        task.compute(move |control| -> Result<_, JobError> {
            control.report(Stage::Decode, 0, 1);
            let original = read_original(&blobs, &scan, max_points, control.cancel)?;
            control.report(Stage::Decode, 1, 1);
            let cloud = &original.decoded.cloud;
            let measures = Measures {
                points: cloud.len() as u64,
                colored: !cloud.colors.is_empty(),
                extent: extent(&cloud.points),
                scale: natural_resolution(&cloud.points),
            };
            Ok((original, measures))
        })
        .await??
    };
    let lease = &task.claim.lease;
    task.store.record_measures(lease, measures).await?;
    let project = task.store.project(scan.project).await?;
    let parameters = Parameters::choose(&task.store, &project).await?;
    let blobs = task.store.blobs.clone();
    let (_, fresh) = {
        let scan = scan.clone();
        task.compute(move |control| make(&blobs, &scan, &original, parameters, control)).await??
    };
    remember(task, &scan, parameters, &fresh).await?;
    Ok(task.store.finish_ingest(lease).await?)
}

/// The scan that a registration is about.
pub(super) async fn scan_of(task: &Task) -> Result<Scan, JobError> {
    let id = task.claim.job.scan.ok_or(JobError::Lost)?;
    // A scan that was deleted has had its registration dismissed.
    task.store.scan(task.claim.job.project, id).await.map_err(|error| match error {
        StorageError::NoScan(_) => JobError::Lost,
        other => other.into(),
    })
}
