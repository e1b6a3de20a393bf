//! Whether the database is sound, and whether its rows make sense together.

use sqlx::Row;

use super::{StorageError, Store};

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
        Ok(wrong)
    }
}
