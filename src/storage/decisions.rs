//! Rows of decisions. Every change has a job that makes the model obey, in the same transaction: a new one, or the one that waits for
//! the same already, so that a client who decides much queues little.

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, Sqlite, Transaction};

use super::job_rows::{charge_job, insert_job, job, made};
use super::quotas::Addition;
use super::rows::{json, parsed, to_json};
use super::{Page, Seal, StorageError, Store};
use crate::project::{
    Decision, DecisionId, Job, JobId, JobKind, KeptDecision, KeyId, Lane, ProjectId, ScanId, Timestamp,
};

impl Store {
    /// Keeps a decision. It replaces earlier ones about the two scans that it contradicts or repeats: a join every other one, a ban
    /// every join. Returns it with the job that makes the model obey, a new one on the account of `key` unless one waits already. The
    /// answer to the request is kept with it.
    pub async fn decide(
        &self,
        project: ProjectId,
        decision: &Decision,
        key: Option<KeyId>,
        seal: Seal<'_, (KeptDecision, Job)>,
    ) -> Result<(KeptDecision, Job), StorageError> {
        let kept =
            KeptDecision { id: DecisionId::generate(), decision: *decision, created: Timestamp::now() };
        let Decision { scan_a, scan_b, verdict } = decision;
        let mut tx = self.begin().await?;
        for scan in [scan_a, scan_b] {
            present(&mut tx, project, *scan).await?;
        }
        let verdict = to_json(verdict)?;
        sqlx::query(
            "DELETE FROM decisions WHERE project_id = ?1
               AND ((scan_a = ?2 AND scan_b = ?3) OR (scan_a = ?3 AND scan_b = ?2))
               AND ('join' IN (verdict ->> 'verdict', ?4 ->> 'verdict') OR (verdict = ?4 AND scan_a = ?2))",
        )
        .bind(project.to_string())
        .bind(scan_a.to_string())
        .bind(scan_b.to_string())
        .bind(&verdict)
        .execute(&mut *tx)
        .await?;
        let row = sqlx::query("SELECT COUNT(*) AS held FROM decisions WHERE project_id = ?")
            .bind(project.to_string())
            .fetch_one(&mut *tx)
            .await?;
        if row.try_get::<i64, _>("held")? >= KeptDecision::MOST.into() {
            return Err(StorageError::TooManyDecisions { project, limit: KeptDecision::MOST });
        }
        sqlx::query(
            "INSERT INTO decisions (id, project_id, scan_a, scan_b, verdict, created_ms)
               VALUES (?, ?, ?, ?, ?, ?)",
        )
        .bind(kept.id.to_string())
        .bind(project.to_string())
        .bind(scan_a.to_string())
        .bind(scan_b.to_string())
        .bind(&verdict)
        .bind(kept.created.0)
        .execute(&mut *tx)
        .await?;
        let job = if let Some(job) = waiting(&mut tx, project).await? {
            job
        } else {
            self.check_quotas(&mut tx, project, key, Addition { jobs: 1, ..Addition::default() }).await?;
            obey(&mut tx, project, key).await?
        };
        let done = (kept, job);
        seal.set(&mut tx, &done).await?;
        self.commit_with(tx, &done.1).await?;
        Ok(done)
    }

    /// Takes a decision back. Returns the job that makes the model follow, as for [`Store::decide`].
    pub async fn take_decision_back(
        &self,
        project: ProjectId,
        id: DecisionId,
        key: Option<KeyId>,
    ) -> Result<Job, StorageError> {
        let mut tx = self.begin().await?;
        let done = sqlx::query("DELETE FROM decisions WHERE id = ? AND project_id = ?")
            .bind(id.to_string())
            .bind(project.to_string())
            .execute(&mut *tx)
            .await?;
        if done.rows_affected() == 0 {
            return Err(StorageError::NoDecision(id));
        }
        // Taking back is not refused for want of room; there is no more of it than of decisions.
        let job = match waiting(&mut tx, project).await? {
            Some(job) => job,
            None => obey(&mut tx, project, key).await?,
        };
        self.commit_with(tx, &job).await?;
        Ok(job)
    }

