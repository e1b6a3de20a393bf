//! Refusals before the body was read. The server cannot use such a connection again, and a client that is not told sends its next request
//! into one that is being closed. Used by the router.

use axum::extract::Request;
use axum::http::{HeaderValue, Version, header};
use axum::middleware::Next;
use axum::response::Response;

/// Bodies up to this many bytes have arrived with the head of the request, about: they are read even if nobody wants them.
const SMALL_BODY: u64 = 4 * 1024;

/// Tells clients of HTTP/1 to open another connection after a refused request with a large body.
pub(super) async fn hang_up(request: Request, next: Next) -> Response {
    let length = request.headers().get(header::CONTENT_LENGTH);
    let length: Option<u64> = length.and_then(|v| v.to_str().ok()).and_then(|v| v.parse().ok());
    let large = length.map_or_else(
        || request.headers().contains_key(header::TRANSFER_ENCODING),
        |bytes| bytes > SMALL_BODY,
    );
    let reusable = !large || request.version() > Version::HTTP_11;
    let mut response = next.run(request).await;
    if !reusable && (response.status().is_client_error() || response.status().is_server_error()) {
        response.headers_mut().insert(header::CONNECTION, HeaderValue::from_static("close"));
    }
    response
}
