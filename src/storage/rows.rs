//! From SQL values to the types of [`crate::project`], with an error instead of a guess for what does not fit.

use std::str::FromStr;

use serde::Serialize;
use serde::de::DeserializeOwned;
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::StorageError;

/// Reads the text of a column as `T`.
pub(super) fn parsed<T: FromStr>(row: &SqliteRow, column: &'static str) -> Result<T, StorageError> {
    let text: String = row.try_get(column)?;
    text.parse().map_err(|_| StorageError::BadRow { column, value: text })
}

/// Reads the text of a column by a function that knows its words.
pub(super) fn word<T>(
    row: &SqliteRow,
    column: &'static str,
    from_word: impl FnOnce(&str) -> Option<T>,
) -> Result<T, StorageError> {
    let text: String = row.try_get(column)?;
    from_word(&text).ok_or(StorageError::BadRow { column, value: text })
}

/// Reads a column that holds JSON or NULL.
pub(super) fn json<T: DeserializeOwned>(
    row: &SqliteRow,
    column: &'static str,
) -> Result<Option<T>, StorageError> {
    let Some(text) = row.try_get::<Option<String>, _>(column)? else { return Ok(None) };
    match serde_json::from_str(&text) {
        Ok(value) => Ok(Some(value)),
        Err(_) => Err(StorageError::BadRow { column, value: text }),
    }
}

/// Reads a count, which is never negative.
pub(super) fn count<T: TryFrom<i64>>(row: &SqliteRow, column: &'static str) -> Result<T, StorageError> {
    let n: i64 = row.try_get(column)?;
    T::try_from(n).map_err(|_| StorageError::BadRow { column, value: n.to_string() })
}

/// Plain data as JSON text. The types that are stored have only string keys, so this cannot fail.
pub(super) fn to_json(value: &impl Serialize) -> Result<String, StorageError> {
    serde_json::to_string(value)
        .map_err(|e| StorageError::BadRow { column: "json to be written", value: e.to_string() })
}
