//! Parses the head of an HTTP request, and checks whether it may be served.

use std::net::{IpAddr, SocketAddr};

use crate::token::Token;

/// The maximum length of a head, in bytes.
pub(crate) const MAX_HEAD_BYTES: usize = 8 * 1024;
/// The port that is meant if an address has none.
const DEFAULT_PORT: u16 = 80;

/// The parts of a request that decide how it is answered.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(crate) struct Request {
    pub(crate) path: String,
    pub(crate) query: String,
    pub(crate) host: Option<String>,
    pub(crate) origin: Option<String>,
    pub(crate) is_upgrade: bool,
}

impl Request {
    /// Parses the head of a request, up to and including the empty line. Returns `None` unless it is a valid GET
    /// request.
    pub(crate) fn parse(head: &str) -> Option<Self> {
        let mut lines = head.split("\r\n");
        let mut first = lines.next()?.split(' ');
        let (Some("GET"), Some(target), Some("HTTP/1.1")) = (first.next(), first.next(), first.next()) else {
            return None;
        };
        let (path, query) = target.split_once('?').unwrap_or((target, ""));
        let mut request = Self { path: path.to_owned(), query: query.to_owned(), ..Self::default() };
        for line in lines {
            let Some((name, value)) = line.split_once(':') else { continue };
            let value = value.trim();
            match name.to_ascii_lowercase().as_str() {
                // A request with two Host headers could be understood in two ways, so it is refused.
                "host" if request.host.is_some() => return None,
                "host" => request.host = Some(value.to_ascii_lowercase()),
                "origin" => request.origin = Some(value.to_ascii_lowercase()),
                "upgrade" => request.is_upgrade = value.eq_ignore_ascii_case("websocket"),
                _ => {}
            }
        }
        Some(request)
    }

    /// Returns true if the request is addressed to this server by one of its own addresses and does not come from a
    /// page of another site.
    pub(crate) fn is_addressed_to(&self, address: SocketAddr) -> bool {
        let Some(host) = self.host.as_deref().and_then(HostAndPort::parse) else { return false };
        // Browsers send an origin with every WebSocket; other programs may omit it.
        let is_origin = self.origin.as_ref().is_none_or(|origin| {
            origin.strip_prefix("http://").and_then(HostAndPort::parse).is_some_and(|origin| origin == host)
        });
        self.names_host(address) && is_origin
    }

    /// Returns true if the request names this server by one of its own addresses, whatever page it comes from.
    pub(crate) fn names_host(&self, address: SocketAddr) -> bool {
        let host = self.host.as_deref().and_then(HostAndPort::parse);
        host.is_some_and(|host| host.matches_address(address))
    }

    /// Returns true if the request carries the token, or if none is needed.
    pub(crate) fn has_token(&self, token: Option<&Token>) -> bool {
        let Some(token) = token else { return true };
        let given = self.query.split('&').find_map(|part| part.strip_prefix("token="));
        given.is_some_and(|given| token.matches(given))
    }
}

/// The host and the port of a URL or a Host header.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
struct HostAndPort<'a> {
    host: &'a str,
    port: u16,
}

impl<'a> HostAndPort<'a> {
    /// Parses `HOST` or `HOST:PORT`; an IPv6 address is in brackets.
    fn parse(text: &'a str) -> Option<Self> {
        let end = text.rfind(']').map_or(0, |bracket| bracket + 1);
        let colon = text.get(end..)?.find(':').map(|at| end + at);
        let (host, port) = colon.and_then(|at| text.split_at_checked(at)).unwrap_or((text, ""));
        let port = match port.strip_prefix(':') {
            Some(digits) if digits.bytes().all(|byte| byte.is_ascii_digit()) && !digits.is_empty() => {
                digits.parse().ok()?
            }
            None | Some("") => DEFAULT_PORT,
            Some(_) => return None,
        };
        Some(Self { host, port })
    }

