//! Which older versions are kept. What readers see of a version grows with the project, so keeping every version would take space
//! that grows with the square of it.
//!
//! The newest 64 versions stay; of those up to 128 back every second, up to 256 back every fourth, and so on. So a project of n
//! versions keeps about 32 log n of them, closer together the newer they are, and one that was kept is dropped at most once.

use sqlx::{Sqlite, Transaction};

use super::StorageError;
use crate::project::VersionNumber;

/// So many of the newest versions are all kept.
pub const KEPT_WHOLE: u32 = 64;

/// Drops older versions that need not be kept now that `head` is the newest.
pub(super) async fn thin(
    tx: &mut Transaction<'static, Sqlite>,
    project: &str,
    head: VersionNumber,
) -> Result<(), StorageError> {
    let (mut age, mut step) = (KEPT_WHOLE, 2_u32);
    while let Some(upto) = head.0.checked_sub(age).filter(|n| *n > 0) {
        sqlx::query("DELETE FROM versions WHERE project_id = ? AND number <= ? AND number % ? <> 0")
            .bind(project)
            .bind(upto)
            .bind(step)
            .execute(&mut **tx)
            .await?;
        let (Some(older), Some(wider)) = (age.checked_mul(2), step.checked_mul(2)) else { break };
        (age, step) = (older, wider);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::Row;

    use super::*;
    use crate::storage::Store;

    #[tokio::test]
    async fn the_newest_versions_are_all_there_and_older_ones_ever_farther_apart() {
        let dir = tempfile::tempdir().unwrap();
        let store = Store::open(dir.path()).await.unwrap();
        let mut tx = store.begin().await.unwrap();
        sqlx::query("INSERT INTO projects (id, name, seed, created_ms) VALUES ('p', 'n', 0, 0)")
            .execute(&mut *tx)
            .await
            .unwrap();
        for number in 1..=1000 {
            sqlx::query("INSERT INTO versions VALUES ('p', ?1, 'j', 'registration', 's' || ?1, 'c' || ?1, 'e', 0.1, 0, 0, 0, 0)")
                .bind(number)
                .execute(&mut *tx)
                .await
                .unwrap();
            thin(&mut tx, "p", VersionNumber(number)).await.unwrap();
        }
        let rows =
            sqlx::query("SELECT number FROM versions ORDER BY number").fetch_all(&mut *tx).await.unwrap();
        let kept: Vec<u32> = rows.iter().map(|row| row.try_get("number").unwrap()).collect();
        assert_eq!(kept.iter().filter(|n| **n > 936).count(), 64, "the newest");
        let older: Vec<u32> = kept.iter().copied().filter(|n| *n <= 936).collect();
        assert!(older.windows(2).all(|pair| pair[1] - pair[0] <= 32), "{older:?}");
        assert!(older.iter().all(|n| *n > 872 && n % 2 == 0 || n % 4 == 0), "{older:?}");
        assert!(kept.len() < 64 + 32 * 5, "{} versions", kept.len());
    }
}
