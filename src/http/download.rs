//! Files for download: strong ETags, conditional and partial requests (RFC 9110), streamed from the blob once it is known to be
//! sound.

use std::io::{ErrorKind, SeekFrom};

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use percent_encoding::{NON_ALPHANUMERIC, utf8_percent_encode};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;
use utoipa::ToSchema;

use super::Problem;
use crate::storage::{BlobId, BlobStore, StorageError, Store, StoredBlob};

/// Bytes, in the words of OpenAPI.
#[derive(ToSchema)]
#[schema(value_type = String, format = Binary)]
#[expect(dead_code, reason = "only describes bodies that are streams of bytes")]
pub(super) struct Bytes(Vec<u8>);

/// A blob to be served.
pub(super) struct Download {
    /// The bytes; their hash is the ETag.
    pub blob: StoredBlob,
    /// Their type.
    pub media_type: &'static str,
    /// What a browser saves them as.
    pub file_name: String,
}

/// Bytes read from the file at a time.
const PIECE: usize = 128 * 1024;

/// Answers with the blob, a range of it, or that the client has it already.
pub(super) async fn serve(
    store: &Store,
    download: Download,
    headers: &HeaderMap,
) -> Result<Response, Problem> {
    let Download { blob, media_type, file_name } = download;
    let etag = format!("\"{}\"", blob.id);
    let mut response = if none_match(headers, &etag) {
        StatusCode::NOT_MODIFIED.into_response()
    } else {
        match requested_range(headers, &etag, blob.bytes) {
            Requested::Whole => body(store, &blob, 0, blob.bytes, StatusCode::OK).await?,
            Requested::Range { first, last } => {
                let mut response =
                    body(store, &blob, first, last - first + 1, StatusCode::PARTIAL_CONTENT).await?;
                let range = format!("bytes {first}-{last}/{}", blob.bytes);
                response.headers_mut().insert(header::CONTENT_RANGE, value(&range)?);
                response
            }
            Requested::Unsatisfiable => return unsatisfiable(blob.bytes),
        }
    };
    let out = response.headers_mut();
    out.insert(header::ETAG, value(&etag)?);
    out.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    if response.status() != StatusCode::NOT_MODIFIED {
        let name = utf8_percent_encode(&file_name, NON_ALPHANUMERIC);
        let out = response.headers_mut();
        out.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
        out.insert(header::CONTENT_DISPOSITION, value(&format!("inline; filename*=UTF-8''{name}"))?);
        out.insert(header::X_CONTENT_TYPE_OPTIONS, HeaderValue::from_static("nosniff"));
    }
    Ok(response)
}

/// Whether `If-None-Match` says that the client holds this ETag (by weak comparison).
pub(super) fn none_match(headers: &HeaderMap, etag: &str) -> bool {
    headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok()).any(|list| {
        list.split(',').map(str::trim).any(|tag| tag == "*" || tag.strip_prefix("W/").unwrap_or(tag) == etag)
    })
}

async fn body(
    store: &Store,
    blob: &StoredBlob,
    first: u64,
    length: u64,
    status: StatusCode,
) -> Result<Response, Problem> {
    let mut file = open(store, blob.id).await?;
    file.seek(SeekFrom::Start(first)).await.map_err(Problem::internal)?;
    let stream = ReaderStream::with_capacity(file.take(length), PIECE);
    let mut response = (status, Body::from_stream(stream)).into_response();
    response.headers_mut().insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    Ok(response)
}

/// The file of a blob that a row named a moment ago. If it is not there, the row went meanwhile and took it along, or it is lost.
async fn open(store: &Store, id: BlobId) -> Result<File, Problem> {
    match sound(&store.blobs, id).await {
        Err(StorageError::MissingBlob(_)) if !store.is_needed(id).await? => {
            Err(Problem::not_found("the file was deleted"))
        }
        found => Ok(found?),
    }
}

/// The file of a blob, once it is known to be sound.
async fn sound(blobs: &BlobStore, id: BlobId) -> Result<File, StorageError> {
    blobs.check(id).await?;
    File::open(blobs.path(id)).await.map_err(|source| match source.kind() {
        ErrorKind::NotFound => StorageError::MissingBlob(id.to_string()),
        _ => StorageError::Io { action: "opening a file for download", source },
    })
}

