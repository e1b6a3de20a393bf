//! The table of damaged blobs: what was found by whoever read them, what is done about it, and what operators are told.
//!
//! A result that can be made again is forgotten, so that the next who asks makes it. If the newest version of a model is hit, a
//! rebuild is queued, which makes it anew from the uploads. A damaged upload is only reported: sending the same file again, or
//! restoring it from a backup, repairs it.

use std::collections::HashMap;

use sqlx::{Row, Sqlite, Transaction};

use super::garbage::needed;
use super::job_rows::insert_job;
use super::rows::{parsed, word};
use super::{BlobId, Finding, StorageError, Store};
use crate::project::{JobId, JobKind, Lane, ProjectId, Timestamp};

/// A damaged blob that a row needs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// The blob.
    pub blob: BlobId,
    /// What is wrong with its file.
    pub finding: Finding,
    /// When it was found.
    pub found: Timestamp,
}

impl Store {
    /// Damage that is neither repaired nor past.
    pub async fn damage(&self) -> Result<Vec<Damage>, StorageError> {
        let rows = sqlx::query("SELECT * FROM damage WHERE settled_ms IS NULL ORDER BY found_ms, blob")
            .fetch_all(&self.read)
            .await?;
        rows.iter()
            .map(|row| {
                Ok(Damage {
                    blob: BlobId::parse(row.try_get("blob")?)?,
                    finding: word(row, "finding", Finding::from_word)?,
                    found: Timestamp(row.try_get("found_ms")?),
                })
            })
            .collect()
    }

    /// Writes down what readers found since the last call, and sees to it that what can be made again is. Returns how many blobs are
    /// damaged now.
    pub async fn settle_damage(&self) -> Result<usize, StorageError> {
        let known = self.damage().await?;
        // Of what another process has written down, this one may have stored sound files since.
        let sound = known.iter().filter(|d| self.blobs.is_known_sound(d.blob)).map(|d| (d.blob, None));
        let news: HashMap<_, _> = sound.chain(self.blobs.ledger.take_news()).collect();
        let news: Vec<_> = news.into_iter().collect();
        if news.is_empty() && known.is_empty() {
            return Ok(0);
        }
        match self.write_damage(&news).await {
            Ok(rebuilds) if rebuilds.is_empty() => {}
            Ok(rebuilds) => {
                self.announce(rebuilds);
                self.ring();
            }
            Err(error) => {
                self.blobs.ledger.return_news(news);
                return Err(error);
            }
        }
        let damage = self.damage().await?;
        for (blob, _) in news.iter().filter(|(_, finding)| finding.is_some()) {
            if let Some(found) = damage.iter().find(|d| d.blob == *blob) {
                tracing::error!(%blob, finding = found.finding.as_str(), "a blob that is needed is damaged, and cannot be made again by itself");
            }
        }
        Ok(damage.len())
    }

    async fn write_damage(&self, news: &[(BlobId, Option<Finding>)]) -> Result<Vec<JobId>, StorageError> {
        let now = Timestamp::now();
        let mut rebuilds = Vec::new();
        let mut tx = self.begin().await?;
        for (blob, finding) in news {
            let Some(finding) = finding else {
                sqlx::query("UPDATE damage SET settled_ms = ?2 WHERE blob = ?1 AND settled_ms IS NULL")
                    .bind(blob.to_string())
                    .bind(now.0)
                    .execute(&mut *tx)
                    .await?;
                continue;
            };
            sqlx::query(
                "INSERT INTO damage (blob, finding, found_ms) VALUES (?1, ?2, ?3)
                   ON CONFLICT (blob) DO UPDATE SET finding = ?2, found_ms = ?3, settled_ms = NULL",
            )
            .bind(blob.to_string())
            .bind(finding.as_str())
            .bind(now.0)
            .execute(&mut *tx)
            .await?;
            sqlx::query("DELETE FROM derived WHERE blob = ?")
                .bind(blob.to_string())
                .execute(&mut *tx)
                .await?;
            rebuilds.extend(rebuild(&mut tx, *blob, now).await?);
        }
        // What nothing needs is no damage: it was deleted after it was asked for, or a newer version took its place.
        sqlx::query(sqlx::AssertSqlSafe(format!(
            "UPDATE damage SET settled_ms = ? WHERE settled_ms IS NULL AND NOT ({})",
            needed("damage.blob")
        )))
        .bind(now.0)
        .execute(&mut *tx)
        .await?;
        tx.commit().await?;
        Ok(rebuilds)
    }
}

