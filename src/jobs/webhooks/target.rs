//! Whom messages may be sent to: a webhook must not become a way into the operator's own network.
//!
//! Two questions are asked each time something is sent. Is the host of the address one that the operator has listed? And
//! is every address that its name stands for now, and that is connected to, a public one, or in a network that the
//! operator has listed too? The connection goes to the very address that was checked.

use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::str::FromStr;

use hyper::Uri;
use ipnet::IpNet;

/// A host that may be spoken to.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum HostPattern {
    /// This one.
    Exact(String),
    /// Every one below this domain, not the domain itself: `*.example.com`.
    Below(String),
}

/// Everybody who may be spoken to; by default nobody.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Targets {
    /// Listed hosts.
    pub hosts: Vec<HostPattern>,
    /// Networks that are not public, but may be spoken to if a listed host is there.
    pub networks: Vec<IpNet>,
}

/// An address that may be registered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Target {
    /// Whether it is encrypted.
    pub encrypted: bool,
    /// Its host, a name or a number without brackets.
    pub host: String,
    /// Its port.
    pub port: u16,
    /// What is asked for there, beginning with `/`.
    pub path: String,
}

/// Why an address may not be spoken to.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BadTarget {
    /// Not of the form.
    #[error("it must be an absolute http or https address without a name, a password or a fragment")]
    Malformed,
    /// Not listed.
    #[error("the operator has not allowed messages to the host `{0}`")]
    NotListed(String),
    /// The name stands for an address inside.
    #[error("`{0}` stands for no address that messages may be sent to")]
    Inside(String),
}

impl FromStr for HostPattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let text = text.trim().to_ascii_lowercase();
        let (below, host) = text.strip_prefix("*.").map_or((false, text.as_str()), |rest| (true, rest));
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '.' | '-' | '_');
        let number = host.trim_matches(['[', ']']);
        if !below && number.parse::<IpAddr>().is_ok() {
            Ok(Self::Exact(number.to_owned()))
        } else if host.is_empty() || !host.chars().all(plain) {
            Err(format!(
                "`{text}` is no host: it must be such as hooks.example.com, *.example.com or 192.0.2.7"
            ))
        } else if below {
            Ok(Self::Below(host.to_owned()))
        } else {
            Ok(Self::Exact(host.to_owned()))
        }
    }
}

impl HostPattern {
    fn admits(&self, host: &str) -> bool {
        match self {
            Self::Exact(name) => host == name,
            Self::Below(domain) => {
                host.strip_suffix(domain).is_some_and(|rest| rest.len() > 1 && rest.ends_with('.'))
            }
        }
    }
}

impl Targets {
    /// Reads an address, if messages may be sent to its host.
    pub fn target(&self, url: &str) -> Result<Target, BadTarget> {
        let uri: Uri = url.parse().map_err(|_| BadTarget::Malformed)?;
        let encrypted = match uri.scheme_str() {
            Some("https") => true,
            Some("http") => false,
            _ => return Err(BadTarget::Malformed),
        };
        let authority = uri.authority().ok_or(BadTarget::Malformed)?;
        if authority.as_str().contains('@') || url.contains('#') {
            return Err(BadTarget::Malformed);
        }
        let host = authority.host().trim_matches(['[', ']']).trim_end_matches('.').to_ascii_lowercase();
        // A port that is no number is read as none: then the text is longer than host and port.
        let port = match (authority.port_u16(), authority.as_str().len() == authority.host().len()) {
            (Some(port), _) if port > 0 => port,
            (None, true) => {
                if encrypted {
                    443
                } else {
                    80
                }
            }
            _ => return Err(BadTarget::Malformed),
        };
        if host.is_empty() || !self.hosts.iter().any(|pattern| pattern.admits(&host)) {
            return Err(BadTarget::NotListed(host));
        }
        let path = uri.path_and_query().map_or("/", |path| path.as_str()).to_owned();
        Ok(Target { encrypted, host, port, path })
    }

    /// Whether this address may be connected to.
    #[must_use]
    pub fn admits_address(&self, address: IpAddr) -> bool {
        // An IPv4 address may come in the clothes of an IPv6 one.
        let address = address.to_canonical();
        is_public(address) || self.networks.iter().any(|network| network.contains(&address))
    }
}

/// Whether an address is one of the public Internet, by the registries of special addresses of IANA (RFC 6890).
fn is_public(address: IpAddr) -> bool {
    match address {
        IpAddr::V4(v4) => is_public_v4(v4),
        IpAddr::V6(v6) => is_public_v6(v6),
    }
}

