//! The REST interface: one file per resource, each with its handlers, their DTOs and their OpenAPI words.
//!
//! Uses `project`, `storage` and the entrances of `jobs`; `app` serves the router. Handlers parse, make one call, and
//! answer; every error is problem+json ([`Problem`]).

mod access;
mod aside;
mod cloud;
mod content_digest;
mod decision;
mod download;
mod events;
mod extract;
mod graph;
mod hang_up;
mod health;
mod idempotency;
mod job;
mod link;
mod listen;
mod metrics;
mod model;
mod open_join;
mod page;
mod pose;
mod preview;
mod problem;
mod project;
mod query;
mod readiness;
mod reading;
mod router;
mod scan;
mod shield;
mod tus;
mod upload;
mod webhook;

pub use access::{Access, LoadLimits, Network, Openness, Proxies, RateLimits, Rates};
pub use content_digest::parse_content_digest;
pub use listen::{Certificates, ConnectionLimits, Entrance, TlsError, serve};
pub use metrics::Metrics;
pub use problem::Problem;
pub use readiness::Readiness;
pub use reading::Readings;
pub use router::{Api, description, openapi_yaml, router};
pub use tus::{Metadata, parse_checksum, parse_metadata};
