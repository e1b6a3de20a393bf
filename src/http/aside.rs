//! Answers that grow with the project are written aside: a thread that attends to connections would keep all others waiting meanwhile.

use super::problem::Problem;

/// What takes longer the more scans a project has. A panic in it is an internal error.
pub(super) async fn aside<T: Send + 'static>(
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Problem> {
    tokio::task::spawn_blocking(work).await.map_err(Problem::internal)
}
