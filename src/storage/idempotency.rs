//! Rows of answers that are given again when their request comes again.
//!
//! An answer is kept in the transaction that does what the request asks for ([`Seal`]), so that there is neither without the other,
//! whenever the process dies. What has no such transaction, such as a refusal, is kept by itself.

use sqlx::{Row, Sqlite, Transaction};

use super::rows::{count, json, to_json};
use super::{StorageError, Store};
use crate::project::Timestamp;

/// An answer to a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// Its HTTP status.
    pub status: u16,
    /// Its headers, name and value.
    pub headers: Vec<(String, String)>,
    /// Its body.
    pub body: Vec<u8>,
}

/// An answer that was given.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeptAnswer {
    /// Hash of the request that it answers.
    pub request: [u8; 32],
    /// The answer itself.
    pub answer: Answer,
}

/// Where an answer is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Receipt {
    /// Who asks: keys of different clients are different keys.
    pub scope: String,
    /// The key that the request carries.
    pub key: String,
    /// Hash of the request.
    pub request: [u8; 32],
    /// Until when.
    pub expires: Timestamp,
}

/// How an answer is made of what was done, if it can be.
type Render<'a, T> = Box<dyn Fn(&T) -> Option<Answer> + Send + Sync + 'a>;

/// What is to be kept together with something that is done (`T`): the answer to the request that asks for it.
pub struct Seal<'a, T: ?Sized>(Option<(Receipt, Render<'a, T>)>);

impl<'a, T: ?Sized> Seal<'a, T> {
    /// The answer that `render` makes is kept.
    pub fn new(receipt: Receipt, render: impl Fn(&T) -> Option<Answer> + Send + Sync + 'a) -> Self {
        Self(Some((receipt, Box::new(render))))
    }

    /// Nothing is kept: the request carries no key.
    #[must_use]
    pub fn none() -> Self {
        Self(None)
    }

    /// Keeps the answer in the transaction that has done it.
    pub(super) async fn set(
        self,
        tx: &mut Transaction<'static, Sqlite>,
        done: &T,
    ) -> Result<(), StorageError> {
        let Some((receipt, render)) = self.0 else { return Ok(()) };
        // Without an answer to keep now, it is kept when it is given.
        let Some(answer) = render(done) else { return Ok(()) };
        keep(tx, &receipt, &answer).await
    }
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
            answer: Answer {
                status: count(&row, "status")?,
                headers: json(&row, "headers")?.unwrap_or_default(),
                body: row.try_get("body")?,
            },
        }))
    }

    /// Keeps an answer by itself, in the place of one that has expired.
    pub async fn keep_answer(&self, receipt: &Receipt, answer: &Answer) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        keep(&mut tx, receipt, answer).await?;
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

async fn keep(
    tx: &mut Transaction<'static, Sqlite>,
    receipt: &Receipt,
    answer: &Answer,
) -> Result<(), StorageError> {
    sqlx::query("INSERT OR REPLACE INTO answers VALUES (?, ?, ?, ?, ?, ?, ?)")
        .bind(&receipt.scope)
        .bind(&receipt.key)
        .bind(receipt.request.as_slice())
        .bind(answer.status)
        .bind(to_json(&answer.headers)?)
        .bind(&answer.body)
        .bind(receipt.expires.0)
        .execute(&mut **tx)
        .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::{JobKind, Name, ProjectId, ProjectSettings};

    fn receipt(key: &str) -> Receipt {
        Receipt { scope: "rig".to_owned(), key: key.to_owned(), request: [7; 32], expires: Timestamp(100) }
    }

    fn answer(body: &str) -> Answer {
        let headers = vec![("location".to_owned(), "/x".to_owned())];
        Answer { status: 201, headers, body: body.as_bytes().to_vec() }
    }

    #[tokio::test]
    async fn an_answer_is_known_to_whom_it_was_given_until_it_expires() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        store.keep_answer(&receipt("k"), &answer("{}")).await.unwrap();
        let known = async |scope, key, now| store.kept_answer(scope, key, Timestamp(now)).await.unwrap();
        let kept = KeptAnswer { request: [7; 32], answer: answer("{}") };
        assert_eq!(known("rig", "k", 99).await, Some(kept));
        assert_eq!(known("rig", "k", 100).await, None);
        assert_eq!((known("other", "k", 0).await, known("rig", "l", 0).await), (None, None));
        store.forget_answers(Timestamp(100)).await.unwrap();
        assert_eq!(known("rig", "k", 0).await, None);
    }

    #[tokio::test]
    async fn what_is_done_and_its_answer_are_kept_together_or_not_at_all() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let seal = Seal::new(receipt("k"), |project: &crate::project::Project| {
            Some(answer(&project.id.to_string()))
        });
        let name = Name::parse("hall").unwrap();
        let made = store.create_project(&name, &ProjectSettings::default(), seal).await.unwrap();
        let kept = store.kept_answer("rig", "k", Timestamp(0)).await.unwrap().unwrap();
        assert_eq!(kept.answer.body, made.id.to_string().into_bytes());
        let seal = Seal::new(receipt("l"), |_: &crate::project::Job| Some(answer("")));
        let nowhere = store.create_job(ProjectId::generate(), JobKind::Rebuild, None, seal).await;
        assert!(nowhere.is_err());
        assert_eq!(store.kept_answer("rig", "l", Timestamp(0)).await.unwrap(), None);
    }
}
