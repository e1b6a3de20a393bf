//! Rows of scans: admission, lookup, deletion.

use sqlx::sqlite::SqliteRow;
use sqlx::{Row, Sqlite, Transaction};

use super::claims::free_members;
use super::job_rows::{charge_job, insert_job};
use super::quotas::Addition;
use super::rows::{count, json, parsed, to_json, word};
use super::{BlobId, Page, StorageError, Store};
use crate::project::{
    ContentKey, Interpretation, Job, JobId, JobKind, KeyId, Lane, Name, ProjectId, Scan, ScanId, ScanState,
    Standing, Timestamp, UploadEnd, UploadId,
};

/// An upload that is safe on disk and waits to be acknowledged.
#[derive(Debug, Clone, PartialEq)]
pub struct NewScan {
    /// Where it belongs.
    pub project: ProjectId,
    /// What the engine will know it by.
    pub key: ContentKey,
    /// What the client calls it.
    pub name: Name,
    /// The recognised format.
    pub format: String,
    /// Its bytes.
    pub blob: BlobId,
    /// How many they are.
    pub bytes: u64,
    /// How they are read.
    pub interpretation: Interpretation,
    /// The key that sent them.
    pub sender: Option<KeyId>,
}

/// What became of an upload.
#[derive(Debug, Clone, PartialEq)]
pub struct Admission {
    /// The scan, new or already there.
    pub scan: Scan,
    /// The job that registers it.
    pub job: Job,
    /// Whether the project had this content already, registered or on its way; then nothing was changed.
    pub duplicate: bool,
}

impl Store {
    /// Acknowledges an upload: the scan and its job, in one transaction. Content that the project has already is
    /// answered with the scan that it is; if that has failed or was dismissed, a new job tries again.
    pub async fn admit_scan(&self, new: &NewScan) -> Result<Admission, StorageError> {
        let mut tx = self.begin().await?;
        let admitted = self.admit(&mut tx, new, None, Timestamp::now()).await?;
        tx.commit().await?;
        self.admitted(new.project, admitted).await
    }

    /// Tells whom it concerns of a scan whose admission is committed.
    pub(super) async fn admitted(
        &self,
        project: ProjectId,
        UploadEnd { scan, job, duplicate }: UploadEnd,
    ) -> Result<Admission, StorageError> {
        if !duplicate {
            self.announce([job]);
            self.ring();
        }
        let (scan, job) = (self.scan(project, scan).await?, self.job(job).await?);
        Ok(Admission { scan, job, duplicate })
    }

    /// Admits a scan within a transaction; `announced` is the upload that it came as, if in several requests.
    pub(super) async fn admit(
        &self,
        tx: &mut Transaction<'static, Sqlite>,
        new: &NewScan,
        announced: Option<UploadId>,
        now: Timestamp,
    ) -> Result<UploadEnd, StorageError> {
        let known = sqlx::query(
            "SELECT id, job_id, state FROM scans WHERE project_id = ? AND content_key = ? AND deleted_ms IS NULL",
        )
        .bind(new.project.to_string())
        .bind(new.key.0.to_be_bytes().as_slice())
        .fetch_optional(&mut **tx)
        .await?;
        let Some(row) = known else {
            let more = Addition { bytes: new.bytes, scans: 1, jobs: 1, announced, ..Addition::default() };
            self.check_quotas(&mut *tx, new.project, new.sender, more).await?;
            let (scan, job) = insert_scan(tx, new, now).await?;
            return Ok(UploadEnd { scan, job, duplicate: false });
        };
        let scan = parsed(&row, "id")?;
        match word(&row, "state", ScanState::from_word)? {
            ScanState::Failed | ScanState::Dismissed => {
                let more = Addition { jobs: 1, ..Addition::default() };
                self.check_quotas(&mut *tx, new.project, new.sender, more).await?;
                Ok(UploadEnd { scan, job: try_again(tx, new, scan, now).await?, duplicate: false })
            }
            _ => Ok(UploadEnd { scan, job: parsed(&row, "job_id")?, duplicate: true }),
        }
    }

