//! The header itself.

use axum::extract::Request;
use axum::http::Method;

use crate::http::Problem;

pub(super) const FIELD: &str = "idempotency-key";
/// The longest key, characters.
const MAX_CHARS: usize = 255;

/// The key of a POST, if it has one. A POST that stands for another method does what that method does, with or without
/// a key.
pub(super) fn key(request: &Request) -> Result<Option<String>, Problem> {
    let headers = request.headers();
    if request.method() != Method::POST || headers.contains_key("x-http-method-override") {
        return Ok(None);
    }
    let mut values = headers.get_all(FIELD).iter();
    let Some(value) = values.next() else { return Ok(None) };
    if values.next().is_some() {
        return Err(Problem::invalid(FIELD, format!("`{FIELD}` is given twice")));
    }
    parse(value.as_bytes()).map(Some)
}

/// A key is opaque. It may be in quotes, as a string of RFC 8941 is.
fn parse(bytes: &[u8]) -> Result<String, Problem> {
    let bytes = bytes.trim_ascii();
    let bytes = bytes.strip_prefix(b"\"").and_then(|b| b.strip_suffix(b"\"")).unwrap_or(bytes);
    let fits = (1..=MAX_CHARS).contains(&bytes.len()) && bytes.iter().all(u8::is_ascii_graphic);
    match std::str::from_utf8(bytes) {
        Ok(key) if fits => Ok(key.to_owned()),
        _ => {
            let detail =
                format!("`{FIELD}` must be 1 to {MAX_CHARS} visible ASCII characters, such as a UUID");
            Err(Problem::invalid(FIELD, detail))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_are_visible_characters_with_or_without_quotes() {
        assert_eq!(parse(b"8e03978e-40d5").unwrap(), "8e03978e-40d5");
        assert_eq!(parse(b" \"8e03978e-40d5\" ").unwrap(), "8e03978e-40d5");
        for bad in [&b""[..], b"\"\"", b"a b", b"\xff", b"a\tb", &[b'x'; 256]] {
            assert_eq!(parse(bad).unwrap_err().field.as_deref(), Some(FIELD), "{bad:?}");
        }
    }
}
