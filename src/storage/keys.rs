//! API keys. The only table that an operator's command may change while the service runs: `cairn key` opens it without the
//! lock of the data directory.
//!
//! That is sound because a key is one row that nobody holds in memory: the service reads it anew for every request,
//! SQLite keeps two writers apart, and nothing but the key table is touched. So a key works, and a revoked one ends, at
//! once.

use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqlitePool, SqlitePoolOptions, SqliteRow, SqliteSynchronous};
use sqlx::{Row, Sqlite, Transaction};

use super::rows::{count, parsed, word};
use super::store::BUSY;
use super::{StorageError, Store};
use crate::project::{Digest, Key, KeyId, Limits, Name, ProjectId, Reach, Scope, Timestamp, Token};

/// The keys of a data directory. Clones share the connections.
#[derive(Debug, Clone)]
pub struct Keys {
    read: SqlitePool,
    write: SqlitePool,
}

/// A key to be made.
#[derive(Debug, Clone, PartialEq)]
pub struct NewKey {
    /// What the operator calls it.
    pub name: Name,
    /// What it may do.
    pub scope: Scope,
    /// Where.
    pub reach: Reach,
    /// How much.
    pub limits: Limits,
    /// From when on it opens nothing.
    pub expires: Option<Timestamp>,
}

const SELECT: &str = "SELECT k.*, (SELECT GROUP_CONCAT(project_id) FROM key_projects WHERE key_id = k.id) AS projects FROM keys k";

impl Store {
    /// The keys, over the connections of the service.
    #[must_use]
    pub fn keys(&self) -> Keys {
        Keys { read: self.read.clone(), write: self.write.clone() }
    }
}

impl Keys {
    /// Opens the keys of a data directory, whether or not a service runs on it. If none does, the directory is made and
    /// its schema brought up to date first.
    pub async fn open(data: &Path) -> Result<Self, StorageError> {
        match Store::open(data).await {
            Ok(store) => store.close().await,
            // The service that has it has brought the schema up to date.
            Err(StorageError::InUse) => {}
            Err(error) => return Err(error),
        }
        let options = SqliteConnectOptions::new()
            .filename(data.join("cairn.sqlite"))
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY);
        let pool = SqlitePoolOptions::new().max_connections(1).connect_with(options).await?;
        Ok(Self { read: pool.clone(), write: pool })
    }

    /// Closes what [`Keys::open`] opened.
    pub async fn close(&self) {
        self.write.close().await;
    }

    /// Keeps a new key, and of its token only the digest.
    pub async fn create(&self, new: &NewKey, token: &Token) -> Result<Key, StorageError> {
        let now = Timestamp::now();
        let mut tx = self.begin().await?;
        sqlx::query(
            "INSERT INTO keys (id, name, digest, scope, every_project, max_bytes, max_scans, max_queued_jobs,
               max_open_uploads, created_ms, expires_ms) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        )
        .bind(token.key.to_string())
        .bind(new.name.as_str())
        .bind(token.digest().as_bytes().as_slice())
        .bind(new.scope.as_str())
        .bind(new.reach == Reach::Everything)
        .bind(new.limits.bytes.map(u64::cast_signed))
        .bind(new.limits.scans.map(u64::cast_signed))
        .bind(new.limits.queued_jobs.map(u64::cast_signed))
        .bind(new.limits.open_uploads.map(u64::cast_signed))
        .bind(now.0)
        .bind(new.expires.map(|end| end.0))
        .execute(&mut *tx)
        .await?;
        if let Reach::Projects(projects) = &new.reach {
            for project in projects {
                grant(&mut tx, token.key, *project).await?;
            }
        }
        tx.commit().await?;
        self.key(token.key).await?.ok_or(StorageError::NoKey(token.key))
    }

    /// All keys, also those that open nothing any more, oldest first.
    pub async fn list(&self) -> Result<Vec<Key>, StorageError> {
        let rows = sqlx::query(sqlx::AssertSqlSafe(format!("{SELECT} ORDER BY k.created_ms, k.id")))
            .fetch_all(&self.read)
            .await?;
        rows.iter().map(key).collect()
    }

    /// Revokes a key for good. One that was revoked before stays as it is.
    pub async fn revoke(&self, id: KeyId) -> Result<Key, StorageError> {
        let mut tx = self.begin().await?;
        sqlx::query("UPDATE keys SET revoked_ms = COALESCE(revoked_ms, ?) WHERE id = ?")
            .bind(Timestamp::now().0)
            .bind(id.to_string())
            .execute(&mut *tx)
            .await?;
        tx.commit().await?;
        self.key(id).await?.ok_or(StorageError::NoKey(id))
    }

    /// The key that a token opens, or `None` if there is none, the secret is not its, or it is no longer valid. A wrong
    /// secret takes as long as the right one.
    pub async fn opened_by(&self, token: &Token) -> Result<Option<Key>, StorageError> {
        let row = self.row(token.key).await?;
        let Some(row) = row else { return Ok(None) };
        let kept: Vec<u8> = row.try_get("digest")?;
        let kept = <[u8; 32]>::try_from(kept)
            .map_err(|_| StorageError::BadRow { column: "digest", value: token.key.to_string() })?;
        let same = Digest::from_bytes(kept) == token.digest();
        Ok(Some(key(&row)?).filter(|key| same && key.is_valid(Timestamp::now())))
    }

    /// Whether any key was ever made, whatever became of it.
    pub async fn any(&self) -> Result<bool, StorageError> {
        Ok(sqlx::query("SELECT 1 FROM keys LIMIT 1").fetch_optional(&self.read).await?.is_some())
    }

    /// Whether some key opens something now.
    pub async fn any_valid(&self) -> Result<bool, StorageError> {
        let now = Timestamp::now();
        Ok(self.list().await?.iter().any(|key| key.is_valid(now)))
    }

    async fn key(&self, id: KeyId) -> Result<Option<Key>, StorageError> {
        self.row(id).await?.as_ref().map(key).transpose()
    }

    async fn row(&self, id: KeyId) -> Result<Option<SqliteRow>, StorageError> {
        let query = sqlx::query(sqlx::AssertSqlSafe(format!("{SELECT} WHERE k.id = ?"))).bind(id.to_string());
        Ok(query.fetch_optional(&self.read).await?)
    }

    async fn begin(&self) -> Result<Transaction<'static, Sqlite>, StorageError> {
        Ok(self.write.begin_with("BEGIN IMMEDIATE").await?)
    }
}

