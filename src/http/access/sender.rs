//! From which address a request comes: the peer's, unless that is a proxy that the operator trusts to say for whom it asks.

use std::fmt;
use std::net::{IpAddr, Ipv6Addr, SocketAddr};
use std::str::FromStr;

use axum::http::HeaderMap;
use ipnet::IpNet;

/// The address at the other end of the connection, which `listen` puts into every request.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::http) struct Peer(pub IpAddr);

/// Addresses that limits take for one client: an IPv4 address, or an IPv6 network of 64 bits, of which one client has all.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(in crate::http) struct Source(IpAddr);

impl Source {
    /// The client at an address.
    pub fn of(address: IpAddr) -> Self {
        match address.to_canonical() {
            IpAddr::V6(v6) => Self(Ipv6Addr::from_bits(v6.to_bits() >> 64 << 64).into()),
            v4 @ IpAddr::V4(_) => Self(v4),
        }
    }
}

impl fmt::Display for Source {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            IpAddr::V4(v4) => write!(f, "{v4}"),
            IpAddr::V6(v6) => write!(f, "{v6}/64"),
        }
    }
}

/// A network or a single address, in settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network(IpNet);

impl FromStr for Network {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let single = || text.parse::<IpAddr>().map(IpNet::from);
        let bad = |_| "it must be such as 10.1.0.0/16 or 10.1.2.3".to_owned();
        text.parse().or_else(|_| single()).map(Self).map_err(bad)
    }
}

/// The proxies that are believed.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Proxies(pub Vec<Network>);

impl Proxies {
    /// Whether an address is that of a trusted proxy.
    pub(in crate::http) fn trust(&self, address: IpAddr) -> bool {
        let address = address.to_canonical();
        self.0.iter().any(|Network(network)| network.contains(&address))
    }

    /// Who sent a request. Each proxy appends whom it heard to `x-forwarded-for`, and whatever stands before that may be made up: so
    /// the list is read from its end, until an address that is no trusted proxy.
    pub(super) fn sender(&self, peer: IpAddr, headers: &HeaderMap) -> IpAddr {
        if !self.trust(peer) {
            return peer;
        }
        // What is no text ends the search as any other made-up name does.
        let lists = headers.get_all("x-forwarded-for").iter();
        let lists: Vec<_> = lists.map(|value| String::from_utf8_lossy(value.as_bytes())).collect();
        let heard: Vec<&str> = lists.iter().flat_map(|list| list.split(',')).map(str::trim).collect();
        let mut sender = peer;
        for text in heard.into_iter().rev() {
            let Some(address) = address(text) else { break };
            sender = address;
            if !self.trust(address) {
                break;
            }
        }
        sender
    }
}

/// An address as proxies write it, some with the port.
fn address(text: &str) -> Option<IpAddr> {
    let bare = || text.trim_matches(['[', ']']).parse().ok();
    text.parse::<SocketAddr>().ok().map(|with_port| with_port.ip()).or_else(bare)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sender(peer: &str, lists: &[&'static str]) -> String {
        let proxies = Proxies(vec!["10.0.0.0/8".parse().unwrap(), "::1".parse().unwrap()]);
        let mut headers = HeaderMap::new();
        for list in lists {
            headers.append("x-forwarded-for", list.parse().unwrap());
        }
        proxies.sender(peer.parse().unwrap(), &headers).to_string()
    }

    #[test]
    fn a_stranger_cannot_make_an_address_up_and_a_trusted_proxy_names_the_client() {
        assert_eq!(sender("192.0.2.1", &["198.51.100.7"]), "192.0.2.1");
        assert_eq!(sender("10.0.0.1", &["198.51.100.7"]), "198.51.100.7");
        assert_eq!(sender("10.0.0.1", &["203.0.113.9, 198.51.100.7:4711, 10.2.3.4"]), "198.51.100.7");
        assert_eq!(sender("::1", &["203.0.113.9", "[2001:db8::1]:443"]), "2001:db8::1");
        assert_eq!(sender("::ffff:10.0.0.1", &["198.51.100.7"]), "198.51.100.7");
        assert_eq!(sender("10.0.0.1", &["198.51.100.7, unknown"]), "10.0.0.1");
        assert_eq!(sender("10.0.0.1", &[]), "10.0.0.1");
    }

    #[test]
    fn a_list_that_is_no_text_hides_what_stands_before_it() {
        let proxies = Proxies(vec!["10.0.0.0/8".parse().unwrap()]);
        let mut headers = HeaderMap::new();
        headers.append("x-forwarded-for", "203.0.113.9".parse().unwrap());
        headers.append("x-forwarded-for", axum::http::HeaderValue::from_bytes(b"\xe9").unwrap());
        let peer: IpAddr = "10.0.0.1".parse().unwrap();
        assert_eq!(proxies.sender(peer, &headers), peer);
    }

    #[test]
    fn a_client_has_all_of_its_ipv6_network() {
        let of = |text: &str| Source::of(text.parse().unwrap());
        assert_eq!(of("2001:db8:1:2::1"), of("2001:db8:1:2:ffff::7"));
        assert_ne!(of("2001:db8:1:2::1"), of("2001:db8:1:3::1"));
        assert_eq!(of("::ffff:192.0.2.1"), of("192.0.2.1"));
        assert_eq!(of("2001:db8:1:2::1").to_string(), "2001:db8:1:2::/64");
    }
}
