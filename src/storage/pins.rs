//! Blobs between their arrival on disk and the commit of the row that names them: the collector leaves them alone.

use std::collections::HashMap;
use std::ops::Deref;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::{BlobId, StoredBlob};

/// Which blobs are pinned, how often, and which no longer are.
#[derive(Debug, Default)]
pub(super) struct Pins(Mutex<State>);

/// The state behind the lock.
#[derive(Debug, Default)]
pub(super) struct State {
    held: HashMap<BlobId, usize>,
    released: Vec<BlobId>,
}

impl Pins {
    /// While this is held, nothing is pinned that was not.
    pub fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Blobs that were released since the last call. If nobody committed a row for one, it is garbage.
    pub fn take_released(&self) -> Vec<BlobId> {
        std::mem::take(&mut self.lock().released)
    }
}

impl State {
    /// Whether somebody is about to commit a row that names the blob.
    pub fn holds(&self, id: BlobId) -> bool {
        self.held.contains_key(&id)
    }
}

/// Keeps one blob from being collected for as long as it lives.
#[derive(Debug)]
pub(super) struct Pin {
    pins: Arc<Pins>,
    id: BlobId,
}

impl Pin {
    pub fn new(pins: &Arc<Pins>, id: BlobId) -> Self {
        *pins.lock().held.entry(id).or_default() += 1;
        Self { pins: Arc::clone(pins), id }
    }
}

impl Drop for Pin {
    fn drop(&mut self) {
        let mut state = self.pins.lock();
        if let Some(count) = state.held.get_mut(&self.id) {
            *count -= 1;
            if *count == 0 {
                state.held.remove(&self.id);
                state.released.push(self.id);
            }
        }
    }
}

/// A blob that was just stored. Keep it until the row that names it is committed: no row yet says that it is needed.
#[derive(Debug)]
pub struct FreshBlob {
    stored: StoredBlob,
    _pin: Pin,
}

impl FreshBlob {
    pub(super) fn new(stored: StoredBlob, pin: Pin) -> Self {
        Self { stored, _pin: pin }
    }
}

impl Deref for FreshBlob {
    type Target = StoredBlob;

    fn deref(&self) -> &StoredBlob {
        &self.stored
    }
}
