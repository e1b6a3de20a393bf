//! What reading has found out about blobs: which files are known to be sound, and which are damaged.
//!
//! Kept in memory, because blobs are read where no transaction is open. `damage` writes what is found into its table.

use std::collections::HashMap;
use std::fs::Metadata;
use std::os::unix::fs::MetadataExt;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::BlobId;

/// What is wrong with the file of a blob.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Finding {
    /// It is not there.
    Missing,
    /// Its bytes no longer have the hash that is its name, or cannot be read.
    Altered,
}

impl Finding {
    /// The word that is stored and shown.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::Altered => "altered",
        }
    }

    /// The finding of a word.
    #[must_use]
    pub fn from_word(word: &str) -> Option<Self> {
        [Self::Missing, Self::Altered].into_iter().find(|f| f.as_str() == word)
    }
}

/// A file as it was when its hash was found right. Another one means that it must be read again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Stamp {
    inode: u64,
    bytes: u64,
    changed: (i64, i64),
}

impl Stamp {
    pub fn of(metadata: &Metadata) -> Self {
        let changed = (metadata.mtime(), metadata.mtime_nsec());
        Self { inode: metadata.ino(), bytes: metadata.len(), changed }
    }
}

/// Files that are remembered as sound, at most; beyond that all are forgotten and read again when asked for.
const REMEMBERED: usize = 8192;
/// How long they are remembered: disks forget without telling.
const REMEMBERED_FOR: Duration = Duration::from_hours(1);

/// What is known of the files of blobs.
#[derive(Debug, Default)]
pub(super) struct Ledger(Mutex<State>);

#[derive(Debug, Default)]
struct State {
    sound: HashMap<BlobId, (Stamp, Instant)>,
    damaged: HashMap<BlobId, Finding>,
    /// Changes since the last look; `None`: sound again.
    news: Vec<(BlobId, Option<Finding>)>,
}

impl Ledger {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether this very file was found sound lately.
    pub fn knows(&self, id: BlobId, stamp: Stamp) -> bool {
        self.lock().sound.get(&id).is_some_and(|(known, at)| *known == stamp && at.elapsed() < REMEMBERED_FOR)
    }

    /// The file has the hash that is its name.
    pub fn sound(&self, id: BlobId, stamp: Stamp) {
        let mut state = self.lock();
        if state.sound.len() >= REMEMBERED {
            state.sound.clear();
        }
        state.sound.insert(id, (stamp, Instant::now()));
        if state.damaged.remove(&id).is_some() {
            state.news.push((id, None));
        }
    }

    /// The file is damaged.
    pub fn damaged(&self, id: BlobId, finding: Finding) {
        let mut state = self.lock();
        state.sound.remove(&id);
        if state.damaged.insert(id, finding) != Some(finding) {
            state.news.push((id, Some(finding)));
            // A missing file may belong to what was just deleted: that is told when it is written down.
            if finding == Finding::Altered {
                tracing::error!(blob = %id, "the file of a blob is damaged");
            }
        }
    }

    /// Damage that is in the table already.
    pub fn recall(&self, id: BlobId, finding: Finding) {
        self.lock().damaged.insert(id, finding);
    }

    /// The file was deleted because nothing needs it.
    pub fn forget(&self, id: BlobId) {
        let mut state = self.lock();
        state.sound.remove(&id);
        state.damaged.remove(&id);
    }

    /// What changed since the last call.
    pub fn take_news(&self) -> Vec<(BlobId, Option<Finding>)> {
        std::mem::take(&mut self.lock().news)
    }

    /// Puts news back that could not be written.
    pub fn return_news(&self, news: Vec<(BlobId, Option<Finding>)>) {
        let mut state = self.lock();
        let later = std::mem::replace(&mut state.news, news);
        state.news.extend(later);
    }
}
