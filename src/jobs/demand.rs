//! How much is asked of the service at this moment: `http` tells of every request and of every connection, and `isolated` leaves a core to
//! answers while many ask much.

use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// The time over which requests are counted.
const WINDOW: Duration = Duration::from_secs(1);
/// How long after much was asked it is taken that much will be.
const LASTS: Duration = Duration::from_secs(5);
/// Connections at once that many clients have. Fewer that ask as often are loops that wait for their jobs: to have those done sooner serves
/// them better than an answer that says sooner that they are not.
const CROWD: usize = 8;

/// Requests, and whether there are many.
#[derive(Debug)]
pub struct Demand {
    /// Requests a second that are many; 0: no number is.
    many: u64,
    asked: AtomicU64,
    connected: AtomicUsize,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    window: Instant,
    /// Requests before the window.
    before: u64,
    /// When it stops that there are many.
    until: Instant,
}

impl Demand {
    /// So many requests a second are many; 0: no number is.
    #[must_use]
    pub fn new(many: u64) -> Self {
        let now = Instant::now();
        let state = Mutex::new(State { window: now, before: 0, until: now });
        Self { many, asked: AtomicU64::new(0), connected: AtomicUsize::new(0), state }
    }

    /// Counts a request.
    pub fn asked(&self) {
        self.asked.fetch_add(1, Ordering::Relaxed);
    }

    /// Counts a connection until what is returned is dropped.
    #[must_use]
    pub fn connected(self: &Arc<Self>) -> Connected {
        self.connected.fetch_add(1, Ordering::Relaxed);
        Connected(Arc::clone(self))
    }

    /// Whether many requests came lately, from many clients.
    pub(super) fn is_high(&self, now: Instant) -> bool {
        if self.many == 0 {
            return false;
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let passed = now.saturating_duration_since(state.window);
        if passed >= WINDOW {
            let asked = self.asked.load(Ordering::Relaxed);
            let often = (asked - state.before) as f64 >= self.many as f64 * passed.as_secs_f64();
            if often && self.connected.load(Ordering::Relaxed) >= CROWD {
                state.until = now + LASTS;
            }
            (state.window, state.before) = (now, asked);
        }
        now < state.until
    }
}

/// A connection of a client.
#[derive(Debug)]
pub struct Connected(Arc<Demand>);

impl Drop for Connected {
    fn drop(&mut self) {
        self.0.connected.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn crowd(many: u64) -> (Arc<Demand>, Vec<Connected>) {
        let demand = Arc::new(Demand::new(many));
        let crowd = (0..CROWD).map(|_| demand.connected()).collect();
        (demand, crowd)
    }

    #[test]
    fn demand_is_high_while_many_ask_and_a_little_longer() {
        let (demand, _crowd) = crowd(3);
        let mut now = Instant::now();
        let mut second = |requests: usize| {
            (0..requests).for_each(|_| demand.asked());
            now += WINDOW;
            demand.is_high(now)
        };
        assert_eq!([0, 2, 1].map(&mut second), [false; 3]);
        assert_eq!([4, 0, 0, 0, 0].map(&mut second), [true; 5]);
        assert!(!second(2));
        assert!(second(3) && second(0));
    }

    #[test]
    fn a_few_that_ask_often_are_no_crowd() {
        let (demand, mut crowd) = crowd(3);
        let mut now = Instant::now();
        let mut second = || {
            (0..1000).for_each(|_| demand.asked());
            now += LASTS;
            demand.is_high(now)
        };
        assert!(second());
        crowd.pop();
        assert!(!second());
        crowd.push(demand.connected());
        assert!(second());
    }

    #[test]
    fn nobody_looks_for_long_and_a_few_requests_since_are_not_many() {
        let (demand, _crowd) = crowd(3);
        let now = Instant::now();
        (0..20).for_each(|_| demand.asked());
        assert!(!demand.is_high(now + 10 * WINDOW));
    }

    #[test]
    fn no_number_is_many_if_none_is_said_to_be() {
        let (demand, _crowd) = crowd(0);
        (0..1000).for_each(|_| demand.asked());
        assert!(!demand.is_high(Instant::now() + WINDOW));
    }
}
