//! Ids that cannot be confused with one another: a [`ScanId`] is no [`JobId`].

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};
use ulid::Ulid;

/// The text is no id: ids are ULIDs, 26 characters of Crockford's base 32.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{0}` is no id: ids are 26 characters of base 32")]
pub struct BadId(pub String);

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub Ulid);

        impl $name {
            /// A new id; later ones sort after earlier ones, to the millisecond.
            #[must_use]
            pub fn generate() -> Self {
                Self(Ulid::generate())
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                self.0.fmt(f)
            }
        }

        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, "{}({})", stringify!($name), self.0)
            }
        }

        impl FromStr for $name {
            type Err = BadId;

            fn from_str(text: &str) -> Result<Self, BadId> {
                text.parse().map(Self).map_err(|_| BadId(text.chars().take(40).collect()))
            }
        }
    };
}

id! {
    /// Names a project.
    ProjectId
}
id! {
    /// Names a scan: one acknowledged upload.
    ScanId
}
id! {
    /// Names a job.
    JobId
}
id! {
    /// Names a decision about two scans.
    DecisionId
}
id! {
    /// Names an upload that arrives in several requests.
    UploadId
}
id! {
    /// Names an API key.
    KeyId
}
id! {
    /// Names a webhook of a project.
    WebhookId
}

/// Counts the versions of a project's model: 1 is the first, and 0 the empty model before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct VersionNumber(pub u32);

impl VersionNumber {
    /// The empty model that every project starts with. It is not stored.
    pub const EMPTY: Self = Self(0);

    /// The number of the version after this one.
    #[must_use]
    pub fn next(self) -> Self {
        Self(self.0.saturating_add(1))
    }
}

impl fmt::Display for VersionNumber {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_id_survives_its_text_and_other_text_is_refused() {
        let id = ScanId::generate();
        assert_eq!(id.to_string().parse(), Ok(id));
        for text in ["", "1", "01ARZ3NDEKTSV4RRFFQ69G5FA!", "../../etc/passwd", "ü"] {
            assert!(text.parse::<JobId>().is_err(), "{text}");
        }
    }
}
