//! Writing blobs that arrive in pieces, on the async side.
//!
//! While pieces are received, those before are hashed and written by a blocking thread, and those before them are already on their way
//! to the disk: what is left to sync at the end is little, however large the blob. No thread waits for a slow client.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use tokio::task::{JoinHandle, spawn_blocking};

use super::blobs::BlobId;
use super::{BlobStore, FreshBlob, StorageError, StoredBlob};

/// Bytes that are hashed and written at once.
const PIECE: usize = 1 << 20;
/// After so many bytes the disk is told to begin.
const SYNC_EVERY: u64 = 32 << 20;

/// A temporary file that disappears unless it is kept.
#[derive(Debug)]
pub(super) struct Partial(Option<PathBuf>);

impl Partial {
    pub fn new(path: PathBuf) -> Self {
        Self(Some(path))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.as_deref().unwrap_or(Path::new(""))
    }

    /// Gives it its place, where it stays.
    pub fn keep_as(mut self, place: &Path) -> io::Result<()> {
        fs::rename(self.path(), place)?;
        self.0 = None;
        Ok(())
    }
}

impl Drop for Partial {
    fn drop(&mut self) {
        if let Some(path) = &self.0 {
            // Nobody can be told, and the next start clears the folder.
            let _ = fs::remove_file(path);
        }
    }
}

/// What the blocking thread works on.
#[derive(Debug)]
struct Sink {
    file: File,
    partial: Partial,
    hasher: blake3::Hasher,
}

impl Sink {
    fn begin(store: &BlobStore) -> io::Result<Self> {
        let path = store.temporary();
        let file = File::create_new(&path)?;
        Ok(Self { file, partial: Partial::new(path), hasher: blake3::Hasher::new() })
    }

    fn take(&mut self, piece: &[u8]) -> io::Result<()> {
        self.hasher.update(piece);
        self.file.write_all(piece)
    }
}

/// The sink, and the emptied piece that went into it.
type Written = (Sink, Vec<u8>);

/// A blob that is arriving. Dropping it forgets what has arrived.
#[derive(Debug)]
pub struct BlobWriter {
    store: BlobStore,
    /// Received and not yet handed on.
    piece: Vec<u8>,
    /// The sink while nobody works on it …
    sink: Option<Sink>,
    /// … and while somebody does, who gives back the emptied piece.
    writing: Option<JoinHandle<io::Result<Written>>>,
    syncing: Option<JoinHandle<io::Result<()>>>,
    bytes: u64,
    synced: u64,
}

impl BlobStore {
    /// Begins a blob that arrives in pieces, on the async side.
    #[must_use]
    pub fn writer(&self) -> BlobWriter {
        let store = self.clone();
        BlobWriter { store, piece: Vec::new(), sink: None, writing: None, syncing: None, bytes: 0, synced: 0 }
    }
}

impl BlobWriter {
    /// Appends a piece.
    pub async fn write(&mut self, mut piece: &[u8]) -> Result<(), StorageError> {
        self.bytes += piece.len() as u64;
        while !piece.is_empty() {
            let (now, later) = piece.split_at(piece.len().min(PIECE - self.piece.len()));
            self.piece.extend_from_slice(now);
            piece = later;
            if self.piece.len() == PIECE {
                self.hand_on().await?;
            }
        }
        Ok(())
    }

    /// Bytes so far.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Makes the blob safe: file and folders are synced when this returns.
    pub async fn finish(mut self) -> Result<FreshBlob, StorageError> {
        self.written().await?;
        if let Some(syncing) = self.syncing.take() {
            joined(syncing).await.map_err(StorageError::io("syncing a blob"))?;
        }
        let Self { store, piece, sink, bytes, .. } = self;
        let finish = move || {
            let mut sink =
                sink.map_or_else(|| Sink::begin(&store), Ok).map_err(StorageError::io("beginning a blob"))?;
            sink.take(&piece).map_err(StorageError::io("writing a blob"))?;
            sink.file.sync_all().map_err(StorageError::io("syncing a blob"))?;
            let id = BlobId(sink.hasher.finalize());
            Ok(FreshBlob::new(StoredBlob { id, bytes }, store.settle(sink.partial, id)?))
        };
        spawn_blocking(finish).await.map_err(|e| StorageError::io("naming a blob")(io::Error::other(e)))?
    }

    /// Has the piece hashed and written while the next one is received.
    async fn hand_on(&mut self) -> Result<(), StorageError> {
        let emptied = self.written().await?;
        let piece = std::mem::replace(&mut self.piece, emptied);
        if self.bytes - self.synced >= SYNC_EVERY {
            self.begin_sync().await?;
        }
        let (store, sink) = (self.store.clone(), self.sink.take());
        self.writing = Some(spawn_blocking(move || {
            let mut sink = sink.map_or_else(|| Sink::begin(&store), Ok)?;
            sink.take(&piece)?;
            let mut emptied = piece;
            emptied.clear();
            Ok((sink, emptied))
        }));
        Ok(())
    }

    /// Waits until what was handed on is written; returns an empty piece.
    async fn written(&mut self) -> Result<Vec<u8>, StorageError> {
        let Some(writing) = self.writing.take() else { return Ok(Vec::with_capacity(PIECE)) };
        let (sink, emptied) = joined(writing).await.map_err(StorageError::io("writing a blob"))?;
        self.sink = Some(sink);
        Ok(emptied)
    }

    /// Tells the disk to begin with what is written so far. It fails here if the last time did not go well.
    async fn begin_sync(&mut self) -> Result<(), StorageError> {
        let failed = |e| StorageError::io("syncing a blob")(e);
        if let Some(syncing) = &self.syncing {
            if !syncing.is_finished() {
                return Ok(());
            }
            if let Some(syncing) = self.syncing.take() {
                joined(syncing).await.map_err(failed)?;
            }
        }
        if let Some(sink) = &self.sink {
            let file = sink.file.try_clone().map_err(failed)?;
            self.syncing = Some(spawn_blocking(move || file.sync_data()));
            self.synced = self.bytes;
        }
        Ok(())
    }
}

async fn joined<T>(task: JoinHandle<io::Result<T>>) -> io::Result<T> {
    task.await.map_err(io::Error::other)?
}
