//! Holding the collector off from another process: a file in the data directory that is locked.
//!
//! The collector deletes files only while it has the lock alone; whoever needs files to stay (a backup, a check) shares it. The lock
//! goes with the process, however it ends.

use std::fs::{File, TryLockError};
use std::path::Path;

use super::StorageError;

/// While this lives, no process deletes files of blobs.
#[derive(Debug)]
pub struct Hold {
    _shared: File,
}

impl Hold {
    /// Waits until a collection that is under way has ended, then holds off the next ones. Blocks.
    pub(super) fn take(data: &Path) -> Result<Self, StorageError> {
        let file = open(data)?;
        file.lock_shared().map_err(StorageError::io("holding the collector off"))?;
        Ok(Self { _shared: file })
    }
}

/// The collector's turn, unless somebody holds it off: while this lives, no hold begins.
pub(super) fn turn(data: &Path) -> Result<Option<File>, StorageError> {
    let file = open(data)?;
    match file.try_lock() {
        Ok(()) => Ok(Some(file)),
        Err(TryLockError::WouldBlock) => Ok(None),
        Err(TryLockError::Error(e)) => Err(StorageError::io("asking for the collector's turn")(e)),
    }
}

fn open(data: &Path) -> Result<File, StorageError> {
    File::options()
        .create(true)
        .append(true)
        .open(data.join("cairn.hold"))
        .map_err(StorageError::io("opening the lock of the collector"))
}
