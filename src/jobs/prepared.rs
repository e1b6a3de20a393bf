//! Prepared scans: a pure function of upload and parameters, remembered under the hash of both.

use std::sync::Arc;

use rayon::prelude::*;

use super::JobError;
use super::originals::{Original, read_original};
use super::parameters::{Parameters, scan_key};
use super::session::Task;
use crate::control::Control;
use crate::features::{PreparedScan, prepare};
use crate::project::Scan;
use crate::storage::{BlobId, BlobStore, FreshBlob, Owner, StorageError, StoredBlob};

/// A prepared scan, and its new blob if it was not remembered.
type Made = (Arc<PreparedScan>, Option<FreshBlob>);

/// Scans that are prepared before their results are remembered: what a crash costs at most.
const AT_ONCE: usize = 32;

/// The prepared forms of scans, in the same order: from the cache where they are there, otherwise made from the uploads,
/// on all threads. A scan that cannot be prepared has its own error; `Err` is for all.
pub(super) async fn prepare_all(
    task: &Task,
    scans: &[Scan],
    parameters: Parameters,
) -> Result<Vec<Result<Arc<PreparedScan>, JobError>>, JobError> {
    let mut all = Vec::with_capacity(scans.len());
    for part in scans.chunks(AT_ONCE) {
        let mut wanted = Vec::with_capacity(part.len());
        for scan in part {
            wanted.push((scan.clone(), task.store.derived(&parameters.prepared_key(scan.key)).await?));
        }
        let (blobs, max_points) = (task.store.blobs.clone(), task.options.max_points);
        let made: Vec<Result<Made, JobError>> = task
            .compute(move |control| {
                let one = |(scan, cached): &(Scan, Option<StoredBlob>)| {
                    if let Some(found) = cached.and_then(|cached| read(&blobs, scan, cached.id)) {
                        return Ok((found, None));
                    }
                    let original = read_original(&blobs, scan, max_points, control.cancel)?;
                    let (prepared, fresh) = make(&blobs, scan, &original, parameters, control)?;
                    Ok((prepared, Some(fresh)))
                };
                wanted.par_iter().map(one).collect()
            })
            .await?;
        for (scan, made) in part.iter().zip(made) {
            all.push(match made {
                Ok((prepared, fresh)) => {
                    if let Some(fresh) = fresh {
                        remember(task, scan, parameters, &fresh).await?;
                    }
                    Ok(prepared)
                }
                Err(error) => Err(error),
            });
        }
    }
    Ok(all)
}

/// Prepares a decoded scan and stores the result. Blocks; belongs into the thread pool.
pub(super) fn make(
    blobs: &BlobStore,
    scan: &Scan,
    original: &Original,
    parameters: Parameters,
    control: Control<'_>,
) -> Result<(Arc<PreparedScan>, FreshBlob), JobError> {
    let options = parameters.prepare_options();
    let prepared = prepare(scan_key(scan.key), &original.decoded.cloud, original.stance, &options, control)?;
    let bytes = prepared.to_bytes().map_err(|e| JobError::for_good("internal-error", e))?;
    let stored = blobs.put(&bytes)?;
    Ok((Arc::new(prepared), stored))
}

/// Remembers the prepared form of a scan.
pub(super) async fn remember(
    task: &Task,
    scan: &Scan,
    parameters: Parameters,
    fresh: &FreshBlob,
) -> Result<(), StorageError> {
    let owner = Owner { project: scan.project, scan: Some(scan.id) };
    task.store.remember(&parameters.prepared_key(scan.key), owner, fresh).await
}

/// A remembered form. One that cannot be read is made again: the upload is what counts.
fn read(blobs: &BlobStore, scan: &Scan, id: BlobId) -> Option<Arc<PreparedScan>> {
    let read = blobs
        .get(id)
        .map_err(|e| e.to_string())
        .and_then(|bytes| PreparedScan::from_bytes(&bytes).map_err(|e| e.to_string()));
    match read {
        Ok(prepared) => Some(Arc::new(prepared)),
        Err(error) => {
            tracing::warn!(scan = %scan.id, %error, "a cached prepared scan is unreadable and is made again");
            None
        }
    }
}
