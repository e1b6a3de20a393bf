//! Prepared scans: a pure function of upload and parameters, remembered under the hash of both.

use std::sync::Arc;

use super::JobError;
use super::originals::{Original, read_original};
use super::parameters::{Parameters, scan_key};
use super::session::Task;
use crate::control::Control;
use crate::features::{PreparedScan, prepare};
use crate::project::Scan;
use crate::storage::StoredBlob;

/// The prepared form of a scan: from the cache if it is there, otherwise made from the upload.
pub(super) async fn prepared(
    task: &Task,
    scan: &Scan,
    parameters: Parameters,
) -> Result<Arc<PreparedScan>, JobError> {
    if let Some(found) = cached(task, scan, parameters).await? {
        return Ok(found);
    }
    let (blobs, scan, max_points) = (task.store.blobs.clone(), scan.clone(), task.options.max_points);
    let key = parameters.prepared_key(scan.key);
    let (prepared, stored) = task
        .compute(move |control| {
            let original = read_original(&blobs, &scan, max_points, control.cancel)?;
            make(&blobs, &scan, &original, parameters, control)
        })
        .await??;
    task.store.remember(&key, stored).await?;
    Ok(prepared)
}

/// Prepares a decoded scan and stores the result. Blocks; belongs into the thread pool.
pub(super) fn make(
    blobs: &crate::storage::BlobStore,
    scan: &Scan,
    original: &Original,
    parameters: Parameters,
    control: Control<'_>,
) -> Result<(Arc<PreparedScan>, StoredBlob), JobError> {
    let options = parameters.prepare_options();
    let prepared = prepare(scan_key(scan.key), &original.decoded.cloud, original.sensor, &options, control)?;
    let bytes = prepared.to_bytes().map_err(|e| JobError::for_good("internal-error", e))?;
    let stored = blobs.put(&bytes)?;
    Ok((Arc::new(prepared), stored))
}

/// The remembered form, if there is one. One that cannot be read is made again: the upload is what counts.
async fn cached(
    task: &Task,
    scan: &Scan,
    parameters: Parameters,
) -> Result<Option<Arc<PreparedScan>>, JobError> {
    let Some(stored) = task.store.derived(&parameters.prepared_key(scan.key)).await? else { return Ok(None) };
    let blobs = task.store.blobs.clone();
    let read = task
        .compute(move |_| {
            let bytes = blobs.get(stored.id).map_err(|e| e.to_string())?;
            PreparedScan::from_bytes(&bytes).map_err(|e| e.to_string())
        })
        .await?;
    match read {
        Ok(prepared) => Ok(Some(Arc::new(prepared))),
        Err(error) => {
            tracing::warn!(scan = %scan.id, %error, "a cached prepared scan is unreadable and is made again");
            Ok(None)
        }
    }
}