    /// One scan that was not deleted.
    pub async fn scan(&self, project: ProjectId, id: ScanId) -> Result<Scan, StorageError> {
        let row = sqlx::query("SELECT * FROM scans WHERE id = ? AND project_id = ? AND deleted_ms IS NULL")
            .bind(id.to_string())
            .bind(project.to_string())
            .fetch_optional(&self.read)
            .await?;
        row.as_ref().map(scan).transpose()?.ok_or(StorageError::NoScan(id))
    }

    /// Scans that were not deleted, in order of arrival, which is also their position in the list plus one.
    pub async fn scans(&self, project: ProjectId, page: Page) -> Result<Vec<Scan>, StorageError> {
        let rows = sqlx::query(
            "SELECT * FROM scans WHERE project_id = ? AND deleted_ms IS NULL AND arrival >= ? ORDER BY arrival LIMIT ?",
        )
        .bind(project.to_string())
        .bind(page.after.unwrap_or(0))
        .bind(page.limit)
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(scan).collect()
    }

    /// All scans of a project, deleted ones included: what the keys of a stored model mean.
    pub async fn scans_ever(&self, project: ProjectId) -> Result<Vec<(Scan, bool)>, StorageError> {
        let rows = sqlx::query("SELECT * FROM scans WHERE project_id = ? ORDER BY arrival")
            .bind(project.to_string())
            .fetch_all(&self.read)
            .await?;
        rows.iter()
            .map(|row| Ok((scan(row)?, row.try_get::<Option<i64>, _>("deleted_ms")?.is_some())))
            .collect()
    }

    /// Names of all scans of a project, deleted ones included, in order of arrival.
    pub async fn names_ever(&self, project: ProjectId) -> Result<Vec<(ScanId, Name)>, StorageError> {
        let rows = sqlx::query("SELECT id, name FROM scans WHERE project_id = ? ORDER BY arrival")
            .bind(project.to_string())
            .fetch_all(&self.read)
            .await?;
        rows.iter().map(|row| Ok((parsed(row, "id")?, name(row)?))).collect()
    }

    /// Where the scans of the newest version stand, as far as their own rows tell; scans that were deleted are left out. For when
    /// the version itself cannot be read.
    pub async fn standings(&self, project: ProjectId) -> Result<Vec<(ScanId, Standing)>, StorageError> {
        let scans = self.scans_ever(project).await?.into_iter().filter(|(_, deleted)| !deleted);
        Ok(scans
            .filter(|(scan, _)| matches!(scan.state, ScanState::Registered | ScanState::Waiting))
            .filter_map(|(scan, _)| Some((scan.id, scan.standing?)))
            .collect())
    }

    /// Natural resolutions (metres) of the first `limit` scans by arrival that can take part and are decoded.
    pub async fn first_scales(&self, project: ProjectId, limit: u32) -> Result<Vec<f64>, StorageError> {
        let rows = sqlx::query(
            "SELECT scale FROM (SELECT scale FROM scans WHERE project_id = ? AND deleted_ms IS NULL
               AND state NOT IN ('failed', 'dismissed') ORDER BY arrival LIMIT ?) WHERE scale IS NOT NULL",
        )
        .bind(project.to_string())
        .bind(limit)
        .fetch_all(&self.read)
        .await?;
        rows.iter().map(|row| Ok(row.try_get("scale")?)).collect()
    }

    /// Deletes a scan: it is gone for readers at once, its registration is dismissed, and the returned job takes it
    /// out of the model.
    pub async fn delete_scan(&self, project: ProjectId, id: ScanId) -> Result<Job, StorageError> {
        let now = Timestamp::now();
        let job = JobId::generate();
        let mut tx = self.begin().await?;
        let gone = sqlx::query(
            "UPDATE scans SET deleted_ms = ? WHERE id = ? AND project_id = ? AND deleted_ms IS NULL RETURNING job_id",
        )
        .bind(now.0)
        .bind(id.to_string())
        .bind(project.to_string())
        .fetch_optional(&mut *tx)
        .await?
        .ok_or(StorageError::NoScan(id))?;
        let registration: JobId = parsed(&gone, "job_id")?;
        sqlx::query(
            "UPDATE jobs SET state = 'dismissed', worker = NULL, leader = NULL, finished_ms = ?1, updated_ms = ?1,
               revision = revision + 1 WHERE id = ?2 AND state IN ('accepted', 'running')",
        )
        .bind(now.0)
        .bind(registration.to_string())
        .execute(&mut *tx)
        .await?;
        // If it led a batch, the members are free again.
        free_members(&mut tx, registration).await?;
        insert_job(&mut tx, job, project, Some(id), JobKind::Removal, Lane::Map, now).await?;
        tx.commit().await?;
        self.announce([registration, job]);
        self.ring();
        self.job(job).await
    }
}