fn unsatisfiable(bytes: u64) -> Result<Response, Problem> {
    let detail = format!("the range lies outside the file, which has {bytes} bytes");
    let problem = Problem::new(StatusCode::RANGE_NOT_SATISFIABLE, "range-not-satisfiable", detail);
    let problem = Problem { field: Some("range".to_owned()), limit: Some(bytes), ..problem };
    let mut response = problem.into_response();
    response.headers_mut().insert(header::CONTENT_RANGE, value(&format!("bytes */{bytes}"))?);
    Ok(response)
}

fn value(text: &str) -> Result<HeaderValue, Problem> {
    HeaderValue::from_str(text).map_err(Problem::internal)
}

#[derive(Debug, PartialEq, Eq)]
enum Requested {
    Whole,
    /// Both ends included.
    Range {
        first: u64,
        last: u64,
    },
    Unsatisfiable,
}

/// What part the client asks for. A header that is malformed, in other units, or lists several ranges is ignored, as
/// RFC 9110 allows; so is one whose `If-Range` names another version of the file.
fn requested_range(headers: &HeaderMap, etag: &str, bytes: u64) -> Requested {
    if let Some(condition) = headers.get(header::IF_RANGE)
        && condition != etag
    {
        return Requested::Whole;
    }
    let range = headers.get(header::RANGE).and_then(|v| v.to_str().ok());
    let Some((first, last)) =
        range.and_then(|r| r.strip_prefix("bytes=")).and_then(|r| r.trim().split_once('-'))
    else {
        return Requested::Whole;
    };
    let number = |text: &str| if text.is_empty() { Some(None) } else { digits(text).map(Some) };
    match (number(first), number(last)) {
        (Some(Some(first)), Some(last)) if last.is_none_or(|last| first <= last) => {
            if first >= bytes {
                return Requested::Unsatisfiable;
            }
            Requested::Range { first, last: last.unwrap_or(u64::MAX).min(bytes - 1) }
        }
        (Some(None), Some(Some(suffix))) => {
            if suffix == 0 || bytes == 0 {
                return Requested::Unsatisfiable;
            }
            Requested::Range { first: bytes.saturating_sub(suffix), last: bytes - 1 }
        }
        _ => Requested::Whole,
    }
}

/// A number of digits only, as large as it may be.
fn digits(text: &str) -> Option<u64> {
    text.bytes().all(|b| b.is_ascii_digit()).then(|| text.parse().unwrap_or(u64::MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(range: &str) -> Requested {
        let mut headers = HeaderMap::new();
        headers.insert(header::RANGE, range.parse().unwrap());
        requested_range(&headers, "\"x\"", 100)
    }

    #[test]
    fn ranges_are_read_as_rfc_9110_says() {
        assert_eq!(asked("bytes=0-9"), Requested::Range { first: 0, last: 9 });
        assert_eq!(asked("bytes=90-"), Requested::Range { first: 90, last: 99 });
        assert_eq!(asked("bytes=-10"), Requested::Range { first: 90, last: 99 });
        assert_eq!(asked("bytes=-1000"), Requested::Range { first: 0, last: 99 });
        assert_eq!(asked("bytes=50-1000"), Requested::Range { first: 50, last: 99 });
        assert_eq!(asked("bytes=99-99999999999999999999999"), Requested::Range { first: 99, last: 99 });
        assert_eq!(asked("bytes=100-"), Requested::Unsatisfiable);
        assert_eq!(asked("bytes=-0"), Requested::Unsatisfiable);
        for ignored in ["bytes=9-0", "bytes=0-1,5-6", "lines=0-1", "bytes=a-b", "bytes=-", "bytes=+1-2"] {
            assert_eq!(asked(ignored), Requested::Whole, "{ignored}");
        }
    }

    #[test]
    fn if_range_with_another_etag_asks_for_the_whole() {
        let mut headers = HeaderMap::new();
        headers.insert(header::RANGE, "bytes=0-9".parse().unwrap());
        headers.insert(header::IF_RANGE, "\"old\"".parse().unwrap());
        assert_eq!(requested_range(&headers, "\"x\"", 100), Requested::Whole);
        headers.insert(header::IF_RANGE, "\"x\"".parse().unwrap());
        assert_eq!(requested_range(&headers, "\"x\"", 100), Requested::Range { first: 0, last: 9 });
    }

    #[test]
    fn if_none_match_takes_lists_weak_tags_and_the_star() {
        for (tags, held) in
            [("\"x\"", true), ("W/\"x\"", true), ("\"a\", \"x\"", true), ("*", true), ("\"y\"", false)]
        {
            let mut headers = HeaderMap::new();
            headers.insert(header::IF_NONE_MATCH, tags.parse().unwrap());
            assert_eq!(none_match(&headers, "\"x\""), held, "{tags}");
        }
    }
}
