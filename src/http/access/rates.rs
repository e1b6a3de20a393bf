//! How often one address may ask, and how often with a key that opens nothing.
//!
//! A key is 256 random bits, so nobody guesses one: the second limit quiets rigs whose key has expired. It stops only what fails, so
//! that such a rig does not lock out its neighbours behind the same address.

use std::num::NonZeroU16;
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::extract::{Request, State};
use axum::http::StatusCode;
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::buckets::Buckets;
use super::sender::{Peer, Proxies, Source};
use crate::http::{Api, Problem};

/// How much one address may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RateLimits {
    /// Requests a second, ten seconds' worth of them at once; 0: any number.
    pub requests_per_second: u32,
    /// Requests a minute with keys that open nothing, a minute's worth at once; 0: any number.
    pub failures_per_minute: u32,
}

/// For how long requests may be saved up.
const BURST: Duration = Duration::from_secs(10);
const MINUTE: Duration = Duration::from_mins(1);

/// Who asked how often. Clones share it.
#[derive(Debug, Clone)]
pub struct Rates {
    proxies: Proxies,
    requests: Option<Arc<Buckets>>,
    failures: Option<Arc<Buckets>>,
}

impl Rates {
    /// Nobody has asked yet.
    #[must_use]
    pub fn new(limits: RateLimits, proxies: Proxies) -> Self {
        let buckets = |most: u32, span| (most > 0).then(|| Arc::new(Buckets::new(most, span)));
        let saved_up = limits.requests_per_second.saturating_mul(BURST.as_secs() as u32);
        Self {
            proxies,
            requests: buckets(saved_up, BURST),
            failures: buckets(limits.failures_per_minute, MINUTE),
        }
    }

    /// Counts a request with a key that opens nothing, and says so if there are too many.
    pub(super) fn count_failure(&self, source: Source) -> Result<(), Problem> {
        let taken = self.failures.as_ref().map_or(Ok(()), |failures| failures.take(source, Instant::now()));
        taken.map_err(|wait| {
            let detail = format!("too many requests come from {source} with keys that open nothing");
            refusal("too-many-failures", detail, wait)
        })
    }
}

/// Lets a request through unless its address has asked too often, and notes which address that is.
pub(in crate::http) async fn pace(State(api): State<Api>, mut request: Request, next: Next) -> Response {
    let rates = &api.access.rates;
    if let Some(Peer(peer)) = request.extensions().get::<Peer>().copied() {
        let source = Source::of(rates.proxies.sender(peer, request.headers()));
        if let Some(requests) = &rates.requests
            && let Err(wait) = requests.take(source, Instant::now())
        {
            tracing::debug!(%source, "an address asks too often");
            let detail = format!("too many requests come from {source}");
            return refusal("too-many-requests", detail, wait).into_response();
        }
        request.extensions_mut().insert(source);
    }
    next.run(request).await
}

fn refusal(word: &str, detail: String, wait: Duration) -> Problem {
    let seconds = u16::try_from(wait.as_millis().div_ceil(1000)).unwrap_or(u16::MAX);
    Problem {
        retry_after: NonZeroU16::new(seconds.max(1)),
        ..Problem::new(StatusCode::TOO_MANY_REQUESTS, word, detail)
    }
}
