//! Rows of webhooks and of the messages to them. A trigger makes the messages, with the end of the job that they tell
//! (`migrations/0004_access.sql`): none is forgotten, whatever ends a job.

use std::time::Duration;

use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::rows::{count, parsed, word};
use super::{Page, Seal, StorageError, Store};
use crate::project::{Delivery, DeliveryState, ProjectId, SigningSecret, Timestamp, Webhook, WebhookId};

/// A message that is to be sent now.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DueDelivery {
    /// The message.
    pub delivery: Delivery,
    /// Where to.
    pub url: String,
    /// What signs it.
    pub secret: SigningSecret,
}

/// What came of an attempt to send.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Attempt {
    /// The HTTP status of the answer, if there was one.
    pub status: Option<u16>,
    /// Why it came to nothing; `None` if the address took it.
    pub error: Option<String>,
    /// When to try again, if it came to nothing; `None` gives up.
    pub again: Option<Timestamp>,
}

/// How many webhooks a project may have.
const MOST: u32 = 20;
/// How long a message that is delivered or given up can be looked at.
const REMEMBERED: Duration = Duration::from_hours(30 * 24);

/// Of each webhook the oldest message that is due (?).
const DUE: &str = "SELECT d.*, w.url, w.secret FROM webhooks w JOIN deliveries d ON d.seq =
    (SELECT p.seq FROM deliveries p WHERE p.webhook_id = w.id AND p.state = 'pending' AND p.not_before_ms <= ?
     ORDER BY p.seq LIMIT 1)";
/// When the next message is due.
const NEXT: &str = "SELECT MIN(not_before_ms) AS next FROM deliveries WHERE state = 'pending'";
/// Forgets messages that ended before a moment (?).
const FORGET: &str = "DELETE FROM deliveries WHERE ended_ms < ?";

impl Store {
    /// Registers a webhook.
    pub async fn create_webhook(
        &self,
        project: ProjectId,
        url: &str,
        secret: &SigningSecret,
        seal: Seal<'_, Webhook>,
    ) -> Result<Webhook, StorageError> {
        let (id, created) = (WebhookId::generate(), Timestamp::now());
        let mut tx = self.begin().await?;
        let row = sqlx::query(
            "SELECT (SELECT COUNT(*) FROM webhooks WHERE project_id = p.id) AS held FROM projects p WHERE p.id = ?",
        )
        .bind(project.to_string())
        .fetch_optional(&mut *tx)
        .await?
        .ok_or(StorageError::NoProject(project))?;
        if count::<u32>(&row, "held")? >= MOST {
            return Err(StorageError::TooManyWebhooks { project, limit: MOST });
        }
        sqlx::query("INSERT INTO webhooks (id, project_id, url, secret, created_ms) VALUES (?, ?, ?, ?, ?)")
            .bind(id.to_string())
            .bind(project.to_string())
            .bind(url)
            .bind(secret.0.as_slice())
            .bind(created.0)
            .execute(&mut *tx)
            .await?;
        let made = Webhook { id, project, url: url.to_owned(), created };
        seal.set(&mut tx, &made).await?;
        tx.commit().await?;
        Ok(made)
    }

    /// The webhooks of a project, oldest first.
    pub async fn webhooks(&self, project: ProjectId) -> Result<Vec<Webhook>, StorageError> {
        let rows = sqlx::query("SELECT * FROM webhooks WHERE project_id = ? ORDER BY seq")
            .bind(project.to_string())
            .fetch_all(&self.read)
            .await?;
        rows.iter().map(webhook).collect()
    }

    /// One webhook.
    pub async fn webhook(&self, project: ProjectId, id: WebhookId) -> Result<Webhook, StorageError> {
        let row = sqlx::query("SELECT * FROM webhooks WHERE id = ? AND project_id = ?")
            .bind(id.to_string())
            .bind(project.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(webhook).transpose()?.ok_or(StorageError::NoWebhook(id))
    }

    /// Forgets a webhook and what was to be sent to it.
    pub async fn delete_webhook(&self, project: ProjectId, id: WebhookId) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        let done = sqlx::query("DELETE FROM webhooks WHERE id = ? AND project_id = ?")
            .bind(id.to_string())
            .bind(project.to_string())
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        if done.rows_affected() == 0 { Err(StorageError::NoWebhook(id)) } else { Ok(()) }
    }

    /// Messages to a webhook, oldest first, each with its position in the list.
    pub async fn deliveries(&self, id: WebhookId, page: Page) -> Result<Vec<(i64, Delivery)>, StorageError> {
        let rows =
            sqlx::query("SELECT * FROM deliveries WHERE webhook_id = ? AND seq > ? ORDER BY seq LIMIT ?")
                .bind(id.to_string())
                .bind(page.after.unwrap_or(0))
                .bind(page.limit)
                .fetch_all(&self.read)
                .await?;
        rows.iter().map(|row| Ok((row.try_get("seq")?, delivery(row)?))).collect()
    }

    /// Of each webhook the oldest message that is due by `now`.
    pub async fn due_deliveries(&self, now: Timestamp) -> Result<Vec<DueDelivery>, StorageError> {
        let rows = sqlx::query(DUE).bind(now.0).fetch_all(&self.read).await?;
        let due = rows.iter().map(|row| {
            let secret: Vec<u8> = row.try_get("secret")?;
            let bytes = <[u8; 32]>::try_from(secret).map_err(|_| StorageError::BadRow {
                column: "webhooks.secret",
                value: "of another length".to_owned(),
            })?;
            Ok(DueDelivery {
                delivery: delivery(row)?,
                url: row.try_get("url")?,
                secret: SigningSecret(bytes),
            })
        });
        due.collect()
    }

