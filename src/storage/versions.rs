//! Rows of model versions and of the pairs behind them.

use std::io::BufReader;

use flate2::Compression;
use flate2::read::ZlibDecoder;
use flate2::write::ZlibEncoder;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::rows::{count, parsed};
use super::{BlobId, Page, StorageError, Store};
use crate::project::{ModelContent, ProjectId, Timestamp, Version, VersionNumber};

impl Store {
    /// One version.
    pub async fn version(
        &self,
        project: ProjectId,
        number: VersionNumber,
    ) -> Result<(Version, String), StorageError> {
        let row = sqlx::query("SELECT * FROM versions WHERE project_id = ? AND number = ?")
            .bind(project.to_string())
            .bind(number.0)
            .fetch_optional(&self.read)
            .await?
            .ok_or(StorageError::NoVersion(project, number))?;
        Ok((version(&row)?, row.try_get("engine")?))
    }

    /// What readers see of a version: of this one, or of the newest.
    pub async fn content(
        &self,
        project: ProjectId,
        number: Option<VersionNumber>,
    ) -> Result<(VersionNumber, ModelContent), StorageError> {
        let head = self.project(project).await?.head;
        let number = number.unwrap_or(head);
        if number == VersionNumber::EMPTY {
            return Ok((number, ModelContent::default()));
        }
        let (version, _) = self.version(project, number).await?;
        let (blobs, id) = (self.blobs.clone(), BlobId::parse(&version.content)?);
        let read = move || {
            let content = unpack(&blobs.get(id)?);
            content.inspect_err(|_| blobs.note_unreadable(id))
        };
        let content = tokio::task::spawn_blocking(read)
            .await
            .map_err(|e| StorageError::io("reading a version")(std::io::Error::other(e)))?;
        if content.as_ref().is_err_and(StorageError::is_damage) {
            // It is made again at once: readers wait for it.
            self.settle_damage().await?;
            // If it was deleted or dropped meanwhile, its file went with it: then it is not there, and nothing is damaged.
            self.project(project).await?;
            self.version(project, number).await?;
        }
        Ok((number, content?))
    }

    /// Versions of a project, oldest first.
    pub async fn versions(&self, project: ProjectId, page: Page) -> Result<Vec<Version>, StorageError> {
        let rows =
            sqlx::query("SELECT * FROM versions WHERE project_id = ? AND number > ? ORDER BY number LIMIT ?")
                .bind(project.to_string())
                .bind(page.after.unwrap_or(0))
                .bind(page.limit)
                .fetch_all(&self.read)
                .await?;
        rows.iter().map(version).collect()
    }

    /// Results of all pairs of a project that were matched under these parameters, in order of their keys.
    pub async fn pairs(&self, project: ProjectId, engine: &str) -> Result<Vec<Vec<u8>>, StorageError> {
        let rows = sqlx::query("SELECT result FROM pairs WHERE project_id = ? AND engine = ? ORDER BY a, b")
            .bind(project.to_string())
            .bind(engine)
            .fetch_all(&self.read)
            .await?;
        rows.iter().map(|row| Ok(row.try_get("result")?)).collect()
    }
}

/// What readers see, as it is stored: JSON, compressed (zlib, RFC 1950), because most of it repeats.
pub fn pack(content: &ModelContent) -> Result<Vec<u8>, StorageError> {
    let mut out = ZlibEncoder::new(Vec::new(), Compression::default());
    serde_json::to_writer(&mut out, content).map_err(|e| unreadable(&e))?;
    out.finish().map_err(StorageError::io("compressing a version"))
}

/// Reads what [`pack`] wrote. The first programs stored plain JSON, which begins with a brace.
pub fn unpack(bytes: &[u8]) -> Result<ModelContent, StorageError> {
    if bytes.first() == Some(&b'{') {
        return serde_json::from_slice(bytes).map_err(|e| unreadable(&e));
    }
    serde_json::from_reader(BufReader::new(ZlibDecoder::new(bytes))).map_err(|e| unreadable(&e))
}

fn unreadable(error: &serde_json::Error) -> StorageError {
    StorageError::BadRow { column: "the content of a version", value: error.to_string() }
}

fn version(row: &SqliteRow) -> Result<Version, StorageError> {
    Ok(Version {
        project: parsed(row, "project_id")?,
        number: VersionNumber(count(row, "number")?),
        job: parsed(row, "job_id")?,
        kind: parsed(row, "kind")?,
        snapshot: row.try_get("snapshot")?,
        content: row.try_get("content")?,
        resolution: row.try_get("resolution")?,
        components: count(row, "components")?,
        registered: count(row, "registered")?,
        waiting: count(row, "waiting")?,
        created: Timestamp(row.try_get("created_ms")?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_packed_is_read_back_and_so_is_what_the_first_programs_wrote() {
        let content = ModelContent { resolution: 0.25, ..ModelContent::default() };
        assert_eq!(unpack(&pack(&content).unwrap()).unwrap(), content);
        assert_eq!(unpack(&serde_json::to_vec(&content).unwrap()).unwrap(), content);
        for bad in [&b"{"[..], b"", b"x\x9c\x00", b"neither"] {
            assert!(unpack(bad).unwrap_err().is_damage());
        }
    }
}
