//! A stream that gives up when its peer reads nothing, or next to nothing.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::{Instant, Sleep, sleep};

use crate::jobs::Pace;

/// A stream on which a write fails for whose peer was waited `patience` in all since it took the last kilobyte. Reading is as before: a
/// request that is being worked on is silent, and so is its connection.
pub(super) struct Patient<S> {
    stream: S,
    pace: Pace,
    alarm: Pin<Box<Sleep>>,
    /// Since when nothing can be written.
    stuck: Option<Instant>,
}

impl<S> Patient<S> {
    pub fn new(stream: S, patience: Duration) -> Self {
        Self { stream, pace: Pace::new(patience), alarm: Box::pin(sleep(patience)), stuck: None }
    }

    /// Passes on what a write came to; `taken` tells of how many bytes. If it came to nothing, the alarm is set, unless it is running.
    fn watch<T>(
        &mut self,
        cx: &mut Context<'_>,
        progress: Poll<io::Result<T>>,
        taken: impl FnOnce(&T) -> usize,
    ) -> Poll<io::Result<T>> {
        if let Poll::Ready(result) = &progress {
            let waited = self.stuck.take().map_or(Duration::ZERO, |since| since.elapsed());
            self.pace.note(waited, result.as_ref().map_or(0, taken));
            return progress;
        }
        if self.stuck.is_none() {
            let now = Instant::now();
            self.stuck = Some(now);
            self.alarm.as_mut().reset(now + self.pace.left());
        }
        ready!(self.alarm.as_mut().poll(cx));
        Poll::Ready(Err(io::Error::new(io::ErrorKind::TimedOut, "the peer does not read")))
    }
}

impl<S: AsyncRead + Unpin> AsyncRead for Patient<S> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        buf: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Patient<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let progress = Pin::new(&mut self.stream).poll_write(cx, buf);
        self.watch(cx, progress, |bytes| *bytes)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bufs: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let progress = Pin::new(&mut self.stream).poll_write_vectored(cx, bufs);
        self.watch(cx, progress, |bytes| *bytes)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let progress = Pin::new(&mut self.stream).poll_flush(cx);
        self.watch(cx, progress, |()| 0)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        let progress = Pin::new(&mut self.stream).poll_shutdown(cx);
        self.watch(cx, progress, |()| 0)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};

    use super::*;

    #[tokio::test]
    async fn a_write_waits_for_a_slow_reader_and_gives_up_on_one_that_stops() {
        let (ours, mut theirs) = duplex(4);
        let mut ours = Patient::new(ours, Duration::from_secs(2));
        let slow = tokio::spawn(async move {
            for _ in 0..4 {
                sleep(Duration::from_millis(100)).await;
                theirs.read_exact(&mut [0; 4]).await.unwrap();
            }
            // It stays connected, and reads no more.
            std::future::pending::<()>().await;
            drop(theirs);
        });
        ours.write_all(&[7; 20]).await.unwrap();
        let error = ours.write_all(&[7; 4]).await.unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::TimedOut);
        slow.abort();
    }

    /// What becomes of 8 KB for a reader who takes so many bytes every 20 ms, with a patience of a second for each kilobyte.
    async fn written(bytes: usize) -> io::Result<()> {
        let (ours, mut theirs) = duplex(64);
        let reader = tokio::spawn(async move {
            let mut piece = vec![0; bytes];
            while theirs.read_exact(&mut piece).await.is_ok() {
                sleep(Duration::from_millis(20)).await;
            }
        });
        let result = Patient::new(ours, Duration::from_secs(1)).write_all(&[7; 8192]).await;
        reader.abort();
        result
    }

    #[tokio::test]
    async fn a_reader_who_takes_a_byte_now_and_then_is_given_up() {
        assert_eq!(written(1).await.unwrap_err().kind(), io::ErrorKind::TimedOut);
        written(1024).await.unwrap();
    }
}
