//! Query strings, read strictly: unknown or repeated parameters and bytes that are no UTF-8 are errors that name the
//! parameter. (The usual extractor replaces such bytes silently.)

use std::collections::BTreeMap;
use std::str::FromStr;

use axum::extract::FromRequestParts;
use axum::http::request::Parts;
use percent_encoding::percent_decode_str;

use super::Problem;
use crate::project::VersionNumber;
use crate::storage::Page;

/// The parameters of a query. Take what is known, then [`Params::finish`].
#[derive(Debug, Default)]
pub(super) struct Params(BTreeMap<String, String>);

/// Items in a part of a list if the client does not say.
const DEFAULT_LIMIT: u32 = 50;
/// At most so many.
const MAX_LIMIT: u32 = 200;

impl<S: Sync> FromRequestParts<S> for Params {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        Self::parse(parts.uri.query().unwrap_or(""))
    }
}

impl From<BTreeMap<String, String>> for Params {
    fn from(params: BTreeMap<String, String>) -> Self {
        Self(params)
    }
}

impl Params {
    fn parse(query: &str) -> Result<Self, Problem> {
        let mut params = BTreeMap::new();
        for pair in query.split('&').filter(|p| !p.is_empty()) {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let shown: String = name.chars().take(60).collect();
            let decode = |text: &str| {
                let text = text.replace('+', " ");
                percent_decode_str(&text).decode_utf8().map(std::borrow::Cow::into_owned).map_err(|_| {
                    Problem::invalid(&shown, format!("parameter `{shown}` is not UTF-8 (percent-encoded)"))
                })
            };
            let (name, value) = (decode(name)?, decode(value)?);
            if params.insert(name, value).is_some() {
                return Err(Problem::invalid(&shown, format!("parameter `{shown}` is given twice")));
            }
        }
        Ok(Self(params))
    }

    /// The text of a parameter.
    pub fn text(&mut self, name: &str) -> Option<String> {
        self.0.remove(name)
    }

    /// The value of a parameter. `expected` completes "it must be …".
    pub fn value<T: FromStr>(&mut self, name: &str, expected: &str) -> Result<Option<T>, Problem> {
        self.text(name).map(|text| text.trim().parse().map_err(|_| bad(name, &text, expected))).transpose()
    }

    /// The value of a parameter, read by a function.
    pub fn with<T>(
        &mut self,
        name: &str,
        expected: &str,
        read: impl FnOnce(&str) -> Option<T>,
    ) -> Result<Option<T>, Problem> {
        self.text(name).map(|text| read(&text).ok_or_else(|| bad(name, &text, expected))).transpose()
    }

    /// `cursor` and `limit` of a list.
    pub fn page(&mut self) -> Result<Page, Problem> {
        let after = self.with("cursor", "the `next` of an earlier answer", |text| {
            i64::from_str_radix(text, 16).ok().filter(|n| *n >= 0)
        })?;
        let limit = self.with("limit", "a whole number from 1 to 200", |text| {
            text.parse().ok().filter(|n| (1..=MAX_LIMIT).contains(n))
        })?;
        Ok(Page { after, limit: limit.unwrap_or(DEFAULT_LIMIT) })
    }

    /// `version` of a model.
    pub fn version(&mut self) -> Result<Option<VersionNumber>, Problem> {
        Ok(self.value("version", "the number of a version")?.map(VersionNumber))
    }

    /// Refuses what nobody took.
    pub fn finish(self) -> Result<(), Problem> {
        match self.0.into_keys().next() {
            None => Ok(()),
            Some(name) => {
                let name: String = name.chars().take(60).collect();
                Err(Problem::invalid(&name, format!("there is no parameter `{name}` here")))
            }
        }
    }
}

/// The position of the next part of a list, if what was found of it, each with its position, fills the page.
pub(super) fn next<T>(page: Page, found: &[(i64, T)]) -> Option<String> {
    found.last().filter(|_| found.len() == page.limit as usize).map(|(at, _)| cursor(*at))
}

/// A list's opaque position.
pub(super) fn cursor(position: i64) -> String {
    format!("{position:x}")
}

fn bad(name: &str, text: &str, expected: &str) -> Problem {
    let text: String = text.chars().take(60).collect();
    Problem::invalid(name, format!("`{name}` is `{text}`; it must be {expected}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_that_are_no_utf_8_name_their_parameter() {
        let problem = Params::parse("units=m&name=scan%FF%FE.ply").unwrap_err();
        assert_eq!((problem.status, problem.field.as_deref()), (400, Some("name")));
    }

    #[test]
    fn repeated_and_unknown_parameters_are_refused() {
        assert_eq!(Params::parse("a=1&a=2").unwrap_err().field.as_deref(), Some("a"));
        let mut params = Params::parse("limit=3&what=1").unwrap();
        assert_eq!(params.page().unwrap(), Page { after: None, limit: 3 });
        assert_eq!(params.finish().unwrap_err().field.as_deref(), Some("what"));
    }

    #[test]
    fn a_cursor_comes_back_as_the_position() {
        let mut params = Params::parse(&format!("cursor={}", cursor(47))).unwrap();
        assert_eq!(params.page().unwrap().after, Some(47));
        assert!(Params::parse("cursor=-1").unwrap().page().is_err());
    }
}
