//! What a request hashes to: by this a request that comes again is known.

use std::pin::Pin;
use std::sync::{Arc, Mutex, PoisonError};
use std::task::{Context, Poll};

use axum::body::{Body, HttpBody};
use axum::extract::Request;
use bytes::Bytes;
use http_body::{Frame, SizeHint};

/// Headers that say what is asked for. Others, such as those of proxies, may differ from one try to the next.
const HEADERS: [&str; 4] = ["content-type", "content-digest", "upload-length", "upload-metadata"];

/// The hash of everything but the body, to be continued with that.
pub(super) fn of_head(request: &Request) -> blake3::Hasher {
    let mut hasher = blake3::Hasher::new();
    // Each part has its length before it, so that no two heads are the same bytes.
    let mut add = |part: &[u8]| {
        hasher.update(&(part.len() as u64).to_le_bytes()).update(part);
    };
    add(request.method().as_str().as_bytes());
    add(request.uri().path().as_bytes());
    add(request.uri().query().unwrap_or("").as_bytes());
    for name in HEADERS {
        let values = request.headers().get_all(name);
        add(&values.iter().count().to_le_bytes());
        values.iter().for_each(|value| add(value.as_bytes()));
    }
    hasher
}

/// A body that is hashed while it is read.
pub(super) struct Hashing {
    inner: Body,
    seen: Arc<Mutex<Seen>>,
}

struct Seen {
    hasher: blake3::Hasher,
    ended: bool,
}

/// The hash of a body that somebody else reads.
#[derive(Clone)]
pub(super) struct HashOf(Arc<Mutex<Seen>>);

impl HashOf {
    /// The hash, if the body was read to its end.
    pub fn whole(&self) -> Option<[u8; 32]> {
        let seen = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        seen.ended.then(|| *seen.hasher.finalize().as_bytes())
    }
}

impl Hashing {
    pub fn new(hasher: blake3::Hasher, inner: Body) -> (Self, HashOf) {
        let seen = Arc::new(Mutex::new(Seen { hasher, ended: inner.is_end_stream() }));
        (Self { inner, seen: Arc::clone(&seen) }, HashOf(seen))
    }
}

impl HttpBody for Hashing {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = self.get_mut();
        let frame = Pin::new(&mut this.inner).poll_frame(cx);
        let mut seen = this.seen.lock().unwrap_or_else(PoisonError::into_inner);
        match &frame {
            Poll::Ready(Some(Ok(frame))) => {
                if let Some(piece) = frame.data_ref() {
                    seen.hasher.update(piece);
                }
                seen.ended = this.inner.is_end_stream();
            }
            Poll::Ready(None) => seen.ended = true,
            _ => {}
        }
        drop(seen);
        frame
    }

    fn is_end_stream(&self) -> bool {
        self.inner.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.inner.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{StreamExt, stream};

    use super::*;

    fn head(uri: &str, body: &'static str) -> Request {
        Request::builder().method("POST").uri(uri).body(Body::from(body)).unwrap()
    }

    #[tokio::test]
    async fn the_hash_is_known_once_the_body_was_read_however_it_was_cut() {
        let pieces = stream::iter(["a", "bc"].map(|p| Ok::<_, std::io::Error>(Bytes::from(p))));
        let (body, hash) = Hashing::new(of_head(&head("/x", "")), Body::from_stream(pieces));
        let mut body = Body::new(body).into_data_stream();
        body.next().await.unwrap().unwrap();
        assert_eq!(hash.whole(), None);
        while body.next().await.is_some() {}
        let mut expected = of_head(&head("/x", ""));
        expected.update(b"abc");
        assert_eq!(hash.whole(), Some(*expected.finalize().as_bytes()));
    }

    #[test]
    fn addresses_and_headers_that_say_what_is_asked_for_count() {
        let of = |request: Request| of_head(&request).finalize();
        assert_ne!(of(head("/x?a=1", "")), of(head("/x?a=2", "")));
        assert_ne!(of(head("/xa", "")), of(head("/x?a", "")));
        let mut typed = head("/x", "");
        typed.headers_mut().insert("content-type", "text/plain".parse().unwrap());
        assert_ne!(of(typed), of(head("/x", "")));
        let mut traced = head("/x", "");
        traced.headers_mut().insert("x-forwarded-for", "10.0.0.1".parse().unwrap());
        assert_eq!(of(traced), of(head("/x", "")));
    }
}