fn is_public_v4(address: Ipv4Addr) -> bool {
    let [a, b, c, _] = address.octets();
    let special = address.is_private()
        || address.is_loopback()
        || address.is_link_local()
        || address.is_documentation()
        || address.is_multicast()
        || a == 0
        || (a == 100 && (64..128).contains(&b))
        || (a == 192 && b == 0 && c == 0)
        || (a == 192 && b == 88 && c == 99)
        || (a == 198 && (18..20).contains(&b))
        || a >= 240;
    !special
}

/// Global unicast is `2000::/3`; what is special in it are the protocol assignments (Teredo among them), documentation, and
/// 6to4, which carries an IPv4 address of whatever kind.
fn is_public_v6(address: Ipv6Addr) -> bool {
    let [a, b, ..] = address.segments();
    let global_unicast = a & 0xe000 == 0x2000;
    let special = (a == 0x2001 && (b < 0x200 || b == 0xdb8)) || a == 0x2002 || (a == 0x3fff && b < 0x1000);
    global_unicast && !special
}

#[cfg(test)]
mod tests {
    use super::*;

    fn targets(hosts: &[&str], networks: &[&str]) -> Targets {
        Targets {
            hosts: hosts.iter().map(|host| host.parse().unwrap()).collect(),
            networks: networks.iter().map(|network| network.parse().unwrap()).collect(),
        }
    }

    #[test]
    fn only_listed_hosts_may_be_registered() {
        let targets = targets(&["hooks.example.com", "*.corp.example", "192.0.2.7", "[2001:db8::1]"], &[]);
        for url in [
            "https://hooks.example.com/a?b=c",
            "http://HOOKS.example.com:8080",
            "https://a.corp.example/",
            "https://a.b.corp.example./",
            "https://192.0.2.7/",
            "https://[2001:db8::1]:8443/x",
        ] {
            assert!(targets.target(url).is_ok(), "{url}: {:?}", targets.target(url));
        }
        for url in [
            "https://example.com/",
            "https://corp.example/",
            "https://evilcorp.example/",
            "https://hooks.example.com.evil.example/",
            "https://user:secret@hooks.example.com/",
            "https://evil.example/#hooks.example.com",
            "https://hooks.example.com:0/",
            "https://hooks.example.com:x/",
            "ftp://hooks.example.com/",
            "//hooks.example.com/",
            "/path",
            "",
            "https://",
            "https://[::1]/",
            "https://localhost/",
        ] {
            assert!(targets.target(url).is_err(), "{url}");
        }
        assert!(Targets::default().target("https://hooks.example.com/").is_err(), "by default nobody");
        let target = targets.target("https://hooks.example.com/a?b=c").unwrap();
        assert_eq!((target.encrypted, target.port, target.path.as_str()), (true, 443, "/a?b=c"));
    }

    #[test]
    fn only_public_addresses_and_listed_networks_may_be_connected_to() {
        let targets = targets(&[], &["10.1.0.0/16", "fd00:1::/32"]);
        let admits = |text: &str| targets.admits_address(text.parse().unwrap());
        for inside in [
            "127.0.0.1",
            "10.0.0.1",
            "172.16.9.9",
            "192.168.1.1",
            "169.254.169.254",
            "0.0.0.0",
            "100.64.0.1",
            "198.18.0.1",
            "224.0.0.1",
            "255.255.255.255",
            "240.0.0.1",
            "192.0.0.8",
            "::1",
            "::",
            "fe80::1",
            "fc00::1",
            "fd00:2::1",
            "ff02::1",
            "::ffff:127.0.0.1",
            "::ffff:10.0.0.1",
            "::127.0.0.1",
            "2002:7f00:1::",
            "64:ff9b::7f00:1",
            "2001::1",
            "2001:db8::1",
        ] {
            assert!(!admits(inside), "{inside}");
        }
        for allowed in [
            "93.184.215.14",
            "2606:2800:21f::1",
            "2001:4860::8888",
            "10.1.2.3",
            "::ffff:10.1.2.3",
            "fd00:1::9",
        ] {
            assert!(admits(allowed), "{allowed}");
        }
    }

    #[test]
    fn what_is_no_host_cannot_be_listed() {
        for bad in
            ["", "*", "*.", "https://a.example", "a.example/x", "a.example:80", "*.*.example", "ü.example"]
        {
            assert!(bad.parse::<HostPattern>().is_err(), "{bad}");
        }
    }
}