    /// One decision.
    pub async fn decision(&self, project: ProjectId, id: DecisionId) -> Result<KeptDecision, StorageError> {
        let row = sqlx::query("SELECT * FROM decisions WHERE id = ? AND project_id = ?")
            .bind(id.to_string())
            .bind(project.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(kept).transpose()?.ok_or(StorageError::NoDecision(id))
    }

    /// Decisions of a project in the order they were made, each with its position in the list.
    pub async fn decisions(
        &self,
        project: ProjectId,
        page: Page,
    ) -> Result<Vec<(i64, KeptDecision)>, StorageError> {
        let rows =
            sqlx::query("SELECT * FROM decisions WHERE project_id = ? AND seq > ? ORDER BY seq LIMIT ?")
                .bind(project.to_string())
                .bind(page.after.unwrap_or(0))
                .bind(page.limit)
                .fetch_all(&self.read)
                .await?;
        rows.iter().map(|row| Ok((row.try_get("seq")?, kept(row)?))).collect()
    }

    /// All decisions of a project in the order they were made: what the next version of its model obeys.
    pub async fn all_decisions(&self, project: ProjectId) -> Result<Vec<KeptDecision>, StorageError> {
        let page = Page { after: None, limit: KeptDecision::MOST };
        Ok(self.decisions(project, page).await?.into_iter().map(|(_, kept)| kept).collect())
    }

    /// Commits a change of decisions together with the job that makes the model obey.
    async fn commit_with(&self, tx: Transaction<'static, Sqlite>, job: &Job) -> Result<(), StorageError> {
        tx.commit().await?;
        self.announce([job.id]);
        self.ring();
        Ok(())
    }
}

/// The job that waits to make the model obey, if there is one. Nobody works on it yet, so it will read all that is decided until then; but
/// it serves only if nothing that has not ended was accepted after it: a decision may be about the scan that this brings.
async fn waiting(
    tx: &mut Transaction<'static, Sqlite>,
    project: ProjectId,
) -> Result<Option<Job>, StorageError> {
    let last = sqlx::query(
        "SELECT * FROM jobs WHERE seq = (SELECT MAX(seq) FROM jobs
           WHERE project_id = ? AND lane IN ('ingest', 'map') AND state IN ('accepted', 'running'))",
    )
    .bind(project.to_string())
    .fetch_optional(&mut **tx)
    .await?;
    let Some(row) = last else { return Ok(None) };
    let held = row.try_get::<Option<String>, _>("worker")?.is_some();
    Ok(Some(job(&row)?).filter(|job| !held && job.kind == JobKind::Decision))
}

/// Adds the job that makes the model obey, on the account of a key.
async fn obey(
    tx: &mut Transaction<'static, Sqlite>,
    project: ProjectId,
    key: Option<KeyId>,
) -> Result<Job, StorageError> {
    let id = JobId::generate();
    insert_job(tx, id, project, None, JobKind::Decision, Lane::Map, Timestamp::now()).await?;
    charge_job(tx, id, key).await?;
    made(tx, id).await
}

/// Fails unless the project holds the scan.
async fn present(
    tx: &mut Transaction<'static, Sqlite>,
    project: ProjectId,
    scan: ScanId,
) -> Result<(), StorageError> {
    sqlx::query("SELECT 1 FROM scans WHERE id = ? AND project_id = ? AND deleted_ms IS NULL")
        .bind(scan.to_string())
        .bind(project.to_string())
        .fetch_optional(&mut **tx)
        .await?
        .map(drop)
        .ok_or(StorageError::NoScan(scan))
}

