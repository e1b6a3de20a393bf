//! Files that are made for download: merged clouds and pictures. Each is a pure function of a version and its
//! parameters, built once and kept as a blob.

use std::collections::HashMap;
use std::fs::File;
use std::io::{self, BufWriter};
use std::sync::Arc;

use tokio::sync::Mutex;
use tracing::Instrument;

use super::merge::Merge;
use super::picture::draw;
use super::{Compute, JobError, Panicked};
use crate::cloud::{ImageError, PlyWriter};
use crate::project::{ModelContent, Placement, ProjectId, Scan, ScanId};
use crate::storage::{FreshBlob, Owner, StorageError, Store, StoredBlob};

/// Which part of a model.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComponentChoice {
    /// One component; 0 is the largest.
    One(usize),
    /// All of them, each in its own frame, which have nothing to do with one another.
    All,
}

/// The scans of a part of a model, with their poses: what an export is made of.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    project: ProjectId,
    placed: Vec<(Scan, Placement)>,
}

/// Why a file cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The version has no such component, or no registered scan at all.
    #[error("no scan is registered in this component of this version")]
    NothingThere,
    /// So many cubes are occupied that they do not fit into memory.
    #[error("more than {limit} cubes of {edge} m are occupied; take larger ones, or none")]
    TooFine {
        /// Edge of the cubes, metres.
        edge: f64,
        /// The limit.
        limit: u64,
    },
    /// There is too little disk left to keep another file.
    #[error("the service has too little space left to make this file")]
    LowDisk,
    /// State could not be read or written.
    #[error(transparent)]
    Storage(#[from] StorageError),
    /// The file could not be written.
    #[error("writing an export: {0}")]
    Io(#[from] io::Error),
    /// The picture could not be encoded.
    #[error(transparent)]
    Picture(#[from] ImageError),
    /// A computation failed.
    #[error(transparent)]
    Panicked(#[from] Panicked),
    /// An upload that was readable once is not any more.
    #[error("a registered scan cannot be read: {0}")]
    Unreadable(#[from] JobError),
}

/// What exports may take of the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ExportLimits {
    /// Bytes that they may have together; only the newest alone may have more.
    pub bytes: u64,
    /// Bytes that must stay free: more than uploads leave free, so that readers never take the last room for uploads.
    pub free_bytes: u64,
}

/// Makes and remembers exports. Clones share everything.
#[derive(Debug, Clone)]
pub struct Exports {
    store: Store,
    compute: Compute,
    max_points: u64,
    limits: ExportLimits,
    disk: Disk,
    /// One at a time: a merged cloud may take gigabytes of disk and all threads.
    building: Arc<Mutex<()>>,
}

/// The disk that exports are written to.
#[derive(Debug, Clone)]
struct Disk {
    store: Store,
    /// Bytes that stay free.
    free_bytes: u64,
}

impl Disk {
    /// Fails if nothing more may be written now.
    fn check(&self) -> Result<(), ExportError> {
        if self.store.free_bytes()? < self.free_bytes { Err(ExportError::LowDisk) } else { Ok(()) }
    }
}

/// Points that are written between two looks at how much disk is free: about 32 MB, a small part of what should stay free.
const LOOK_EVERY: u64 = 2_000_000;

/// Names the form of the exported files; another one makes old ones unreachable.
const FORM: &str = "export/1";

impl Exports {
    /// Exports from this store. Uploads of more than `max_points` were never accepted.
    #[must_use]
    pub fn new(store: Store, compute: Compute, max_points: u64, limits: ExportLimits) -> Self {
        let disk = Disk { store: store.clone(), free_bytes: limits.free_bytes };
        Self { store, compute, max_points, limits, disk, building: Arc::default() }
    }

    /// Gives up all that was made, because the disk is needed for something else: it can be made again.
    pub async fn give_way(&self) -> Result<(), StorageError> {
        let files = self.store.forget_exports().await?;
        if files > 0 {
            tracing::warn!(files, "little disk is free: merged clouds and pictures are deleted");
        }
        Ok(())
    }

    /// The merged cloud of a part as binary PLY, in metres, in the frame of its component: one point for each occupied cube of the edge
    /// `voxel`, metres, or every point.
    pub async fn cloud(&self, part: Part, voxel: Option<f64>) -> Result<StoredBlob, ExportError> {
        let key = key(&format!("cloud {voxel:?}"), &part.placed);
        let (project, merge) = (part.project, self.merge(part));
        let (blobs, disk) = (self.store.blobs.clone(), self.disk.clone());
        self.made(project, key, move || blobs.put_with(|file| write_ply(file, &merge, voxel, &disk))).await
    }

    /// A picture of a part: PNG, from above and from the side.
    pub async fn preview(&self, part: Part) -> Result<StoredBlob, ExportError> {
        let key = key("preview", &part.placed);
        let (project, merge) = (part.project, self.merge(part));
        let blobs = self.store.blobs.clone();
        self.made(project, key, move || Ok(blobs.put(&draw(&merge)?)?)).await
    }

    fn merge(&self, part: Part) -> Merge {
        Merge { blobs: self.store.blobs.clone(), placed: part.placed, max_points: self.max_points }
    }

    /// The remembered file, or the one that `make` makes.
    async fn made(
        &self,
        project: ProjectId,
        key: blake3::Hash,
        make: impl FnOnce() -> Result<FreshBlob, ExportError> + Send + 'static,
    ) -> Result<StoredBlob, ExportError> {
        if let Some(found) = self.remembered(&key).await? {
            return Ok(found);
        }
        let turn = Arc::clone(&self.building).lock_owned().await;
        // Whoever was before us may have made it.
        if let Some(found) = self.remembered(&key).await? {
            return Ok(found);
        }
        if let Err(error) = self.disk.check() {
            self.give_way().await?;
            return Err(error);
        }
        let (compute, store, limit) = (self.compute.clone(), self.store.clone(), self.limits.bytes);
        // A computation does not stop when its client leaves, so the turn stays with it: clients that come and go would have any
        // number of them run at once.
        let making = async move {
            let _turn = turn;
            let fresh = compute.run(make).await??;
            store.remember(&key, Owner { project, scan: None }, &fresh).await?;
            store.limit_exports(limit).await?;
            Ok(*fresh)
        };
        tokio::spawn(making.in_current_span()).await.map_err(|e| Panicked(e.to_string()))?
    }

    /// The remembered file, if it is sound: one that is not is made again.
    async fn remembered(&self, key: &blake3::Hash) -> Result<Option<StoredBlob>, ExportError> {
        let Some(found) = self.store.derived(key).await? else { return Ok(None) };
        match self.store.blobs.check(found.id).await {
            Ok(()) => Ok(Some(found)),
            Err(error) => {
                tracing::warn!(%error, "an export is damaged and is made again");
                Ok(None)
            }
        }
    }

    /// The scans of a version that take part, in order of arrival. Deleted ones do not: their uploads are gone.
    pub async fn part(
        &self,
        project: ProjectId,
        content: &ModelContent,
        component: ComponentChoice,
    ) -> Result<Part, ExportError> {
        let component = match component {
            ComponentChoice::One(index) => Some(index),
            ComponentChoice::All => None,
        };
        let mut places: HashMap<ScanId, &Placement> = content.placed(component).collect();
        let scans = self.store.scans_ever(project).await?;
        let placed: Vec<(Scan, Placement)> = scans
            .into_iter()
            .filter(|(_, deleted)| !deleted)
            .filter_map(|(scan, _)| places.remove(&scan.id).map(|place| (scan, place.clone())))
            .collect();
        if placed.is_empty() { Err(ExportError::NothingThere) } else { Ok(Part { project, placed }) }
    }
}

/// Hash of what goes into an export: its form and parameters, and every scan with its pose.
fn key(parameters: &str, placed: &[(Scan, Placement)]) -> blake3::Hash {
    let mut hasher = blake3::Hasher::new();
    hasher.update(format!("{FORM} {parameters}").as_bytes());
    for (scan, place) in placed {
        hasher.update(&scan.key.0.to_le_bytes());
        hasher.update(&(place.component as u64).to_le_bytes());
        for x in place.model_from_scan.to_rows().into_iter().flatten() {
            hasher.update(&x.to_le_bytes());
        }
    }
    hasher.finalize()
}

fn write_ply(file: &mut File, merge: &Merge, voxel: Option<f64>, disk: &Disk) -> Result<(), ExportError> {
    let offset = merge.offset();
    let mut comments = vec!["made by cairn; metres".to_owned()];
    if offset != [0.0; 3] {
        let [x, y, z] = offset;
        comments.push(format!("add the offset {x} {y} {z} to every point"));
    }
    let comments: Vec<&str> = comments.iter().map(String::as_str).collect();
    let out = BufWriter::with_capacity(1 << 20, file);
    let mut ply = PlyWriter::new(out, merge.colored(), &comments)?;
    let mut written = 0_u64;
    let mut write = |point, color| -> Result<(), ExportError> {
        // Whoever else writes, such as an upload, may have used up what was free when this began.
        if written.is_multiple_of(LOOK_EVERY) {
            disk.check()?;
        }
        written += 1;
        Ok(ply.colored_point(point, color)?)
    };
    match voxel {
        None => merge.visit(&offset, |_, point, color| {
            write([point.x as f32, point.y as f32, point.z as f32], color)
        })?,
        Some(edge) => {
            for (point, color) in merge.thinned(&offset, edge)? {
                write(point, color)?;
            }
        }
    }
    ply.finish()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::storage::testing::{Fixture, new_scan};

    #[tokio::test]
    async fn an_export_ends_and_leaves_nothing_when_the_disk_runs_low_while_it_is_written() {
        let at = Fixture::new().await;
        let points = "1 2 3\n".repeat(4);
        let file = format!(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\nend_header\n{points}"
        );
        let scan = new_scan(at.project, 1, *at.blob(&file));
        let scan = at.store.admit_scan(&scan).await.unwrap().scan;
        let place = Placement {
            component: 0,
            model_from_scan: Pose::identity(),
            landmarks: 0,
            neighbours: 0,
            landmark_rms: 0.0,
        };
        let merge = Merge { blobs: at.store.blobs.clone(), placed: vec![(scan, place)], max_points: 9 };
        let export = |free_bytes, voxel| {
            let disk = Disk { store: at.store.clone(), free_bytes };
            at.store.blobs.put_with(|file| write_ply(file, &merge, voxel, &disk)).map(|blob| blob.bytes)
        };
        for voxel in [None, Some(0.5)] {
            assert!(export(0, voxel).unwrap() > 12);
            assert!(matches!(export(u64::MAX, voxel), Err(ExportError::LowDisk)));
        }
        let folders = std::fs::read_dir(at.dir.path().join("blobs")).unwrap();
        let partial = folders.filter(|entry| entry.as_ref().unwrap().path().is_file()).count();
        assert_eq!(partial, 0, "what was begun is gone");
    }

    #[tokio::test]
    async fn exports_keep_to_their_bytes_and_give_way_when_the_disk_is_nearly_full() {
        let at = Fixture::new().await;
        let exports = |bytes, free_bytes| {
            let limits = ExportLimits { bytes, free_bytes };
            Exports::new(at.store.clone(), Compute::new(1).unwrap(), 9, limits)
        };
        let made = async |exports: &Exports, name: &'static str| {
            let blobs = at.store.blobs.clone();
            let make = move || Ok(blobs.put(name.as_bytes())?);
            exports.made(at.project, blake3::hash(name.as_bytes()), make).await
        };
        let kept =
            async |name: &str| at.store.derived(&blake3::hash(name.as_bytes())).await.unwrap().is_some();
        let roomy = exports(10, 0);
        for name in ["first", "next", "last"] {
            assert_eq!(made(&roomy, name).await.unwrap().bytes, name.len() as u64);
        }
        assert_eq!((kept("first").await, kept("next").await, kept("last").await), (false, true, true));
        let full = exports(10, u64::MAX);
        assert!(made(&full, "next").await.is_ok(), "what is there is given");
        assert!(matches!(made(&full, "another").await, Err(ExportError::LowDisk)));
        assert!(!kept("next").await && !kept("last").await);
    }
}
