//! Rows of answers that are given again when their request comes again.

use sqlx::Row;

use super::rows::{count, json, to_json};
use super::{StorageError, Store};
use crate::project::Timestamp;

/// An answer that was given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptAnswer {
    /// Hash of the request that it answers.
    pub request: [u8; 32],
    /// Its HTTP status.
    pub status: u16,
    /// Its headers, name and value.
    pub headers: Vec<(String, String)>,
    /// Its body.
    pub body: Vec<u8>,
}

impl Store {
    /// The answer that was given to `scope` under `key`, unless it has expired by `now`.
    pub async fn kept_answer(
        &self,
        scope: &str,
        key: &str,
        now: Timestamp,
    ) -> Result<Option<KeptAnswer>, StorageError> {
        let row = sqlx::query("SELECT * FROM answers WHERE scope = ? AND key = ? AND expires_ms > ?")
            .bind(scope)
            .bind(key)
            .bind(now.0)
            .fetch_optional(&self.read)
            .await?;
        let Some(row) = row else { return Ok(None) };
        let request: Vec<u8> = row.try_get("request")?;
        Ok(Some(KeptAnswer {
            request: request.as_slice().try_into().map_err(|_| StorageError::BadRow {
                column: "request",
                value: format!("{} bytes", request.len()),
            })?,
            status: count(&row, "status")?,
            headers: json(&row, "headers")?.unwrap_or_default(),
            body: row.try_get("body")?,
        }))
    }

    /// Keeps an answer until it expires, in the place of one that has expired.
    pub async fn keep_answer(
        &self,
        scope: &str,
        key: &str,
        answer: &KeptAnswer,
        expires: Timestamp,
    ) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query("INSERT OR REPLACE INTO answers VALUES (?, ?, ?, ?, ?, ?, ?)")
            .bind(scope)
            .bind(key)
            .bind(answer.request.as_slice())
            .bind(answer.status)
            .bind(to_json(&answer.headers)?)
            .bind(&answer.body)
            .bind(expires.0)
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(())
    }

    /// Forgets answers that have expired by `now`.
    pub(super) async fn forget_answers(&self, now: Timestamp) -> Result<(), StorageError> {
        let old = sqlx::query("SELECT 1 FROM answers WHERE expires_ms <= ? LIMIT 1").bind(now.0);
        if old.fetch_optional(&self.read).await?.is_some() {
            let mut tx = self.begin().await?;
            sqlx::query("DELETE FROM answers WHERE expires_ms <= ?").bind(now.0).execute(&mut *tx).await?;
            tx.commit().await?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn an_answer_is_known_to_whom_it_was_given_until_it_expires() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let answer = KeptAnswer {
            request: [7; 32],
            status: 201,
            headers: vec![("location".to_owned(), "/x".to_owned())],
            body: b"{}".to_vec(),
        };
        store.keep_answer("rig", "k", &answer, Timestamp(100)).await.unwrap();
        let known = async |scope, key, now| store.kept_answer(scope, key, Timestamp(now)).await.unwrap();
        assert_eq!(known("rig", "k", 99).await, Some(answer));
        assert_eq!(known("rig", "k", 100).await, None);
        assert_eq!((known("other", "k", 0).await, known("rig", "l", 0).await), (None, None));
        store.forget_answers(Timestamp(100)).await.unwrap();
        assert_eq!(known("rig", "k", 0).await, None);
    }
}
