//! `Content-Digest` (RFC 9530): what the body of a request hashes to, as its client says.

use axum::http::HeaderMap;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;

use super::Problem;
use crate::jobs::{DigestAlgorithm, ExpectedDigest};

const FIELD: &str = "content-digest";

/// The digests of a request that can be checked here, none if it has no such header. Algorithms that are unknown or
/// deprecated are passed over as RFC 9530 asks, but a client that gives only such would believe that something was
/// checked: it is refused.
pub(super) fn content_digest(headers: &HeaderMap) -> Result<Vec<ExpectedDigest>, Problem> {
    let mut text = String::new();
    for value in headers.get_all(FIELD) {
        let value = value.to_str().map_err(|_| Problem::invalid(FIELD, "`content-digest` is not ASCII"))?;
        if !text.is_empty() {
            text.push(',');
        }
        text.push_str(value);
    }
    if text.is_empty() { Ok(Vec::new()) } else { parse_content_digest(&text) }
}

/// Reads the value of a `Content-Digest` header: a dictionary of byte sequences (RFC 8941), such as
/// `sha-256=:RBNvo1WzZ4oRRq0W9+hknpT7T8If536DEMBg9hyq/4o=:`.
///
/// # Errors
/// A problem that says which member is wrong, or that none is of a kind that is checked here.
pub fn parse_content_digest(text: &str) -> Result<Vec<ExpectedDigest>, Problem> {
    let mut known: Vec<ExpectedDigest> = Vec::new();
    for member in text.split(',').map(str::trim) {
        let shown: String = member.chars().take(40).collect();
        let malformed = || {
            let expected = "it must be an algorithm and base64 between colons, such as sha-256=:…:";
            Problem::invalid(FIELD, format!("`{shown}` cannot be read; {expected}"))
        };
        let (name, value) = member.split_once('=').ok_or_else(malformed)?;
        let value = value.strip_prefix(':').and_then(|v| v.strip_suffix(':')).ok_or_else(malformed)?;
        let value = STANDARD.decode(value).map_err(|_| malformed())?;
        let algorithm = match name {
            "sha-256" => DigestAlgorithm::Sha256,
            "sha-512" => DigestAlgorithm::Sha512,
            _ => continue,
        };
        if value.len() != algorithm.bytes() {
            let (found, expected) = (value.len(), algorithm.bytes());
            let detail = format!("`{name}` has {found} bytes, but results of {algorithm} have {expected}");
            return Err(Problem::invalid(FIELD, detail));
        }
        // A key that occurs twice: the last one counts (RFC 8941, 3.2).
        known.retain(|digest| digest.algorithm != algorithm);
        known.push(ExpectedDigest { algorithm, value });
    }
    if known.is_empty() {
        return Err(Problem::invalid(
            FIELD,
            "no digest is of a kind that is checked here: sha-256 or sha-512",
        ));
    }
    Ok(known)
}

#[cfg(test)]
mod tests {
    use super::*;

    const EMPTY: &str = "47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=";

    #[test]
    fn known_digests_are_read_and_unknown_ones_passed_over() {
        let digests = parse_content_digest(&format!("unixsum=:AAAA:, sha-256=:{EMPTY}:")).unwrap();
        assert_eq!((digests.len(), digests[0].algorithm), (1, DigestAlgorithm::Sha256));
        assert_eq!(digests[0].value[..4], [0xe3, 0xb0, 0xc4, 0x42]);
    }

    #[test]
    fn what_cannot_be_checked_is_refused() {
        for text in
            ["", "sha-256", "sha-256=abc", "sha-256=:a:", "sha-256=:AAAA:", "md5=:AAAA:", ",", "sha-256=:"]
        {
            assert_eq!(parse_content_digest(text).unwrap_err().field.as_deref(), Some(FIELD), "{text}");
        }
    }
}
