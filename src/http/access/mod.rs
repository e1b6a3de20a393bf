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
mod rules;

pub use anonymous::Openness;
pub(super) use caller::Caller;
pub(super) use description::describe;
pub(super) use guard::guard;
