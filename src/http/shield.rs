//! What browsers are told: which other sites may use the API (none, unless the operator lists them), and headers that
//! keep an answer from being taken for something else.

use std::time::Duration;

use axum::extract::Request;
use axum::http::{HeaderName, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::Response;
use tower_http::cors::{AllowHeaders, AllowMethods, CorsLayer, ExposeHeaders};

/// Headers of answers that are not from the page: they are data, never a document.
const DEFAULTS: [(HeaderName, &str); 4] = [
    (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
    (header::REFERRER_POLICY, "no-referrer"),
    (header::CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'"),
    (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
];

/// Headers of answers that a page of another site needs to see, beside those that it always may.
const EXPOSED: [&str; 19] = [
    "location",
    "etag",
    "retry-after",
    "content-range",
    "accept-ranges",
    "content-disposition",
    "www-authenticate",
    "x-request-id",
    "tus-resumable",
    "tus-version",
    "tus-extension",
    "tus-max-size",
    "upload-offset",
    "upload-length",
    "upload-metadata",
    "upload-expires",
    "cairn-scan",
    "cairn-job",
    "cairn-duplicate",
];

/// Adds the headers that an answer does not have yet.
pub(super) async fn harden(request: Request, next: Next) -> Response {
    let mut response = next.run(request).await;
    for (name, value) in DEFAULTS {
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
    }
    response
}

/// Lets pages of these origins use the API, with a key that they bring: no cookie ever counts here. Without origins, answers say
/// nothing about other sites, and OPTIONS is a method like any other.
pub(super) fn cors(origins: &[HeaderValue]) -> Option<CorsLayer> {
    let layer = CorsLayer::new()
        .allow_origin(origins.to_vec())
        .allow_methods(AllowMethods::list([
            Method::GET,
            Method::HEAD,
            Method::POST,
            Method::PUT,
            Method::PATCH,
            Method::DELETE,
        ]))
        .allow_headers(AllowHeaders::mirror_request())
        .expose_headers(ExposeHeaders::list(EXPOSED.map(HeaderName::from_static)))
        .max_age(Duration::from_mins(10));
    Some(layer).filter(|_| !origins.is_empty())
}
