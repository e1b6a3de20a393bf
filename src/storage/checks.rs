//! Checking files for many readers: one reads a file, the others wait for what it finds, and few files are read at a time. Whoever asks
//! again and again, or leaves, makes no more reading than whoever waits. Used by `blob_reader`.

use std::collections::HashMap;
use std::io;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};

use tokio::sync::Semaphore;

use super::{BlobId, StorageError};

/// Files that are read at the same time, so that checks keep neither the disk nor the threads for work that blocks to themselves.
const AT_ONCE: usize = 4;

/// What was found.
type Finding = Result<(), StorageError>;

/// A check, held by who makes it and awaited by who needs it; what it found, once it has ended.
type Check = tokio::sync::Mutex<Option<Finding>>;

/// Checks that are being made or waited for.
#[derive(Debug)]
pub(super) struct Checks {
    open: Mutex<HashMap<BlobId, Weak<Check>>>,
    places: Arc<Semaphore>,
}

impl Default for Checks {
    fn default() -> Self {
        Self { open: Mutex::default(), places: Arc::new(Semaphore::new(AT_ONCE)) }
    }
}

impl Checks {
    /// What `check`, which blocks, finds out about a file, or what one that was asked for before has found. It ends although nobody
    /// waits for it any more, and has its place and its file to itself until then.
    pub async fn found(
        self: &Arc<Self>,
        id: BlobId,
        check: impl FnOnce() -> Finding + Send + 'static,
    ) -> Finding {
        let mut turn = self.join(id).lock_owned().await;
        if let Some(found) = &*turn {
            return told(found);
        }
        let failed = |error| StorageError::io("checking a file")(error);
        let place = Arc::clone(&self.places);
        let place = place.acquire_owned().await.map_err(|error| failed(io::Error::other(error)))?;
        let checks = Arc::clone(self);
        let running = tokio::task::spawn_blocking(move || {
            let _place = place;
            let found = check();
            // Whoever comes from now on asks anew: the file may be repaired, or damaged, at any moment.
            checks.open().remove(&id);
            *turn = Some(told(&found));
            found
        });
        running.await.map_err(|error| failed(io::Error::other(error)))?
    }

    fn open(&self) -> MutexGuard<'_, HashMap<BlobId, Weak<Check>>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The check of this file that is open, or a new one.
    fn join(&self, id: BlobId) -> Arc<Check> {
        let mut open = self.open();
        if let Some(check) = open.get(&id).and_then(Weak::upgrade) {
            return check;
        }
        // All who waited for these have left.
        open.retain(|_, check| check.strong_count() > 0);
        let check = Arc::default();
        open.insert(id, Arc::downgrade(&check));
        check
    }
}

/// What was found, for another one who waited for it.
fn told(found: &Finding) -> Finding {
    let Err(error) = found else { return Ok(()) };
    Err(match error {
        StorageError::MissingBlob(id) => StorageError::MissingBlob(id.clone()),
        StorageError::DamagedBlob { expected, found } => {
            StorageError::DamagedBlob { expected: expected.clone(), found: found.clone() }
        }
        StorageError::Io { action, source } => {
            StorageError::Io { action, source: io::Error::new(source.kind(), source.to_string()) }
        }
        other => StorageError::io("checking a file")(io::Error::other(other.to_string())),
    })
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::mpsc;

    use tokio::task::JoinHandle;

    use super::*;

    /// Checks that begin and wait to be let go.
    struct Files {
        checks: Arc<Checks>,
        begun: Arc<AtomicUsize>,
        gate: Arc<Mutex<mpsc::Receiver<()>>>,
    }

    impl Files {
        fn new() -> (Self, mpsc::Sender<()>) {
            let (open, gate) = mpsc::channel();
            (Self { checks: Arc::default(), begun: Arc::default(), gate: Arc::new(Mutex::new(gate)) }, open)
        }

        /// Asks for a file, whose check finds it missing once it is let go.
        fn ask(&self, file: usize) -> JoinHandle<Finding> {
            let (checks, begun, gate) =
                (Arc::clone(&self.checks), Arc::clone(&self.begun), Arc::clone(&self.gate));
            let id = BlobId(blake3::hash(&file.to_le_bytes()));
            tokio::spawn(async move {
                let check = move || {
                    begun.fetch_add(1, Ordering::SeqCst);
                    // The end of the channel opens the gate for all.
                    let _ = gate.lock().unwrap().recv();
                    Err(StorageError::MissingBlob(file.to_string()))
                };
                checks.found(id, check).await
            })
        }

        /// Waits until so many have begun, and sees that no more do.
        async fn begun(&self, files: usize) {
            while self.begun.load(Ordering::SeqCst) < files {
                tokio::task::yield_now().await;
            }
            for _ in 0..1000 {
                tokio::task::yield_now().await;
            }
            assert_eq!(self.begun.load(Ordering::SeqCst), files);
        }
    }

    fn missing(found: &Finding, file: usize) -> bool {
        matches!(found, Err(StorageError::MissingBlob(name)) if *name == file.to_string())
    }

    #[tokio::test]
    async fn a_file_that_many_ask_for_is_read_once_and_all_are_told() {
        let (files, open) = Files::new();
        let asked: Vec<_> = (0..50).map(|_| files.ask(7)).collect();
        files.begun(1).await;
        drop(open);
        for asked in asked {
            assert!(missing(&asked.await.unwrap(), 7));
        }
        assert_eq!(files.begun.load(Ordering::SeqCst), 1);
        assert!(missing(&files.ask(7).await.unwrap(), 7));
        assert_eq!(files.begun.load(Ordering::SeqCst), 2, "who comes later has it read anew");
    }

    #[tokio::test]
    async fn who_comes_and_goes_has_no_more_files_read_than_who_stays() {
        let (files, open) = Files::new();
        for _ in 0..20 {
            let left = files.ask(0);
            files.begun(1).await;
            left.abort();
            assert!(left.await.unwrap_err().is_cancelled());
        }
        let left: Vec<_> = (1..20).map(|file| files.ask(file)).collect();
        files.begun(AT_ONCE).await;
        for left in left {
            left.abort();
            assert!(left.await.unwrap_err().is_cancelled());
        }
        let stays = files.ask(99);
        files.begun(AT_ONCE).await;
        drop(open);
        assert!(missing(&stays.await.unwrap(), 99));
        assert_eq!(files.begun.load(Ordering::SeqCst), AT_ONCE + 1);
        while !files.checks.open().is_empty() {
            tokio::task::yield_now().await;
        }
    }
}
