//! Answers that are kept together with what they tell of.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use axum::http::{HeaderName, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use super::KEPT;
use super::hashing::HashOf;
use crate::http::Problem;
use crate::project::Timestamp;
use crate::storage::{Answer, Receipt, Seal};

/// The key of a request, if it has one. A handler that does something takes it as an argument, and has the answer kept in the same
/// transaction: if the process dies afterwards, the request that comes again is answered and not done again.
#[derive(Clone, Default)]
pub(in crate::http) struct Once(Option<Arc<Ticket>>);

struct Ticket {
    scope: String,
    key: String,
    hash: HashOf,
    sealed: AtomicBool,
}

impl Once {
    /// For a request with this key, whose hash is known when it was read.
    pub(super) fn new(scope: &str, key: &str, hash: HashOf) -> Self {
        let sealed = AtomicBool::new(false);
        Self(Some(Arc::new(Ticket { scope: scope.to_owned(), key: key.to_owned(), hash, sealed })))
    }

    /// Has the answer kept that `answer` makes of what is done. Nothing is kept for a request without a key, or one that was not read
    /// to its end.
    pub fn seal<'a, T: ?Sized>(
        &self,
        answer: impl Fn(&T) -> Result<Reply, Problem> + Send + Sync + 'a,
    ) -> Seal<'a, T> {
        let Some(ticket) = &self.0 else { return Seal::none() };
        let Some(request) = ticket.hash.whole() else { return Seal::none() };
        ticket.sealed.store(true, Ordering::Relaxed);
        let receipt = receipt(&ticket.scope, &ticket.key, request);
        Seal::new(receipt, move |done| answer(done).ok().map(Answer::from))
    }

    /// Whether the answer has been kept, if what was asked for was done.
    pub(super) fn is_sealed(&self) -> bool {
        self.0.as_ref().is_some_and(|ticket| ticket.sealed.load(Ordering::Relaxed))
    }
}

/// Where an answer is kept that is given now.
pub(super) fn receipt(scope: &str, key: &str, request: [u8; 32]) -> Receipt {
    let expires = Timestamp::now().plus(KEPT);
    Receipt { scope: scope.to_owned(), key: key.to_owned(), request, expires }
}

impl<S: Sync> FromRequestParts<S> for Once {
    type Rejection = std::convert::Infallible;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Self::Rejection> {
        Ok(parts.extensions.get::<Self>().cloned().unwrap_or_default())
    }
}

/// An answer that can be given and kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::http) struct Reply {
    status: StatusCode,
    headers: Vec<(HeaderName, String)>,
    body: Vec<u8>,
}

impl Reply {
    /// An answer about something that was made: where it is, with further headers.
    pub fn made(status: StatusCode, location: String, more: &[(HeaderName, &str)]) -> Self {
        let more = more.iter().map(|(name, value)| (name.clone(), (*value).to_owned()));
        let headers = std::iter::once((header::LOCATION, location)).chain(more).collect();
        Self { status, headers, body: Vec::new() }
    }

    /// The same with a JSON body.
    pub fn json(mut self, body: &impl Serialize) -> Result<Self, Problem> {
        self.body = serde_json::to_vec(body).map_err(Problem::internal)?;
        self.headers.push((header::CONTENT_TYPE, "application/json".to_owned()));
        Ok(self)
    }
}

impl From<Reply> for Answer {
    fn from(reply: Reply) -> Self {
        let headers = reply.headers.into_iter().map(|(name, value)| (name.as_str().to_owned(), value));
        Self { status: reply.status.as_u16(), headers: headers.collect(), body: reply.body }
    }
}

impl IntoResponse for Reply {
    fn into_response(self) -> Response {
        super::given(self.into()).unwrap_or_else(IntoResponse::into_response)
    }
}