    /// When the next message is due, if one waits.
    pub async fn next_delivery(&self) -> Result<Option<Timestamp>, StorageError> {
        let row = sqlx::query(NEXT).fetch_one(&self.read).await?;
        Ok(row.try_get::<Option<i64>, _>("next")?.map(Timestamp))
    }

    /// Notes what came of an attempt.
    pub async fn record_attempt(&self, id: &str, attempt: &Attempt) -> Result<(), StorageError> {
        let (state, ended) = match attempt {
            Attempt { error: None, .. } => (DeliveryState::Delivered, Some(Timestamp::now())),
            Attempt { again: None, .. } => (DeliveryState::Failed, Some(Timestamp::now())),
            Attempt { again: Some(_), .. } => (DeliveryState::Pending, None),
        };
        let mut tx = self.begin().await?;
        sqlx::query(
            "UPDATE deliveries SET attempts = attempts + 1, state = ?, status = ?, error = ?, not_before_ms = ?,
               ended_ms = ? WHERE id = ?",
        )
        .bind(state.as_str())
        .bind(attempt.status)
        .bind(attempt.error.as_deref())
        .bind(attempt.again.map_or(0, |at| at.0))
        .bind(ended.map(|at| at.0))
        .bind(id)
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(())
    }

    /// Forgets messages that ended long ago.
    pub async fn forget_deliveries(&self, now: Timestamp) -> Result<(), StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query(FORGET)
            .bind(now.0.saturating_sub(REMEMBERED.as_millis() as i64))
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        Ok(())
    }
}

fn webhook(row: &SqliteRow) -> Result<Webhook, StorageError> {
    Ok(Webhook {
        id: parsed(row, "id")?,
        project: parsed(row, "project_id")?,
        url: row.try_get("url")?,
        created: Timestamp(row.try_get("created_ms")?),
    })
}

fn delivery(row: &SqliteRow) -> Result<Delivery, StorageError> {
    let status = row.try_get::<Option<i64>, _>("status")?;
    Ok(Delivery {
        id: row.try_get("id")?,
        webhook: parsed(row, "webhook_id")?,
        job: parsed(row, "job_id")?,
        state: word(row, "state", DeliveryState::from_word)?,
        attempts: count(row, "attempts")?,
        status: status.map(|_| count(row, "status")).transpose()?,
        error: row.try_get("error")?,
        created: Timestamp(row.try_get("created_ms")?),
        ended: row.try_get::<Option<i64>, _>("ended_ms")?.map(Timestamp),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::project::JobKind;
    use crate::storage::testing::Fixture;

    impl Fixture {
        async fn due(&self, now: Timestamp) -> Vec<i64> {
            let due = self.store.due_deliveries(now).await.unwrap();
            let mut seqs = Vec::new();
            for message in due {
                let row = sqlx::query("SELECT seq FROM deliveries WHERE id = ?").bind(message.delivery.id);
                seqs.push(row.fetch_one(&self.store.read).await.unwrap().get("seq"));
            }
            seqs.sort_unstable();
            seqs
        }
    }

    #[tokio::test]
    async fn each_webhook_gets_the_oldest_message_that_is_due() {
        let at = Fixture::new().await;
        for url in ["https://a.example/", "https://b.example/"] {
            at.store.create_webhook(at.project, url, &SigningSecret([7; 32]), Seal::none()).await.unwrap();
        }
        for _ in 0..2 {
            let job = at.store.create_job(at.project, JobKind::Rebuild, None, Seal::none()).await.unwrap();
            at.store.dismiss_job(job.id).await.unwrap();
        }
        let now = Timestamp::now();
        assert_eq!(at.due(now).await, [1, 2]);
        let first = &at.store.due_deliveries(now).await.unwrap()[0].delivery.id;
        let late = Attempt {
            status: None,
            error: Some("for the test".to_owned()),
            again: Some(now.plus(Duration::from_mins(1))),
        };
        at.store.record_attempt(first, &late).await.unwrap();
        assert_eq!(at.due(now).await.len(), 2, "the next one of that webhook");
        assert_eq!(at.store.next_delivery().await.unwrap(), Some(Timestamp(0)));
        assert_eq!(at.due(now.plus(Duration::from_mins(2))).await, [1, 2]);
        let taken = Attempt { status: Some(200), error: None, again: None };
        for message in at.store.due_deliveries(now).await.unwrap() {
            at.store.record_attempt(&message.delivery.id, &taken).await.unwrap();
        }
        at.store.forget_deliveries(now.plus(2 * REMEMBERED)).await.unwrap();
        let left =
            sqlx::query("SELECT COUNT(*) AS n FROM deliveries").fetch_one(&at.store.read).await.unwrap();
        assert_eq!(left.get::<i64, _>("n"), 2, "those that ended are forgotten, those that wait are not");
    }

    #[tokio::test]
    async fn upkeep_of_messages_reads_only_those_that_it_is_about() {
        let at = Fixture::new().await;
        for query in [DUE, NEXT, FORGET] {
            let explained = format!("EXPLAIN QUERY PLAN {query}");
            let rows = sqlx::query(sqlx::AssertSqlSafe(explained)).fetch_all(&at.store.read).await.unwrap();
            for step in rows.iter().map(|row| row.get::<String, _>("detail")) {
                let narrow =
                    ["SCAN w", "PRIMARY KEY", "deliveries_pending", "deliveries_by_end", "deliveries_due"];
                assert!(
                    step.contains("SUBQUERY") || narrow.iter().any(|index| step.contains(index)),
                    "{query}: {step}"
                );
            }
        }
    }
}
