//! Which rows need which blobs: what a check reads, and what a backup copies.

use std::fmt;

use sqlx::Row;
use sqlx::sqlite::SqlitePool;

use super::rows::{count, parsed};
use super::{BlobId, StorageError, Store};
use crate::project::{Name, ProjectId, ScanId, VersionNumber};

/// What a blob is to the row that needs it.
#[derive(Debug, Clone, PartialEq)]
pub enum Role {
    /// The upload of a scan: all else follows from these.
    Upload {
        /// The scan.
        scan: ScanId,
        /// What the client called it.
        name: Name,
    },
    /// The engine's state behind a project's newest version. It can be made again from the uploads.
    Snapshot(VersionNumber),
    /// What readers see of a version. That of the newest can be made again.
    Content {
        /// The version.
        version: VersionNumber,
        /// Whether it is the project's newest.
        newest: bool,
    },
    /// A result that is made again when it is asked for: a prepared scan, a merged cloud, a picture.
    Derived,
}

/// A row that needs a blob.
#[derive(Debug, Clone, PartialEq)]
pub struct Reference {
    /// The blob.
    pub blob: BlobId,
    /// The project.
    pub project: ProjectId,
    /// What the blob is to it.
    pub role: Role,
}

impl fmt::Display for Reference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.role {
            Role::Upload { scan, name } => write!(f, "the upload of scan {scan} ({name})")?,
            Role::Snapshot(version) => write!(f, "the engine's state of version {version}")?,
            Role::Content { version, .. } => write!(f, "version {version}")?,
            Role::Derived => f.write_str("a result that can be made again")?,
        }
        write!(f, " of project {}", self.project)
    }
}

impl Store {
    /// Every row that needs a blob, uploads first.
    pub async fn references(&self) -> Result<Vec<Reference>, StorageError> {
        references(&self.read).await
    }
}

/// Every row of a database that needs a blob, uploads first.
pub(super) async fn references(database: &SqlitePool) -> Result<Vec<Reference>, StorageError> {
    let mut all = Vec::new();
    let uploads = sqlx::query("SELECT * FROM scans WHERE forgotten_ms IS NULL ORDER BY rowid");
    for row in uploads.fetch_all(database).await? {
        let name = super::rows::word(&row, "name", |text| Name::parse(text).ok())?;
        let role = Role::Upload { scan: parsed(&row, "id")?, name };
        all.push(Reference {
            blob: BlobId::parse(row.try_get("blob")?)?,
            project: parsed(&row, "project_id")?,
            role,
        });
    }
    let versions = sqlx::query(
        "SELECT v.*, v.number = p.head AS newest FROM versions v JOIN projects p ON p.id = v.project_id ORDER BY v.rowid",
    );
    for row in versions.fetch_all(database).await? {
        let project = parsed(&row, "project_id")?;
        let (version, newest) = (VersionNumber(count(&row, "number")?), row.try_get("newest")?);
        if newest {
            let blob = BlobId::parse(row.try_get("snapshot")?)?;
            all.push(Reference { blob, project, role: Role::Snapshot(version) });
        }
        let blob = BlobId::parse(row.try_get("content")?)?;
        all.push(Reference { blob, project, role: Role::Content { version, newest } });
    }
    for row in sqlx::query("SELECT blob, project_id FROM derived ORDER BY rowid").fetch_all(database).await? {
        let blob = BlobId::parse(row.try_get("blob")?)?;
        all.push(Reference { blob, project: parsed(&row, "project_id")?, role: Role::Derived });
    }
    Ok(all)
}
