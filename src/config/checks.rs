//! Reading and checking single settings.

use std::fmt::Display;
use std::path::PathBuf;
use std::str::FromStr;

use axum::http::HeaderValue;
use axum::http::uri::Authority;

use super::ConfigError;

/// Certificate and key, or neither.
pub(super) fn both(
    certificate: Option<PathBuf>,
    key: Option<PathBuf>,
) -> Result<Option<(PathBuf, PathBuf)>, ConfigError> {
    match (certificate, key) {
        (Some(certificate), Some(key)) => Ok(Some((certificate, key))),
        (None, None) => Ok(None),
        _ => Err(ConfigError::HalfTls),
    }
}

/// The items of a list.
pub(super) fn listed<T: FromStr<Err: Display>>(
    setting: &'static str,
    items: Option<Vec<String>>,
) -> Result<Vec<T>, ConfigError> {
    let read = |item: String| {
        item.trim().parse().map_err(|why: T::Err| ConfigError::BadItem {
            setting,
            why: why.to_string(),
            item,
        })
    };
    items.unwrap_or_default().into_iter().map(read).collect()
}

/// Reads an origin as browsers send it: scheme, host, and the port unless it is the scheme's own.
pub(super) fn origin(text: &str) -> Result<HeaderValue, ConfigError> {
    let bad = || ConfigError::NoOrigin(text.to_owned());
    let text = text.trim().trim_end_matches('/').to_ascii_lowercase();
    let (scheme, host) = text.split_once("://").ok_or_else(bad)?;
    host.parse::<Authority>().ok().filter(|a| !a.as_str().contains('@')).ok_or_else(bad)?;
    if !matches!(scheme, "http" | "https") {
        return Err(bad());
    }
    HeaderValue::from_str(&text).map_err(|_| bad())
}

/// A number that makes sense.
pub(super) fn within(setting: &'static str, value: u64, least: u64, most: u64) -> Result<u64, ConfigError> {
    if (least..=most).contains(&value) {
        Ok(value)
    } else {
        Err(ConfigError::OutOfRange { setting, value, least, most })
    }
}

/// How often something may happen; 0 is any number of times.
pub(super) fn rate(setting: &'static str, value: u64) -> Result<u32, ConfigError> {
    Ok(within(setting, value, 0, 1_000_000)? as u32)
}
