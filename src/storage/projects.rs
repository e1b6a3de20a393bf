//! Rows of projects.

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::rows::{count, parsed, word};
use super::{Page, Seal, StorageError, Store};
use crate::control::Seed;
use crate::project::{KeyId, Name, Project, ProjectId, ProjectSettings, Timestamp, VersionNumber};

const SELECT: &str = "SELECT p.rowid AS position, p.*, COALESCE((SELECT scans FROM holdings WHERE holder = p.id), 0) AS scans FROM projects p ";

impl Store {
    /// Makes a project, and keeps the answer to the request for it.
    pub async fn create_project(
        &self,
        name: &Name,
        settings: &ProjectSettings,
        seal: Seal<'_, Project>,
    ) -> Result<Project, StorageError> {
        let id = ProjectId::generate();
        let created = Timestamp::now();
        let mut tx = self.begin().await?;
        sqlx::query("INSERT INTO projects (id, name, seed, resolution, created_ms) VALUES (?, ?, ?, ?, ?)")
            .bind(id.to_string())
            .bind(name.as_str())
            .bind(settings.seed.0.cast_signed())
            .bind(settings.resolution)
            .bind(created.0)
            .execute(&mut *tx)
            .await?;
        let (name, settings) = (name.clone(), *settings);
        let made = Project { id, name, settings, head: VersionNumber::EMPTY, created, scans: 0 };
        seal.set(&mut tx, &made).await?;
        tx.commit().await?;
        Ok(made)
    }

    /// One project.
    pub async fn project(&self, id: ProjectId) -> Result<Project, StorageError> {
        let row = sqlx::query(sqlx::AssertSqlSafe(format!("{SELECT} WHERE p.id = ?")))
            .bind(id.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(project).transpose()?.ok_or(StorageError::NoProject(id))
    }

    /// Projects, oldest first, each with its position in the list; with a key, only those that were granted to it one by one.
    pub async fn projects(
        &self,
        page: Page,
        granted_to: Option<KeyId>,
    ) -> Result<Vec<(i64, Project)>, StorageError> {
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!(
            "{SELECT} WHERE p.rowid > ?1 AND (?2 IS NULL OR p.id IN (SELECT project_id FROM key_projects WHERE key_id = ?2))
               ORDER BY p.rowid LIMIT ?3"
        )))
        .bind(page.after.unwrap_or(0))
        .bind(granted_to.map(|key| key.to_string()))
        .bind(page.limit)
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(|row| Ok((row.try_get("position")?, project(row)?))).collect()
    }

    /// Deletes a project with its scans, jobs and versions. A worker that is at one of its jobs finds that it no longer
    /// holds it.
    pub async fn delete_project(&self, id: ProjectId) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        let jobs = sqlx::query("SELECT id FROM jobs WHERE project_id = ?")
            .bind(id.to_string())
            .fetch_all(&mut *tx)
            .await?;
        let done =
            sqlx::query("DELETE FROM projects WHERE id = ?").bind(id.to_string()).execute(&mut *tx).await?;
        tx.commit().await?;
        if done.rows_affected() == 0 {
            return Err(StorageError::NoProject(id));
        }
        self.announce(jobs.iter().filter_map(|row| parsed(row, "id").ok()));
        Ok(())
    }
}

fn project(row: &SqliteRow) -> Result<Project, StorageError> {
    Ok(Project {
        id: parsed(row, "id")?,
        name: word(row, "name", |text| Name::parse(text).ok())?,
        settings: ProjectSettings {
            seed: Seed(row.try_get::<i64, _>("seed")?.cast_unsigned()),
            resolution: row.try_get("resolution")?,
        },
        head: VersionNumber(count(row, "head")?),
        created: Timestamp(row.try_get("created_ms")?),
        scans: count(row, "scans")?,
    })
}
