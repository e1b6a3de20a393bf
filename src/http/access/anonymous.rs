//! Requests without a key: when they are served, and how a browser is kept from being used to send them.

use std::net::{IpAddr, SocketAddr};

use axum::http::request::Parts;
use axum::http::uri::Authority;
use axum::http::{HeaderName, HeaderValue, StatusCode, header};

use crate::http::Problem;
use crate::storage::{Keys, StorageError};

/// Whether requests without a key are served.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Openness {
    /// Always: the operator said so.
    Everyone,
    /// Until the first key is made, and only for programs on this machine.
    ThisMachine,
    /// Never.
    Closed,
}

impl Openness {
    /// What an operator's word and the address that is listened on make of it.
    #[must_use]
    pub fn of(allow_anonymous: bool, listen: SocketAddr) -> Self {
        match (allow_anonymous, listen.ip().is_loopback()) {
            (true, _) => Self::Everyone,
            (false, true) => Self::ThisMachine,
            (false, false) => Self::Closed,
        }
    }

    /// Whether a request without a key is served now.
    pub(super) async fn admits(self, keys: &Keys) -> Result<bool, StorageError> {
        match self {
            Self::Everyone => Ok(true),
            Self::ThisMachine => Ok(!keys.any().await?),
            Self::Closed => Ok(false),
        }
    }

    /// Refuses what a stranger's web page may have a browser on this machine send. The connection comes from here either way,
    /// but the browser says for which host and from which page.
    pub(super) fn check_browser(self, parts: &Parts, origins: &[HeaderValue]) -> Result<(), Problem> {
        let refuse = |detail| Err(Problem::new(StatusCode::FORBIDDEN, "not-allowed", detail));
        if self != Self::ThisMachine {
            return Ok(());
        }
        // What cannot be read names nobody who may come in.
        let text = |name: HeaderName| parts.headers.get(name).map(|value| value.to_str().unwrap_or(""));
        let host = parts.uri.authority().map(Authority::as_str).or_else(|| text(header::HOST));
        if !host.is_none_or(names_this_machine) {
            return refuse("without a key, the service has to be addressed as localhost or by a number");
        }
        let foreign = text(header::ORIGIN).filter(|origin| !origins.iter().any(|allowed| allowed == origin));
        let foreign = foreign.is_some_and(|origin| {
            origin.split_once("://").is_none_or(|(_, authority)| Some(authority) != host)
        });
        if foreign { refuse("without a key, pages of other sites may not send requests") } else { Ok(()) }
    }
}

/// Whether a host, with or without a port, is `localhost` or a number: a name that a stranger has registered is neither,
/// wherever it points.
fn names_this_machine(host: &str) -> bool {
    let Ok(authority) = host.parse::<Authority>() else { return false };
    let name = authority.host().trim_matches(['[', ']']);
    name.eq_ignore_ascii_case("localhost") || name.parse::<IpAddr>().is_ok()
}

#[cfg(test)]
mod tests {
    use axum::http::Request;

    use super::*;

    fn checked(host: &str, origin: Option<&str>) -> Result<(), Problem> {
        let mut request = Request::get("/v1/projects").header(header::HOST, host);
        if let Some(origin) = origin {
            request = request.header(header::ORIGIN, origin);
        }
        Openness::ThisMachine.check_browser(
            &request.body(()).unwrap().into_parts().0,
            &[HeaderValue::from_static("https://viewer.example")],
        )
    }

    #[test]
    fn openness_follows_the_address_unless_the_operator_says_otherwise() {
        let (here, there) = (([127, 0, 0, 1], 1).into(), ([0, 0, 0, 0], 1).into());
        assert_eq!(Openness::of(false, here), Openness::ThisMachine);
        assert_eq!(Openness::of(false, there), Openness::Closed);
        assert_eq!(Openness::of(true, there), Openness::Everyone);
    }

    #[test]
    fn a_strangers_page_can_neither_rebind_a_name_nor_send_a_request_across_sites() {
        for host in ["localhost", "localhost:8080", "127.0.0.1:8080", "[::1]:8080"] {
            assert!(checked(host, None).is_ok(), "{host}");
            assert!(checked(host, Some(&format!("http://{host}"))).is_ok(), "{host}");
            assert!(checked(host, Some("https://viewer.example")).is_ok(), "{host}");
            for origin in ["https://evil.example", "null", "http://127.0.0.1:1"] {
                assert!(checked(host, Some(origin)).is_err(), "{host} from {origin}");
            }
        }
        for host in ["evil.example", "evil.example:8080", "localhost.evil.example", "ü"] {
            assert!(checked(host, None).is_err(), "{host}");
        }
    }
}
