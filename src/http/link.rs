//! Links between resources.

use serde::Serialize;
use utoipa::ToSchema;

/// A related resource.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub(super) struct Link {
    /// What it is to this one.
    pub rel: String,
    /// Where it is, relative to the server's root.
    pub href: String,
}

impl Link {
    pub fn new(rel: &str, href: impl Into<String>) -> Self {
        Self { rel: rel.to_owned(), href: href.into() }
    }
}
