//! How often something may happen, by client: token buckets, by the generic cell rate algorithm (ITU-T I.371), which keeps one
//! moment a client. Written here because the table must stay small whoever asks: a client whose bucket is full is forgotten.

use std::collections::HashMap;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use super::sender::Source;

/// Clients that are remembered at once. More than these within a few seconds, and the rest is let through uncounted.
const MOST: usize = 65_536;

/// A bucket of tokens for each client; one comes back at a time.
#[derive(Debug)]
pub(super) struct Buckets {
    every: Duration,
    depth: Duration,
    table: Mutex<Table>,
}

#[derive(Debug)]
struct Table {
    /// When the bucket of a client will be full again.
    full_at: HashMap<Source, Instant>,
    swept: Instant,
}

impl Buckets {
    /// Buckets of `burst` tokens, all of which come back within `span`.
    pub fn new(burst: u32, span: Duration) -> Self {
        let table = Mutex::new(Table { full_at: HashMap::new(), swept: Instant::now() });
        Self { every: span / burst.max(1), depth: span, table }
    }

    /// Takes a token as of `now`, or tells after how long there will be one.
    pub fn take(&self, source: Source, now: Instant) -> Result<(), Duration> {
        let mut table = self.table.lock().unwrap_or_else(PoisonError::into_inner);
        let full_at = table.full_at.get(&source).copied().map_or(now, |at| at.max(now)) + self.every;
        let missing = full_at.duration_since(now).saturating_sub(self.depth);
        if !missing.is_zero() {
            return Err(missing);
        }
        if table.has_room(source, now) {
            table.full_at.insert(source, full_at);
        }
        Ok(())
    }
}

impl Table {
    fn has_room(&mut self, source: Source, now: Instant) -> bool {
        if self.full_at.len() < MOST || self.full_at.contains_key(&source) {
            return true;
        }
        // All of it is looked at, so not at every request.
        if now.duration_since(self.swept) > Duration::from_secs(1) {
            self.swept = now;
            self.full_at.retain(|_, at| *at > now);
        }
        self.full_at.len() < MOST
    }
}

#[cfg(test)]
mod tests {
    use std::net::Ipv4Addr;

    use super::*;

    fn client(n: u32) -> Source {
        Source::of(Ipv4Addr::from_bits(n).into())
    }

    #[test]
    fn a_burst_is_let_through_then_as_many_as_come_back_and_others_are_not_concerned() {
        let (buckets, begin) = (Buckets::new(10, Duration::from_secs(5)), Instant::now());
        let taken = (0..30).filter(|_| buckets.take(client(1), begin).is_ok()).count();
        assert_eq!(taken, 10);
        assert_eq!(buckets.take(client(1), begin), Err(Duration::from_millis(500)));
        assert_eq!(buckets.take(client(2), begin), Ok(()));
        let later = begin + Duration::from_millis(1600);
        assert_eq!((0..30).filter(|_| buckets.take(client(1), later).is_ok()).count(), 3);
        let rested = later + Duration::from_mins(1);
        assert_eq!((0..30).filter(|_| buckets.take(client(1), rested).is_ok()).count(), 10);
    }

    #[test]
    fn however_many_clients_ask_the_table_stays_small_and_who_stopped_asking_is_forgotten() {
        let (buckets, begin) = (Buckets::new(1, Duration::from_secs(5)), Instant::now());
        let known = || buckets.table.lock().unwrap().full_at.len();
        for n in 0..2 * MOST as u32 {
            assert_eq!(buckets.take(client(n), begin), Ok(()));
        }
        assert_eq!(known(), MOST);
        assert!(buckets.take(client(0), begin).is_err(), "who is known is counted");
        buckets.take(client(u32::MAX), begin + Duration::from_secs(6)).unwrap();
        assert_eq!(known(), 1);
    }
}
