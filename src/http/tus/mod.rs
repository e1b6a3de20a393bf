//! `/v1/uploads`: resumable uploads by the protocol tus 1.0 (<https://tus.io/protocols/resumable-upload>), with the
//! extensions creation, creation-with-upload, checksum, expiration and termination.
//!
//! An upload is announced with the parameters of a direct one, and ends as the scan that a direct one would be. Uses
//! [`crate::jobs::Resumable`].

mod append;
mod create;
mod headers;
mod metadata;
mod overridden;
mod problem;
mod show;
mod version;

use axum::middleware::map_response;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::router::Api;

pub use headers::parse_checksum;
pub use metadata::{Metadata, parse_metadata};
pub(super) use overridden::meant;

/// The routes of the protocol.
pub(super) fn routes() -> OpenApiRouter<Api> {
    OpenApiRouter::new()
        .routes(routes!(create::create_upload, version::describe_uploads))
        .routes(routes!(
            show::get_upload,
            show::head_upload,
            append::continue_upload,
            show::terminate_upload,
            overridden::post_upload,
            version::describe_upload
        ))
        .layer(map_response(version::speak))
        .routes(routes!(show::list_uploads))
}
