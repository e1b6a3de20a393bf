//! Why settings are refused.

use std::path::PathBuf;

/// Why settings are refused.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{file}: {source}")]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not TOML, or has a setting that does not exist.
    #[error("{file}: {source}")]
    Malformed {
        /// The file.
        file: PathBuf,
        /// Where and why.
        source: toml::de::Error,
    },
    /// A certificate without its key, or the other way round.
    #[error("tls-cert and tls-key only make sense together")]
    HalfTls,
    /// An item of a list that cannot be read.
    #[error("{setting}: `{item}`: {why}")]
    BadItem {
        /// Which setting.
        setting: &'static str,
        /// The item.
        item: String,
        /// What is wrong with it.
        why: String,
    },
    /// No origin of pages.
    #[error("`{0}` is no origin: it must be such as https://viewer.example:8443, without a path")]
    NoOrigin(String),
    /// A number that makes no sense.
    #[error("{setting} is {value}; it must be between {least} and {most}")]
    OutOfRange {
        /// Which setting.
        setting: &'static str,
        /// What it is.
        value: u64,
        /// The least.
        least: u64,
        /// The most.
        most: u64,
    },
}
