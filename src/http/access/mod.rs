//! Who may do what: one layer around every route, so that a new route is closed until a rule opens it.
//!
//! [`guard`] runs after routing and before the handler. It finds the rule of the route (`rules`), the key that the
//! request shows, and the project that the address is about, and refuses or hands the handler a [`Caller`]. What a key
//! does not reach is answered exactly as what does not exist. Before it, [`pace`] refuses addresses that ask too often. `description` writes the same rules into the OpenAPI
//! description. Uses the keys of `storage`.

mod anonymous;
mod buckets;
mod caller;
mod description;
mod guard;
mod load;
mod rates;
mod rules;
mod sender;

use std::sync::Arc;

use axum::http::HeaderValue;

pub use anonymous::Openness;
pub(super) use caller::Caller;
pub(super) use description::describe;
pub(super) use guard::guard;
pub use load::LoadLimits;
pub(super) use load::{has_space, shed};
pub(super) use rates::pace;
pub use rates::{RateLimits, Rates};
pub use sender::{Network, Proxies};
pub(super) use sender::{Peer, Source};

/// Who is let in, and when nobody is.
#[derive(Debug, Clone)]
pub struct Access {
    /// Whether requests without a key are served.
    pub openness: Openness,
    /// Origins of other sites whose pages may use the API.
    pub origins: Arc<[HeaderValue]>,
    /// When no more work is taken on.
    pub load: LoadLimits,
    /// How often each address may ask.
    pub rates: Rates,
}