async fn grant(
    tx: &mut Transaction<'static, Sqlite>,
    key: KeyId,
    project: ProjectId,
) -> Result<(), StorageError> {
    let done =
        sqlx::query("INSERT INTO key_projects (key_id, project_id) SELECT ?, id FROM projects WHERE id = ?")
            .bind(key.to_string())
            .bind(project.to_string())
            .execute(&mut **tx)
            .await?;
    if done.rows_affected() == 0 { Err(StorageError::NoProject(project)) } else { Ok(()) }
}

fn key(row: &SqliteRow) -> Result<Key, StorageError> {
    let reach = if row.try_get("every_project")? {
        Reach::Everything
    } else {
        let listed: Option<String> = row.try_get("projects")?;
        let ids = listed.iter().flat_map(|text| text.split(','));
        let bad =
            |text: &str| StorageError::BadRow { column: "key_projects.project_id", value: text.to_owned() };
        Reach::Projects(ids.map(|text| text.parse().map_err(|_| bad(text))).collect::<Result<_, _>>()?)
    };
    Ok(Key {
        id: parsed(row, "id")?,
        name: word(row, "name", |text| Name::parse(text).ok())?,
        scope: word(row, "scope", Scope::from_word)?,
        reach,
        limits: limits(row)?,
        created: Timestamp(row.try_get("created_ms")?),
        expires: row.try_get::<Option<i64>, _>("expires_ms")?.map(Timestamp),
        revoked: row.try_get::<Option<i64>, _>("revoked_ms")?.map(Timestamp),
    })
}

pub(super) fn limits(row: &SqliteRow) -> Result<Limits, StorageError> {
    let limit = |column| {
        let some = row.try_get::<Option<i64>, _>(column)?.is_some();
        if some { count(row, column).map(Some) } else { Ok(None) }
    };
    Ok(Limits {
        bytes: limit("max_bytes")?,
        scans: limit("max_scans")?,
        queued_jobs: limit("max_queued_jobs")?,
        open_uploads: limit("max_open_uploads")?,
    })
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::project::ProjectSettings;
    use crate::storage::Seal;

    fn new(reach: Reach) -> NewKey {
        let limits = Limits { bytes: Some(7), scans: None, queued_jobs: Some(2), open_uploads: Some(3) };
        let name = Name::parse("rig 3").unwrap();
        NewKey { name, scope: Scope::Upload, reach, limits, expires: None }
    }

    #[tokio::test]
    async fn a_key_made_beside_the_running_service_opens_it_at_once_and_revoked_it_does_not() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let project = store
            .create_project(&Name::parse("p").unwrap(), &ProjectSettings::default(), Seal::none())
            .await
            .unwrap();
        let beside = Keys::open(dir.path()).await.unwrap();
        let token = Token::generate(KeyId::generate()).unwrap();
        let new = new(Reach::Projects(BTreeSet::from([project.id])));
        let made = beside.create(&new, &token).await.unwrap();
        assert_eq!(store.keys().opened_by(&token).await.unwrap(), Some(made.clone()));
        assert_eq!((made.reach, made.limits), (new.reach, new.limits));

        let wrong = Token::generate(token.key).unwrap();
        assert_eq!(store.keys().opened_by(&wrong).await.unwrap(), None);
        beside.revoke(token.key).await.unwrap();
        assert_eq!(store.keys().opened_by(&token).await.unwrap(), None);
        assert!(store.keys().any().await.unwrap() && !store.keys().any_valid().await.unwrap());
    }

    #[tokio::test]
    async fn a_key_for_a_project_that_is_not_there_is_not_made_and_one_loses_a_deleted_project() {
        let dir = tempfile::tempdir().unwrap();
        let keys = Keys::open(dir.path()).await.unwrap();
        let nowhere = ProjectId::generate();
        let token = Token::generate(KeyId::generate()).unwrap();
        let refused = keys.create(&new(Reach::Projects(BTreeSet::from([nowhere]))), &token).await;
        assert!(matches!(refused, Err(StorageError::NoProject(id)) if id == nowhere));
        assert_eq!(keys.list().await.unwrap(), []);
        keys.close().await;

        let store = Store::open(dir.path()).await.unwrap();
        let name = Name::parse("p").unwrap();
        let project = store.create_project(&name, &ProjectSettings::default(), Seal::none()).await.unwrap();
        let reach = Reach::Projects(BTreeSet::from([project.id]));
        store.keys().create(&new(reach), &token).await.unwrap();
        store.delete_project(project.id).await.unwrap();
        let left = store.keys().opened_by(&token).await.unwrap().unwrap();
        assert_eq!(left.reach, Reach::Projects(BTreeSet::new()), "it must not become a key for everything");
    }
}
