//! Whether the database is sound, and whether its rows make sense together and with the uploads that are under way.

use sqlx::Row;

use super::rows::{count, parsed};
use super::{StorageError, Store};
use crate::project::{Timestamp, UploadId};

/// What must never be: what it means, and a query for the rows where it is so.
const NEVER: &[(&str, &str)] = &[
    (
        "a project's newest version is not there",
        "SELECT id FROM projects p WHERE head > 0
           AND NOT EXISTS (SELECT 1 FROM versions v WHERE v.project_id = p.id AND v.number = p.head)",
    ),
    (
        "a version is newer than its project's newest",
        "SELECT v.project_id FROM versions v JOIN projects p ON p.id = v.project_id WHERE v.number > p.head",
    ),
    (
        "a scan has no job",
        "SELECT id FROM scans s WHERE NOT EXISTS (SELECT 1 FROM jobs j WHERE j.id = s.job_id)",
    ),
    (
        "a scan waits for a job that has ended",
        "SELECT s.id FROM scans s JOIN jobs j ON j.id = s.job_id
           WHERE s.state IN ('received', 'ingested') AND s.deleted_ms IS NULL AND j.state NOT IN ('accepted', 'running')",
    ),
    (
        "a job of a batch waits for a leader that nobody works on",
        "SELECT id FROM jobs j WHERE leader IS NOT NULL
           AND NOT EXISTS (SELECT 1 FROM jobs l WHERE l.id = j.leader AND l.worker IS NOT NULL)",
    ),
    (
        "a job has ended and is held by a worker",
        "SELECT id FROM jobs WHERE worker IS NOT NULL AND state NOT IN ('accepted', 'running')",
    ),
    (
        "what a project or a key holds is miscounted",
        "SELECT COALESCE(h.holder, s.holder) FROM (SELECT * FROM holdings WHERE scans > 0 OR bytes > 0) h
           FULL JOIN (SELECT holder, COUNT(*) AS scans, SUM(bytes) AS bytes FROM
             (SELECT project_id AS holder, bytes FROM scans WHERE deleted_ms IS NULL
              UNION ALL SELECT key_id, bytes FROM scans WHERE deleted_ms IS NULL AND key_id IS NOT NULL) GROUP BY holder) s
             ON s.holder = h.holder
           WHERE s.scans IS NOT h.scans OR s.bytes IS NOT h.bytes",
    ),
    (
        "a registered scan has no place",
        "SELECT id FROM scans WHERE state = 'registered' AND standing IS NULL",
    ),
];

impl Store {
    /// What is wrong with the database, one line each; none if it is sound.
    pub async fn integrity(&self) -> Result<Vec<String>, StorageError> {
        let mut wrong = Vec::new();
        for row in sqlx::query("PRAGMA integrity_check(100)").fetch_all(&self.read).await? {
            let line: String = row.try_get(0)?;
            if line != "ok" {
                wrong.push(format!("database: {line}"));
            }
        }
        for row in sqlx::query("PRAGMA foreign_key_check").fetch_all(&self.read).await? {
            let (table, parent): (String, String) = (row.try_get(0)?, row.try_get(2)?);
            wrong.push(format!("database: a row of {table} names a row of {parent} that is not there"));
        }
        for (what, query) in NEVER {
            for row in sqlx::query(sqlx::AssertSqlSafe(*query)).fetch_all(&self.read).await? {
                let subject: String = row.try_get(0)?;
                wrong.push(format!("{what}: {subject}"));
            }
        }
        for (id, safe, found) in self.torn_uploads().await? {
            wrong.push(format!("an upload has {found} of the {safe} bytes that were acknowledged: {id}"));
        }
        Ok(wrong)
    }

    /// Uploads that can be continued and whose files are shorter than clients were told: how many bytes should be there, and are.
    async fn torn_uploads(&self) -> Result<Vec<(UploadId, u64, u64)>, StorageError> {
        let mut torn = self.begun_uploads(None).await?;
        torn.retain(|(id, safe)| self.uploads.found(*id) < *safe);
        let mut still = Vec::new();
        for (id, _) in torn {
            // A service that runs may have ended it, or thrown it away, between the look at its row and that at its file.
            let again = self.begun_uploads(Some(id)).await?.into_iter();
            still.extend(
                again
                    .map(|(id, safe)| (id, safe, self.uploads.found(id)))
                    .filter(|(_, safe, found)| found < safe),
            );
        }
        Ok(still)
    }

    /// Uploads, or this one, whose bytes are in a file of their own, each with how many of them are safe.
    async fn begun_uploads(&self, one: Option<UploadId>) -> Result<Vec<(UploadId, u64)>, StorageError> {
        let rows = sqlx::query(
            "SELECT id, received FROM uploads WHERE scan_id IS NULL AND blob IS NULL AND received > 0 AND expires_ms > ?1
               AND (?2 IS NULL OR id = ?2) ORDER BY id",
        )
        .bind(Timestamp::now().0)
        .bind(one.map(|id| id.to_string()))
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(|row| Ok((parsed(row, "id")?, count(row, "received")?))).collect()
    }
}