/// Queues a rebuild of the models whose newest version needs the blob, unless one waits already.
async fn rebuild(
    tx: &mut Transaction<'static, Sqlite>,
    blob: BlobId,
    now: Timestamp,
) -> Result<Vec<JobId>, StorageError> {
    let projects = sqlx::query(
        "SELECT p.id FROM projects p JOIN versions v ON v.project_id = p.id AND v.number = p.head
           WHERE ?1 IN (v.snapshot, v.content) AND NOT EXISTS
             (SELECT 1 FROM jobs j WHERE j.project_id = p.id AND j.kind = 'rebuild' AND j.state = 'accepted')",
    )
    .bind(blob.to_string())
    .fetch_all(&mut **tx)
    .await?;
    let mut made = Vec::new();
    for row in &projects {
        let (project, job): (ProjectId, _) = (parsed(row, "id")?, JobId::generate());
        insert_job(tx, job, project, None, JobKind::Rebuild, Lane::Map, now).await?;
        tracing::warn!(%project, %job, "the newest version is damaged; it is made again from the uploads");
        made.push(job);
    }
    Ok(made)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::project::VersionNumber;
    use crate::storage::testing::{Fixture, new_scan};
    use crate::storage::{FreshBlob, JobFilter, Owner, Page};

    impl Fixture {
        fn spoil(&self, id: BlobId) {
            fs::write(self.store.blobs.path(id), "no longer what it was").unwrap();
            assert!(self.store.blobs.verify(id).is_err());
        }

        async fn uploaded(&self) -> FreshBlob {
            let blob = self.blob("upload");
            let new = new_scan(self.project, 1, *blob);
            self.store.admit_scan(&new).await.unwrap();
            blob
        }
    }

    #[tokio::test]
    async fn a_damaged_upload_is_told_until_the_same_bytes_come_again() {
        let f = Fixture::new().await;
        let upload = f.uploaded().await;
        f.spoil(upload.id);
        assert_eq!(f.store.settle_damage().await.unwrap(), 1);
        let told = f.store.damage().await.unwrap();
        assert_eq!((told[0].blob, told[0].finding), (upload.id, Finding::Altered));
        fs::remove_file(f.store.blobs.path(upload.id)).unwrap();
        assert!(f.store.blobs.get(upload.id).is_err());
        f.store.settle_damage().await.unwrap();
        assert_eq!(f.store.damage().await.unwrap()[0].finding, Finding::Missing);
        f.blob("upload");
        assert_eq!(f.store.settle_damage().await.unwrap(), 0);
    }

    #[tokio::test]
    async fn damage_is_known_after_a_restart_and_settled_by_whoever_repairs_it_then() {
        let dir = tempfile::tempdir().unwrap();
        let f = Fixture::new().await;
        drop(dir);
        let upload = f.uploaded().await.id;
        f.spoil(upload);
        f.store.settle_damage().await.unwrap();
        let Fixture { store, dir, .. } = f;
        store.close().await;
        drop(store);
        let store = Store::open(dir.path()).await.unwrap();
        assert_eq!(store.damage().await.unwrap().len(), 1);
        store.blobs.put(b"upload").unwrap();
        assert_eq!(store.settle_damage().await.unwrap(), 0);
    }

    #[tokio::test]
    async fn a_result_that_can_be_made_again_is_forgotten() {
        let f = Fixture::new().await;
        let (key, owner) = (blake3::hash(b"key"), Owner { project: f.project, scan: None });
        let export = f.blob("export");
        f.store.remember(&key, owner, &export).await.unwrap();
        f.spoil(export.id);
        assert_eq!(f.store.settle_damage().await.unwrap(), 0, "nothing needs it any more");
        assert_eq!(f.store.derived(&key).await.unwrap(), None);
    }

    #[tokio::test]
    async fn a_damaged_newest_version_is_made_again_by_one_rebuild() {
        let f = Fixture::new().await;
        let (snapshot, content) = (f.blob("snapshot"), f.blob("content"));
        let mut tx = f.store.begin().await.unwrap();
        sqlx::query("INSERT INTO versions VALUES (?, 1, ?, 'registration', ?, ?, 'e', 0.1, 0, 0, 0, 0)")
            .bind(f.project.to_string())
            .bind(JobId::generate().to_string())
            .bind(snapshot.id.to_string())
            .bind(content.id.to_string())
            .execute(&mut *tx)
            .await
            .unwrap();
        sqlx::query("UPDATE projects SET head = 1").execute(&mut *tx).await.unwrap();
        tx.commit().await.unwrap();
        f.spoil(snapshot.id);
        f.spoil(content.id);
        assert_eq!(f.store.settle_damage().await.unwrap(), 2);
        let jobs =
            f.store.jobs(f.project, JobFilter::default(), Page { after: None, limit: 9 }).await.unwrap();
        assert_eq!(jobs.iter().map(|(_, job)| job.kind).collect::<Vec<_>>(), [JobKind::Rebuild]);
        let read = f.store.content(f.project, Some(VersionNumber(1))).await;
        assert!(matches!(read, Err(StorageError::DamagedBlob { .. })), "{read:?}");
    }

    #[tokio::test]
    async fn a_file_that_nothing_needs_is_no_damage() {
        let f = Fixture::new().await;
        assert!(f.store.blobs.get(BlobId(blake3::hash(b"never"))).is_err());
        assert_eq!(f.store.settle_damage().await.unwrap(), 0);
    }
}
