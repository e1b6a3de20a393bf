//! How many connections each address holds.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use crate::http::access::Source;

/// Who holds how many connections. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Places {
    held: Arc<Mutex<HashMap<Source, usize>>>,
}

/// A connection of a client, until it is dropped.
#[derive(Debug)]
pub(super) struct Place {
    places: Places,
    source: Source,
}

impl Places {
    fn held(&self) -> MutexGuard<'_, HashMap<Source, usize>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A place for one more connection, unless the client has `most` already.
    pub fn take(&self, source: Source, most: usize) -> Option<Place> {
        let mut all = self.held();
        let held = all.get(&source).copied().unwrap_or(0);
        if held >= most {
            return None;
        }
        all.insert(source, held + 1);
        Some(Place { places: self.clone(), source })
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let mut all = self.places.held();
        match all.get(&self.source).copied() {
            Some(held) if held > 1 => all.insert(self.source, held - 1),
            _ => all.remove(&self.source),
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_has_so_many_places_and_gets_one_back_when_a_connection_ends() {
        let (places, source) = (Places::default(), |text: &str| Source::of(text.parse().unwrap()));
        let first = places.take(source("192.0.2.1"), 2).unwrap();
        let _second = places.take(source("192.0.2.1"), 2).unwrap();
        assert!(places.take(source("192.0.2.1"), 2).is_none());
        assert!(places.take(source("192.0.2.2"), 2).is_some());
        drop(first);
        assert!(places.take(source("192.0.2.1"), 2).is_some());
        assert_eq!(places.held().len(), 1, "who has none is not remembered");
    }
}
