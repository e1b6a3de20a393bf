//! One writer an upload at a time, and the newest request wins: whoever comes asks the one who is there to leave.
//!
//! A client whose connection broke comes back before the service has noticed that the old connection is dead. If the old
//! request kept the upload until it fell silent for long enough, the client would be locked out that long.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::OwnedMutexGuard;
use tokio_util::sync::CancellationToken;

use crate::project::UploadId;

/// Who writes to which upload. Clones share it.
#[derive(Debug, Clone, Default)]
pub(super) struct Turnstile {
    seats: Arc<Mutex<HashMap<UploadId, Seat>>>,
}

#[derive(Debug, Default)]
struct Seat {
    lock: Arc<tokio::sync::Mutex<()>>,
    /// Asks the holder to leave.
    leave: CancellationToken,
    /// Holder and those who wait; the seat is taken away with the last of them.
    people: usize,
}

/// The right to write to an upload, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    /// Cancelled when somebody else wants the upload.
    pub leave: CancellationToken,
    _guard: OwnedMutexGuard<()>,
    _presence: Presence,
}

#[derive(Debug)]
struct Presence {
    turnstile: Turnstile,
    id: UploadId,
}

impl Turnstile {
    fn seats(&self) -> MutexGuard<'_, HashMap<UploadId, Seat>> {
        self.seats.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Asks who holds the upload to leave, and waits for that. `None` if they do not within `patience`.
    pub async fn take(&self, id: UploadId, patience: Duration) -> Option<Turn> {
        let lock = {
            let mut seats = self.seats();
            let seat = seats.entry(id).or_default();
            seat.people += 1;
            seat.leave.cancel();
            Arc::clone(&seat.lock)
        };
        let presence = Presence { turnstile: self.clone(), id };
        let guard = tokio::time::timeout(patience, lock.lock_owned()).await.ok()?;
        let leave = CancellationToken::new();
        if let Some(seat) = self.seats().get_mut(&id) {
            seat.leave = leave.clone();
            // Others came while this one waited: it may look, but not stay.
            if seat.people > 1 {
                leave.cancel();
            }
        }
        Some(Turn { leave, _guard: guard, _presence: presence })
    }
}

impl Drop for Presence {
    fn drop(&mut self) {
        let mut seats = self.turnstile.seats();
        if let Some(seat) = seats.get_mut(&self.id) {
            seat.people -= 1;
            if seat.people == 0 {
                seats.remove(&self.id);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn who_comes_later_is_let_in_when_the_one_before_has_left_as_asked() {
        let turnstile = Turnstile::default();
        let (id, patience) = (UploadId::generate(), Duration::from_mins(1));
        let first = turnstile.take(id, patience).await.unwrap();
        assert!(!first.leave.is_cancelled());
        let second = tokio::spawn({
            let turnstile = turnstile.clone();
            async move { turnstile.take(id, patience).await.unwrap() }
        });
        first.leave.cancelled().await;
        assert!(turnstile.take(UploadId::generate(), patience).await.is_some(), "others are not concerned");
        drop(first);
        let second = second.await.unwrap();
        assert!(!second.leave.is_cancelled());
        drop(second);
        assert!(turnstile.seats().is_empty());
    }

    #[tokio::test]
    async fn patience_ends_while_somebody_stays() {
        let turnstile = Turnstile::default();
        let id = UploadId::generate();
        let first = turnstile.take(id, Duration::ZERO).await.unwrap();
        assert!(turnstile.take(id, Duration::ZERO).await.is_none());
        drop(first);
        assert!(turnstile.seats().is_empty());
    }
}