    /// Returns true if the host and the port mean the address `listen`. Other names than localhost are refused: any
    /// site can make its own name resolve to this machine, and its pages could then read this one.
    fn matches_address(self, listen: SocketAddr) -> bool {
        let is_anywhere = listen.ip().is_unspecified();
        let inner = self.host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        let ip = match inner {
            Some(inner) => inner.parse().map(IpAddr::V6).ok(),
            None => self.host.parse().map(IpAddr::V4).ok(),
        };
        let is_host = match ip {
            Some(ip) => ip == listen.ip() || is_anywhere,
            None => self.host == "localhost" && (listen.ip().is_loopback() || is_anywhere),
        };
        is_host && self.port == listen.port()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn is_for(head: &str, address: &str) -> bool {
        Request::parse(head).is_some_and(|request| request.is_addressed_to(address.parse().unwrap()))
    }

    #[test]
    fn only_this_host_and_its_own_pages_are_served() {
        for (head, expected) in [
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\n\r\n", true),
            ("GET / HTTP/1.1\r\nhost: LOCALHOST:8100\r\n\r\n", true),
            ("GET / HTTP/1.1\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: evil.example:8100\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:9\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:+8100\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: [127.0.0.1]:8100\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\nHost: evil.example\r\n\r\n", false),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: http://localhost:8100\r\n\r\n", true),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: http://localhost\r\n\r\n", false),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: http://evil.example\r\n\r\n", false),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: null\r\n\r\n", false),
            ("POST / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\n\r\n", false),
        ] {
            assert_eq!(is_for(head, "127.0.0.1:8100"), expected, "{head}");
        }
    }

    #[test]
    fn a_host_without_a_port_means_port_80() {
        for (host, address, expected) in [
            ("127.0.0.1", "127.0.0.1:80", true),
            ("127.0.0.1:", "127.0.0.1:80", true),
            ("127.0.0.1:80", "127.0.0.1:80", true),
            ("127.0.0.1:8100", "127.0.0.1:80", false),
            ("localhost", "127.0.0.1:80", true),
            ("localhost", "[::1]:80", true),
            ("localhost", "192.168.1.5:80", false),
            ("localhost", "0.0.0.0:80", true),
            ("[::1]", "[::1]:80", true),
            ("[::1]:80", "[::1]:80", true),
            ("[::1]:8100", "[::1]:8100", true),
            ("[::1]", "[::1]:8100", false),
            ("::1", "[::1]:80", false),
            ("[::2]", "[::1]:80", false),
            ("[fe80::5]", "[::]:80", true),
            ("192.168.1.5", "0.0.0.0:80", true),
            ("evil.example", "0.0.0.0:80", false),
        ] {
            assert_eq!(
                is_for(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n"), address),
                expected,
                "{host}"
            );
            let own = format!("GET / HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\n\r\n");
            assert_eq!(is_for(&own, address), expected, "{host}");
        }
        let named = "GET / HTTP/1.1\r\nHost: 127.0.0.1:80\r\nOrigin: http://127.0.0.1\r\n\r\n";
        assert!(is_for(named, "127.0.0.1:80"), "one origin, written in two ways");
    }

    #[test]
    fn a_token_is_in_the_query() {
        let token = Token::parse("abcdef0123456789").unwrap();
        let has = |query: &str| {
            let request = Request::parse(&format!("GET /{query} HTTP/1.1\r\n\r\n")).unwrap();
            request.has_token(Some(&token))
        };
        assert!(has("?token=abcdef0123456789") && has("?more&token=abcdef0123456789"));
        for wrong in
            ["", "?token=", "?token=abcdef0123456780", "?token=abcdef01234567890", "?other=abcdef0123456789"]
        {
            assert!(!has(wrong), "{wrong}");
        }
        assert!(Request::default().has_token(None));
    }

    proptest! {
        #[test]
        fn any_head_is_read_without_a_panic(head: String, host: String) {
            let _ = Request::parse(&head);
            is_for(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n"), "127.0.0.1:80");
        }
    }
}
