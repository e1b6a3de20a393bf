//! The headers of the protocol: reading those of requests, writing those of answers.

use axum::http::{HeaderMap, HeaderName, HeaderValue, header};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use crate::http::Problem;
use crate::http::content_digest::content_digest;
use crate::jobs::{Continuation, DigestAlgorithm, ExpectedDigest};
use crate::project::Upload;

/// The type of bodies that continue an upload.
pub(super) const BYTES: &str = "application/offset+octet-stream";

/// The text of a header that may be there once.
pub(super) fn text<'a>(headers: &'a HeaderMap, name: &str) -> Result<Option<&'a str>, Problem> {
    let mut values = headers.get_all(name).iter();
    let first = values.next();
    if values.next().is_some() {
        return Err(Problem::invalid(name, format!("`{name}` is given twice")));
    }
    let not_ascii = |_| Problem::invalid(name, format!("`{name}` is not ASCII"));
    first.map(|value| value.to_str().map_err(not_ascii)).transpose()
}

/// The number of bytes that a header tells: digits alone.
pub(super) fn bytes(headers: &HeaderMap, name: &str) -> Result<Option<u64>, Problem> {
    let Some(text) = text(headers, name)? else { return Ok(None) };
    // More than this is more than any file has, and more than the database holds.
    let digits = Some(text).filter(|t| t.bytes().all(|b| b.is_ascii_digit()));
    let number = digits.and_then(|t| t.parse::<i64>().ok()).map(i64::cast_unsigned);
    number.map(Some).ok_or_else(|| {
        let text: String = text.chars().take(40).collect();
        Problem::invalid(name, format!("`{name}` is `{text}`; it must be a number of bytes"))
    })
}

/// Whether the body is bytes of an upload.
pub(super) fn brings_bytes(headers: &HeaderMap) -> bool {
    headers.get(header::CONTENT_TYPE).is_some_and(|t| t.as_bytes().eq_ignore_ascii_case(BYTES.as_bytes()))
}

/// What the headers say about a body that continues an upload at `offset`.
pub(super) fn continuation(headers: &HeaderMap, offset: u64) -> Result<Continuation, Problem> {
    let mut digests = content_digest(headers)?;
    if let Some(checksum) = text(headers, "upload-checksum")? {
        digests.push(parse_checksum(checksum)?);
    }
    let declared =
        headers.get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()).and_then(|t| t.parse().ok());
    Ok(Continuation { offset, declared, digests })
}

/// Reads the value of an `Upload-Checksum` header: the name of a hash function, a space, and base64.
///
/// # Errors
/// A problem that says what is wrong with it.
pub fn parse_checksum(text: &str) -> Result<ExpectedDigest, Problem> {
    let invalid = |detail: String| Problem::invalid("upload-checksum", detail);
    let (name, value) = text.split_once(' ').unwrap_or((text, ""));
    let algorithm = match name {
        "sha1" => DigestAlgorithm::Sha1,
        "sha256" => DigestAlgorithm::Sha256,
        "sha512" => DigestAlgorithm::Sha512,
        other => {
            let other: String = other.chars().take(40).collect();
            return Err(invalid(format!(
                "the hash function `{other}` is not known; sha1, sha256 and sha512 are"
            )));
        }
    };
    match STANDARD.decode(value.trim()) {
        Ok(value) if value.len() == algorithm.bytes() => Ok(ExpectedDigest { algorithm, value }),
        _ => Err(invalid(format!("the checksum must be {} bytes in base64", algorithm.bytes()))),
    }
}

/// Where an upload stands, and which scan it became.
pub(super) fn standing(upload: &Upload) -> Result<HeaderMap, Problem> {
    let mut headers = HeaderMap::new();
    let mut put = |name: &'static str, value: String| {
        let value = HeaderValue::from_str(&value).map_err(Problem::internal)?;
        headers.insert(HeaderName::from_static(name), value);
        Ok::<_, Problem>(())
    };
    put("upload-offset", upload.received.to_string())?;
    match upload.end {
        None => {
            let since = std::time::Duration::from_millis(u64::try_from(upload.expires.0).unwrap_or(0));
            put("upload-expires", httpdate::fmt_http_date(std::time::UNIX_EPOCH + since))?;
        }
        Some(end) => {
            put("cairn-scan", format!("/v1/projects/{}/scans/{}", upload.announced.project, end.scan))?;
            put("cairn-job", format!("/v1/jobs/{}", end.job))?;
            put("cairn-duplicate", end.duplicate.to_string())?;
        }
    }
    Ok(headers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_of_bytes_are_digits_alone() {
        let read = |text: &str| {
            let mut headers = HeaderMap::new();
            headers.insert("upload-offset", HeaderValue::from_str(text).unwrap());
            bytes(&headers, "upload-offset")
        };
        assert_eq!(read("0").unwrap(), Some(0));
        assert_eq!(read("9223372036854775807").unwrap(), Some(i64::MAX as u64));
        for bad in ["", "-1", "+1", "1.5", " 1", "0x10", "9223372036854775808", "99999999999999999999"] {
            assert!(read(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn a_checksum_has_a_known_function_and_its_length() {
        let checksum = parse_checksum("sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=").unwrap();
        assert_eq!((checksum.algorithm, checksum.value.len()), (DigestAlgorithm::Sha1, 20));
        for bad in
            ["", "sha1", "sha1 AAAA", "crc32 AAAAAA==", "sha256 Kq5sNclPz7QV2+lfQIuc6R7oRu0=", "sha1 ä"]
        {
            assert!(parse_checksum(bad).is_err(), "{bad}");
        }
    }
}
