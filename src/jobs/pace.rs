//! Whether bytes come, or go, fast enough. A client that sends or takes a byte a minute is as silent as one that does nothing: both would
//! hold a connection for ever. Used by all that read bodies of any length, and by connections for their answers.

use std::time::Duration;

use futures_util::{Stream, StreamExt};
use tokio::time::{Instant, timeout};

/// Bytes that make up for the waiting before them.
const ENOUGH: usize = 1024;

/// How long was waited for how much.
#[derive(Debug)]
pub(crate) struct Pace {
    idle: Duration,
    waited: Duration,
    came: usize,
}

/// Less than a kilobyte came for too long.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Stalled;

impl Pace {
    /// Waits `idle` in all for each kilobyte, at most. Time in which nobody waits does not count: the disk may be slow as well.
    pub fn new(idle: Duration) -> Self {
        Self { idle, waited: Duration::ZERO, came: 0 }
    }

    /// The next piece of a body; `None` at its end.
    pub async fn next<B: AsRef<[u8]>, E>(
        &mut self,
        body: &mut (impl Stream<Item = Result<B, E>> + Unpin),
    ) -> Result<Option<Result<B, E>>, Stalled> {
        let begun = Instant::now();
        let next = timeout(self.left(), body.next()).await.map_err(|_| Stalled)?;
        let came = next.iter().flatten().map(|piece| piece.as_ref().len()).sum();
        self.note(begun.elapsed(), came);
        Ok(next)
    }

    /// How long the next piece may take.
    pub(crate) fn left(&self) -> Duration {
        self.idle.saturating_sub(self.waited)
    }

    /// So many bytes came after so long.
    pub(crate) fn note(&mut self, waited: Duration, came: usize) {
        self.waited += waited;
        self.came += came;
        if self.came >= ENOUGH {
            (self.came, self.waited) = (0, Duration::ZERO);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many pieces of so many bytes, each after so many seconds, are taken, at most a thousand.
    fn pieces(bytes: usize, seconds: u64) -> usize {
        let (mut pace, pause) = (Pace::new(Duration::from_mins(1)), Duration::from_secs(seconds));
        for n in 0..1000 {
            if pause > pace.left() {
                return n;
            }
            pace.note(pause, bytes);
        }
        1000
    }

    #[test]
    fn a_trickle_is_given_up_and_a_slow_line_is_not() {
        assert_eq!(pieces(1, 7), 8, "a byte now and then");
        assert_eq!(pieces(1024, 59), 1000, "a packet a minute");
        assert_eq!(pieces(100, 5), 1000, "160 bits a second");
        assert_eq!(pieces(1024, 61), 0, "silence");
    }

    #[tokio::test]
    async fn a_body_is_passed_on_to_its_end() {
        let mut body = futures_util::stream::iter([Ok(b"ab".to_vec()), Err("broken")]);
        let mut pace = Pace::new(Duration::from_mins(1));
        assert_eq!(pace.next(&mut body).await, Ok(Some(Ok(b"ab".to_vec()))));
        assert_eq!(pace.next(&mut body).await, Ok(Some(Err("broken"))));
        assert_eq!(pace.next(&mut body).await, Ok(None));
    }
}
