//! Names that people give to projects and scans.

use std::fmt;

use serde::Serialize;

/// Text of 1 to 200 characters without control characters, trimmed.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(transparent)]
pub struct Name(String);

/// Why a text is no name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BadName {
    /// Nothing is left after trimming.
    #[error("the name is empty")]
    Empty,
    /// More characters than allowed.
    #[error("the name has {found} characters, at most {} are allowed", Name::MAX_CHARS)]
    TooLong {
        /// Characters after trimming.
        found: usize,
    },
    /// A control character, such as a line break or a NUL.
    #[error("the name has a control character (U+{code:04X}) at position {position}")]
    ControlCharacter {
        /// The character's code point.
        code: u32,
        /// How many characters precede it.
        position: usize,
    },
}

impl Name {
    /// The longest name, in characters.
    pub const MAX_CHARS: usize = 200;

    /// Checks and trims a text.
    pub fn parse(text: &str) -> Result<Self, BadName> {
        let text = text.trim();
        if text.is_empty() {
            return Err(BadName::Empty);
        }
        let found = text.chars().count();
        if found > Self::MAX_CHARS {
            return Err(BadName::TooLong { found });
        }
        match text.chars().enumerate().find(|(_, c)| c.is_control()) {
            Some((position, c)) => Err(BadName::ControlCharacter { code: c.into(), position }),
            None => Ok(Self(text.to_owned())),
        }
    }

    /// As text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_trimmed_and_bad_ones_say_why() {
        assert_eq!(Name::parse("  Büro 3 ").unwrap().as_str(), "Büro 3");
        assert_eq!(Name::parse(" \t "), Err(BadName::Empty));
        assert_eq!(Name::parse("a\nb"), Err(BadName::ControlCharacter { code: 10, position: 1 }));
        assert_eq!(Name::parse(&"ü".repeat(201)), Err(BadName::TooLong { found: 201 }));
    }
}