fn kept(row: &SqliteRow) -> Result<KeptDecision, StorageError> {
    let verdict =
        json(row, "verdict")?.ok_or(StorageError::BadRow { column: "verdict", value: "NULL".to_owned() })?;
    Ok(KeptDecision {
        id: parsed(row, "id")?,
        decision: Decision { scan_a: parsed(row, "scan_a")?, scan_b: parsed(row, "scan_b")?, verdict },
        created: Timestamp(row.try_get("created_ms")?),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose;
    use crate::project::{JobState, Limits, Name, Reach, Scope, Token, Verdict};
    use crate::storage::testing::{new_scan, project};
    use crate::storage::{BlobId, Holder, NewKey, Quota, StoredBlob};

    async fn store() -> (Store, ProjectId, [ScanId; 3], tempfile::TempDir) {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let project = project(&store).await;
        let mut scans = Vec::new();
        for content in 0..3_u8 {
            let blob = StoredBlob { id: BlobId(blake3::hash(&[content])), bytes: 1 };
            let new = new_scan(project, content.into(), blob);
            scans.push(store.admit_scan(&new).await.unwrap().scan.id);
        }
        (store, project, scans.try_into().unwrap(), dir)
    }

    fn verdicts(kept: &[KeptDecision]) -> Vec<Verdict> {
        kept.iter().map(|k| k.decision.verdict).collect()
    }

    #[tokio::test]
    async fn a_decision_replaces_what_it_contradicts_and_brings_a_job() {
        let (store, project, [a, b, c], _dir) = store().await;
        let there = Pose::from_translation(nalgebra::Vector3::new(1.0, 0.0, 0.0));
        let join = Verdict::Join { a_from_b: there };
        let ban = Verdict::Forbid { a_from_b: Some(there) };
        let never = Verdict::Forbid { a_from_b: None };
        let decide = async |scan_a, scan_b, verdict| {
            store.decide(project, &Decision { scan_a, scan_b, verdict }, None, Seal::none()).await.unwrap()
        };
        decide(a, c, join).await;
        for (scans, verdict, held) in [
            ((a, b), join, vec![join, join]),
            ((b, a), never, vec![join, never]),
            ((b, a), ban, vec![join, never, ban]),
            ((b, a), never, vec![join, ban, never]),
            ((a, b), join, vec![join, join]),
        ] {
            let (kept, job) = decide(scans.0, scans.1, verdict).await;
            assert_eq!((job.kind, job.state), (JobKind::Decision, JobState::Accepted));
            assert!(store.dismiss_job(job.id).await.is_err(), "what was decided stays so");
            assert_eq!(store.decision(project, kept.id).await.unwrap(), kept);
            assert_eq!(verdicts(&store.all_decisions(project).await.unwrap()), held);
        }
    }

    #[tokio::test]
    async fn decisions_go_one_by_one_or_with_their_scan() {
        let (store, project, [a, b, c], _dir) = store().await;
        let decide =
            |scan_a, scan_b| Decision { scan_a, scan_b, verdict: Verdict::Forbid { a_from_b: None } };
        let (first, _) = store.decide(project, &decide(a, b), None, Seal::none()).await.unwrap();
        store.decide(project, &decide(b, c), None, Seal::none()).await.unwrap();
        let (last, _) = store.decide(project, &decide(c, a), None, Seal::none()).await.unwrap();
        store.take_decision_back(project, first.id, None).await.unwrap();
        let again = store.take_decision_back(project, first.id, None).await;
        assert!(matches!(again, Err(StorageError::NoDecision(id)) if id == first.id));
        store.delete_scan(project, b).await.unwrap();
        assert_eq!(store.all_decisions(project).await.unwrap(), [last]);
        let gone = store.decide(project, &decide(a, b), None, Seal::none()).await;
        assert!(matches!(gone, Err(StorageError::NoScan(id)) if id == b));
    }

    #[tokio::test]
    async fn a_project_holds_so_many_decisions_and_no_more() {
        let (store, project, [a, b, c], _dir) = store().await;
        let mut tx = store.begin().await.unwrap();
        for i in 0..KeptDecision::MOST {
            sqlx::query("INSERT INTO decisions VALUES (NULL, ?, ?, ?, ?, ?, 0)")
                .bind(format!("{i}"))
                .bind(project.to_string())
                .bind(a.to_string())
                .bind(b.to_string())
                .bind(r#"{"verdict":"forbid","a_from_b":null}"#)
                .execute(&mut *tx)
                .await
                .unwrap();
        }
        tx.commit().await.unwrap();
        let one_more = Decision { scan_a: a, scan_b: c, verdict: Verdict::Forbid { a_from_b: None } };
        let refused = store.decide(project, &one_more, None, Seal::none()).await;
        assert!(matches!(refused, Err(StorageError::TooManyDecisions { limit: KeptDecision::MOST, .. })));
        // A join of the two scans takes the place of all that.
        let a_from_b = Pose::identity();
        let join = Decision { scan_a: b, scan_b: a, verdict: Verdict::Join { a_from_b } };
        store.decide(project, &join, None, Seal::none()).await.unwrap();
        assert_eq!(store.all_decisions(project).await.unwrap().len(), 1);
    }

    #[tokio::test]
    async fn decisions_share_the_job_that_waits_and_begin_another_once_it_is_taken_or_overtaken() {
        let (store, project, [a, b, c], _dir) = store().await;
        let ban = |scan_a, scan_b| Decision { scan_a, scan_b, verdict: Verdict::Forbid { a_from_b: None } };
        let decide =
            async |decision: Decision| store.decide(project, &decision, None, Seal::none()).await.unwrap();
        let (first, waits) = decide(ban(a, b)).await;
        for decision in [ban(a, b), ban(a, b), ban(b, c)] {
            assert_eq!(decide(decision).await.1.id, waits.id);
        }
        assert!(matches!(
            store.take_decision_back(project, first.id, None).await,
            Err(StorageError::NoDecision(_))
        ));
        let held = store.all_decisions(project).await.unwrap();
        assert_eq!(held.len(), 2, "what is repeated is replaced");
        assert_eq!(store.take_decision_back(project, held[0].id, None).await.unwrap().id, waits.id);
        // A decision may be about what was accepted after that job.
        let new = new_scan(project, 9, StoredBlob { id: BlobId(blake3::hash(b"9")), bytes: 1 });
        let late = store.admit_scan(&new).await.unwrap().scan.id;
        let (_, second) = decide(ban(a, late)).await;
        assert_ne!(second.id, waits.id);
        // Whoever works on one may have read already what is decided.
        sqlx::query("UPDATE jobs SET worker = 'worker' WHERE id = ?")
            .bind(second.id.to_string())
            .execute(&store.write)
            .await
            .unwrap();
        assert_ne!(decide(ban(a, c)).await.1.id, second.id);
    }

    #[tokio::test]
    async fn jobs_of_decisions_count_for_project_and_key() {
        let (store, project, [a, b, _], _dir) = store().await;
        store.limit_projects(Limits { queued_jobs: Some(4), ..Limits::default() });
        let token = Token::generate(KeyId::generate()).unwrap();
        let limits = Limits { queued_jobs: Some(1), ..Limits::default() };
        let name = Name::parse("rig").unwrap();
        let new = NewKey { name, scope: Scope::Manage, reach: Reach::Everything, limits, expires: None };
        let key = store.keys().create(&new, &token).await.unwrap().id;
        let ban = Decision { scan_a: a, scan_b: b, verdict: Verdict::Forbid { a_from_b: None } };
        let (kept, _) = store.decide(project, &ban, Some(key), Seal::none()).await.unwrap();
        let elsewhere = crate::storage::testing::project(&store).await;
        let of_key = store.create_job(elsewhere, JobKind::Rebuild, Some(key), Seal::none()).await;
        let full = |holder| (holder, Quota::QueuedJobs);
        let refused = |result: Result<(), StorageError>| match result {
            Err(StorageError::OverQuota { holder, quota, .. }) => (holder, quota),
            other => panic!("{other:?}"),
        };
        assert_eq!(refused(of_key.map(drop)), full(Holder::Key(key)), "it is on the key's account");
        // Three scans and the decision are four jobs. Nobody works on the last, so that it serves still.
        store.take_decision_back(project, kept.id, Some(key)).await.unwrap();
        sqlx::query("UPDATE jobs SET worker = 'worker' WHERE kind = 'decision'")
            .execute(&store.write)
            .await
            .unwrap();
        let of_project = store.decide(project, &ban, None, Seal::none()).await;
        assert_eq!(refused(of_project.map(drop)), full(Holder::Project(project)));
        assert!(store.all_decisions(project).await.unwrap().is_empty(), "nothing is half done");
    }
}
