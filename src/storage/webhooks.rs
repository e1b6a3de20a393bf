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

    /// The oldest message of each webhook, if it is due by `now`.
    pub async fn due_deliveries(&self, now: Timestamp) -> Result<Vec<DueDelivery>, StorageError> {
        let rows = sqlx::query(
            "SELECT d.*, w.url, w.secret, MIN(d.seq) FROM deliveries d JOIN webhooks w ON w.id = d.webhook_id
               WHERE d.state = 'pending' AND d.not_before_ms <= ? GROUP BY d.webhook_id",
        )
        .bind(now.0)
        .fetch_all(&self.read)
        .await?;
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
        let row = sqlx::query("SELECT MIN(not_before_ms) AS next FROM deliveries WHERE state = 'pending'")
            .fetch_one(&self.read)
            .await?;
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
        sqlx::query("DELETE FROM deliveries WHERE ended_ms < ?")
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
