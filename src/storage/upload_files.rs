//! The bytes of uploads that are not complete: one file each in `uploads/`, named by the upload's id.
//!
//! The row says how many of the bytes are safe; whatever is behind them in the file is from a request that a crash
//! interrupted, and goes when the file is opened next. A complete file moves to the blobs.

use std::fs::{self, File};
use std::io::{self, Read, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio::io::{AsyncSeekExt, AsyncWriteExt};

use super::{BlobId, StorageError, StoredBlob};
use crate::project::UploadId;

/// The folder of incomplete uploads. Clones share it.
#[derive(Debug, Clone)]
pub struct UploadFiles {
    root: Arc<Path>,
}

impl UploadFiles {
    /// Opens the folder `root` and makes it if needed.
    pub(super) fn open(root: &Path) -> Result<Self, StorageError> {
        fs::create_dir_all(root).map_err(StorageError::io("making the folder of uploads"))?;
        Ok(Self::at_folder(root))
    }

    /// The folder `root`, whoever made it.
    pub(super) fn at_folder(root: &Path) -> Self {
        Self { root: root.into() }
    }

    pub(super) fn path(&self, id: UploadId) -> PathBuf {
        self.root.join(id.to_string())
    }

    /// Opens an upload to be continued behind its first `kept` bytes. Bytes behind those are cut off.
    pub async fn at(&self, id: UploadId, kept: u64) -> Result<UploadFile, StorageError> {
        let (path, root) = (self.path(id), Arc::clone(&self.root));
        let file = blocking("opening an upload", move || open_at(&root, &path, id, kept)).await?;
        let mut file = tokio::fs::File::from_std(file);
        file.seek(SeekFrom::Start(kept)).await.map_err(StorageError::io("opening an upload"))?;
        Ok(UploadFile { file })
    }

    /// The first bytes of an upload, at most `limit`.
    pub async fn head(&self, id: UploadId, limit: usize) -> Result<Vec<u8>, StorageError> {
        let path = self.path(id);
        blocking("reading an upload", move || {
            let mut head = Vec::new();
            match File::open(path) {
                Ok(file) => file.take(limit as u64).read_to_end(&mut head).map(|_| head),
                Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(head),
                Err(e) => Err(e),
            }
            .map_err(StorageError::io("reading an upload"))
        })
        .await
    }

    /// Hashes a whole upload.
    pub async fn hash(&self, id: UploadId) -> Result<StoredBlob, StorageError> {
        let path = self.path(id);
        blocking("reading an upload", move || {
            let mut hasher = blake3::Hasher::new();
            let bytes = File::open(path)
                .and_then(|file| io::copy(&mut io::BufReader::with_capacity(1 << 16, file), &mut hasher))
                .map_err(StorageError::io("reading an upload"))?;
            Ok(StoredBlob { id: BlobId(hasher.finalize()), bytes })
        })
        .await
    }

    /// Deletes the bytes of an upload, if there are any. Blocks.
    pub(super) fn remove(&self, id: UploadId) -> Result<(), StorageError> {
        match fs::remove_file(self.path(id)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => Err(StorageError::io("deleting an upload")(e)),
            _ => Ok(()),
        }
    }

    /// How many bytes of an upload are here; 0 if its file cannot be seen.
    pub(super) fn found(&self, id: UploadId) -> u64 {
        fs::metadata(self.path(id)).map_or(0, |file| file.len())
    }

    /// All uploads that have bytes here. Blocks.
    pub(super) fn ids(&self) -> Result<Vec<UploadId>, StorageError> {
        let mut ids = Vec::new();
        for entry in fs::read_dir(&self.root).map_err(StorageError::io("listing uploads"))? {
            let entry = entry.map_err(StorageError::io("listing uploads"))?;
            ids.extend(entry.file_name().to_str().and_then(|name| name.parse::<UploadId>().ok()));
        }
        Ok(ids)
    }
}

/// Runs what blocks where it may.
pub(super) async fn blocking<T: Send + 'static>(
    action: &'static str,
    work: impl FnOnce() -> Result<T, StorageError> + Send + 'static,
) -> Result<T, StorageError> {
    tokio::task::spawn_blocking(work).await.map_err(|e| StorageError::io(action)(io::Error::other(e)))?
}

fn open_at(root: &Path, path: &Path, id: UploadId, kept: u64) -> Result<File, StorageError> {
    let io = || StorageError::io("opening an upload");
    let new = kept == 0;
    let opened = File::options().write(true).create(new).truncate(new).open(path);
    let file = match opened {
        Err(e) if e.kind() == io::ErrorKind::NotFound => {
            return Err(StorageError::DamagedUpload { upload: id, kept, found: 0 });
        }
        other => other.map_err(io())?,
    };
    let found = file.metadata().map_err(io())?.len();
    if found < kept {
        return Err(StorageError::DamagedUpload { upload: id, kept, found });
    }
    file.set_len(kept).map_err(io())?;
    if new {
        // The name must survive a power cut as well as the bytes.
        File::open(root).and_then(|folder| folder.sync_all()).map_err(io())?;
    }
    Ok(file)
}

/// An upload that is being continued.
#[derive(Debug)]
pub struct UploadFile {
    file: tokio::fs::File,
}

impl UploadFile {
    /// Appends a piece. It is not safe before [`UploadFile::sync`].
    pub async fn write(&mut self, piece: &[u8]) -> Result<(), StorageError> {
        self.file.write_all(piece).await.map_err(StorageError::io("writing an upload"))
    }

    /// Makes safe what was written.
    pub async fn sync(&mut self) -> Result<(), StorageError> {
        self.file.flush().await.map_err(StorageError::io("writing an upload"))?;
        self.file.sync_all().await.map_err(StorageError::io("syncing an upload"))
    }

    /// Takes back what was written behind the first `kept` bytes.
    pub async fn cut(mut self, kept: u64) -> Result<(), StorageError> {
        self.file.flush().await.map_err(StorageError::io("writing an upload"))?;
        self.file.set_len(kept).await.map_err(StorageError::io("cutting an upload"))
    }
}
