//! Requests with a key that have not been answered. They are in memory alone: none survives the process that runs them.

use std::collections::HashSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

type Name = (String, String);

/// Who runs which key. Clones share it.
#[derive(Debug, Clone, Default)]
pub(in crate::http) struct Running(Arc<Mutex<HashSet<Name>>>);

/// The right to run the request of a key, until it is dropped.
#[derive(Debug)]
pub(super) struct Claim {
    running: Running,
    name: Name,
}

impl Running {
    fn names(&self) -> MutexGuard<'_, HashSet<Name>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The right to run the request of this key, unless another request has it.
    pub(super) fn claim(&self, scope: &str, key: &str) -> Option<Claim> {
        let name = (scope.to_owned(), key.to_owned());
        self.names().insert(name.clone()).then(|| Claim { running: self.clone(), name })
    }
}

impl Drop for Claim {
    fn drop(&mut self) {
        self.running.names().remove(&self.name);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_request_a_key_and_client_runs_at_a_time() {
        let running = Running::default();
        let first = running.claim("a", "k").unwrap();
        assert!(running.claim("a", "k").is_none());
        assert!(running.claim("b", "k").is_some());
        drop(first);
        assert!(running.claim("a", "k").is_some());
    }
}