/// A new scan and the job that registers it.
async fn insert_scan(
    tx: &mut Transaction<'static, Sqlite>,
    new: &NewScan,
    now: Timestamp,
) -> Result<(ScanId, JobId), StorageError> {
    let arrival: i64 = sqlx::query(
        "UPDATE projects SET arrivals = arrivals + 1 WHERE id = ? RETURNING arrivals - 1 AS arrival",
    )
    .bind(new.project.to_string())
    .fetch_optional(&mut **tx)
    .await?
    .ok_or(StorageError::NoProject(new.project))?
    .try_get("arrival")?;
    let (scan, job) = (ScanId::generate(), JobId::generate());
    sqlx::query(
        "INSERT INTO scans (id, project_id, content_key, name, format, blob, bytes, interpretation, arrival, state,
           job_id, created_ms, key_id) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, 'received', ?, ?, ?)",
    )
    .bind(scan.to_string())
    .bind(new.project.to_string())
    .bind(new.key.0.to_be_bytes().as_slice())
    .bind(new.name.as_str())
    .bind(&new.format)
    .bind(new.blob.to_string())
    .bind(new.bytes.cast_signed())
    .bind(to_json(&new.interpretation)?)
    .bind(arrival)
    .bind(job.to_string())
    .bind(now.0)
    .bind(new.sender.map(|key| key.to_string()))
    .execute(&mut **tx)
    .await?;
    insert_job(tx, job, new.project, Some(scan), JobKind::Registration, Lane::Ingest, now).await?;
    charge_job(tx, job, new.sender).await?;
    Ok((scan, job))
}

/// A new job for a scan that never came into the model. The scan keeps its place in the order of arrival.
async fn try_again(
    tx: &mut Transaction<'static, Sqlite>,
    new: &NewScan,
    scan: ScanId,
    now: Timestamp,
) -> Result<JobId, StorageError> {
    let job = JobId::generate();
    sqlx::query("UPDATE scans SET state = 'received', standing = NULL, name = ?, job_id = ? WHERE id = ?")
        .bind(new.name.as_str())
        .bind(job.to_string())
        .bind(scan.to_string())
        .execute(&mut **tx)
        .await?;
    insert_job(tx, job, new.project, Some(scan), JobKind::Registration, Lane::Ingest, now).await?;
    charge_job(tx, job, new.sender).await?;
    Ok(job)
}

/// Reads 16 bytes as a content key.
pub(super) fn content_key(row: &SqliteRow, column: &'static str) -> Result<ContentKey, StorageError> {
    let bytes: Vec<u8> = row.try_get(column)?;
    match bytes.as_slice().try_into() {
        Ok(bytes) => Ok(ContentKey(u128::from_be_bytes(bytes))),
        Err(_) => Err(StorageError::BadRow { column, value: format!("{} bytes", bytes.len()) }),
    }
}

fn name(row: &SqliteRow) -> Result<Name, StorageError> {
    word(row, "name", |text| Name::parse(text).ok())
}

fn scan(row: &SqliteRow) -> Result<Scan, StorageError> {
    Ok(Scan {
        id: parsed(row, "id")?,
        project: parsed(row, "project_id")?,
        key: content_key(row, "content_key")?,
        name: name(row)?,
        format: row.try_get("format")?,
        blob: row.try_get("blob")?,
        bytes: count(row, "bytes")?,
        interpretation: json(row, "interpretation")?.unwrap_or_default(),
        arrival: count(row, "arrival")?,
        state: word(row, "state", ScanState::from_word)?,
        standing: json(row, "standing")?,
        points: row.try_get::<Option<i64>, _>("points")?.map(i64::cast_unsigned),
        colored: row.try_get("colored")?,
        extent: row.try_get("extent")?,
        job: parsed(row, "job_id")?,
        created: Timestamp(row.try_get("created_ms")?),
    })
}
