//! Versions that are read for answers: each is in memory as a whole, so few are at a time, whoever asks for how many. Used by all that
//! shows or downloads a version.

use std::sync::Arc;

use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::Serialize;
use serde_json::to_vec;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::Instrument;

use super::aside::aside;
use super::problem::Problem;
use crate::project::{ModelContent, ProjectId, VersionNumber};
use crate::storage::Store;

/// Versions that are in memory at the same time; docs/operations.md says what that comes to.
const AT_ONCE: usize = 4;

/// Reads versions. Clones share the places.
#[derive(Debug, Clone)]
pub struct Readings(Arc<Semaphore>);

/// A version that was read, and its place among those that are in memory. It must not wait for a client or a long computation.
#[derive(Debug)]
pub(super) struct Reading {
    /// Its number.
    pub version: VersionNumber,
    /// What it holds.
    pub content: ModelContent,
    place: OwnedSemaphorePermit,
}

impl Default for Readings {
    fn default() -> Self {
        Self(Arc::new(Semaphore::new(AT_ONCE)))
    }
}

impl Readings {
    /// Reads this version of a project, or the newest, when there is a place for it.
    pub(super) async fn read(
        &self,
        store: &Store,
        project: ProjectId,
        number: Option<VersionNumber>,
    ) -> Result<Reading, Problem> {
        let place = Arc::clone(&self.0).acquire_owned().await.map_err(Problem::internal)?;
        let store = store.clone();
        // What was begun goes on when its client leaves, and so has its place until it ends.
        let read = async move {
            let (version, content) = store.content(project, number).await?;
            Ok(Reading { version, content, place })
        };
        tokio::spawn(read.in_current_span()).await.map_err(Problem::internal)?
    }
}

impl Reading {
    /// An answer as JSON, made of the version and written aside. The version has its place until all is written.
    pub async fn json<T: Serialize>(
        self,
        body: impl FnOnce(VersionNumber, ModelContent) -> T + Send + 'static,
    ) -> Result<Response, Problem> {
        let Self { version, content, place } = self;
        let write = move || {
            let _place = place;
            to_vec(&body(version, content))
        };
        let bytes = aside(write).await?.map_err(Problem::internal)?;
        Ok(([(header::CONTENT_TYPE, "application/json")], bytes).into_response())
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;
    use futures_util::future::join_all;

    use super::*;
    use crate::storage::testing::Fixture;

    #[tokio::test]
    async fn few_versions_are_in_memory_at_a_time_and_none_for_longer_than_it_is_needed() {
        let at = Fixture::new().await;
        let readings = Readings::default();
        let read = || readings.read(&at.store, at.project, None);
        let mut held = Vec::new();
        for _ in 0..AT_ONCE {
            held.push(read().await.unwrap());
        }
        let mut waits = Box::pin(read());
        assert!((&mut waits).now_or_never().is_none(), "all places are taken");
        let written = held.pop().unwrap().json(|version, _| version.0).await.unwrap();
        assert_eq!(written.status(), 200);
        assert!(waits.await.is_ok(), "one has been written");
        drop(held);
        let all = join_all((0..5 * AT_ONCE).map(|_| async { read().await.map(drop) })).await;
        assert!(all.iter().all(Result::is_ok));
    }
}
