//! Who may do what: one layer around every route, so that a new route is closed until a rule opens it.
//!
//! [`guard`] runs after routing and before the handler. It finds the rule of the route (`rules`), the key that the
//! request shows, and the project that the address is about, and refuses or hands the handler a [`Caller`]. What a key
//! does not reach is answered exactly as what does not exist. `description` writes the same rules into the OpenAPI
//! description. Uses the keys of `storage`.

mod anonymous;
mod caller;
mod description;
mod guard;
mod load;
mod rules;

use std::sync::Arc;

use axum::http::HeaderValue;

pub use anonymous::Openness;
pub(super) use caller::Caller;
pub(super) use description::describe;
pub(super) use guard::guard;
pub use load::LoadLimits;
pub(super) use load::{has_space, shed};

/// Who is let in, and when nobody is.
#[derive(Debug, Clone)]
pub struct Access {
    /// Whether requests without a key are served.
    pub openness: Openness,
    /// Origins of other sites whose pages may use the API.
    pub origins: Arc<[HeaderValue]>,
    /// When no more work is taken on.
    pub load: LoadLimits,
}
