//! The head of an HTTP request, and whether it may be served.

use std::net::{IpAddr, SocketAddr};

use super::Access;

/// The longest head, in bytes.
pub(super) const LONGEST: usize = 8 * 1024;

/// What of a request counts.
#[derive(Clone, Debug, Default, Eq, PartialEq)]
pub(super) struct Request {
    pub(super) path: String,
    pub(super) query: String,
    pub(super) host: Option<String>,
    pub(super) origin: Option<String>,
    pub(super) is_upgrade: bool,
}

impl Request {
    /// Reads a head, which ends with an empty line; `None` of anything else than GET.
    pub(super) fn parse(head: &str) -> Option<Self> {
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
                // Twice may be an attempt to be read in two ways.
                "host" if request.host.is_some() => return None,
                "host" => request.host = Some(value.to_ascii_lowercase()),
                "origin" => request.origin = Some(value.to_ascii_lowercase()),
                "upgrade" => request.is_upgrade = value.eq_ignore_ascii_case("websocket"),
                _ => {}
            }
        }
        Some(request)
    }

    /// Whether it is for this server, from a page of this server, with the token if there is one.
    pub(super) fn is_allowed(&self, access: &Access, port: u16) -> bool {
        let Some(host) = &self.host else { return false };
        let is_host = is_ours(host, access.listen.ip(), port);
        let origin = self.origin.as_ref().and_then(|origin| origin.strip_prefix("http://"));
        // Browsers name the origin of every WebSocket; other programs are as this machine's user.
        let is_origin = self.origin.is_none() || origin == Some(host);
        is_host && is_origin && self.has_token(access.token.as_deref())
    }

    fn has_token(&self, token: Option<&str>) -> bool {
        let Some(token) = token else { return true };
        let given = self.query.split('&').find_map(|part| part.strip_prefix("token="));
        // As long for a wrong one as for the right one.
        given.is_some_and(|given| {
            let pairs = given.bytes().zip(token.bytes());
            given.len() == token.len() && pairs.fold(0, |off, (one, other)| off | (one ^ other)) == 0
        })
    }
}

/// Whether a host is what the server listens on. A name of somebody else's, which leads here, is none: so a page of
/// another site cannot read this one.
fn is_ours(host: &str, listen: IpAddr, port: u16) -> bool {
    if host == format!("localhost:{port}") && listen.is_loopback() {
        return true;
    }
    match host.parse::<SocketAddr>() {
        Ok(address) if address.port() == port => address.ip() == listen || listen.is_unspecified(),
        Ok(_) | Err(_) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn access(listen: &str, token: Option<&str>) -> Access {
        Access {
            listen: listen.parse().unwrap(),
            may_act: true,
            may_play: false,
            token: token.map(str::to_owned),
        }
    }

    fn is_allowed(head: &str, access: &Access) -> bool {
        Request::parse(head).is_some_and(|request| request.is_allowed(access, 8100))
    }

    #[test]
    fn only_this_host_and_its_own_pages_are_served() {
        let local = access("127.0.0.1:8100", None);
        for (head, expected) in [
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\n\r\n", true),
            ("GET / HTTP/1.1\r\nhost: LOCALHOST:8100\r\n\r\n", true),
            ("GET / HTTP/1.1\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: evil.example:8100\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:9\r\n\r\n", false),
            ("GET / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\nHost: evil.example\r\n\r\n", false),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: http://localhost:8100\r\n\r\n", true),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: http://evil.example\r\n\r\n", false),
            ("GET /live HTTP/1.1\r\nHost: localhost:8100\r\nOrigin: null\r\n\r\n", false),
            ("POST / HTTP/1.1\r\nHost: 127.0.0.1:8100\r\n\r\n", false),
        ] {
            assert_eq!(is_allowed(head, &local), expected, "{head}");
        }
    }

    #[test]
    fn elsewhere_a_token_is_needed() {
        let open = access("0.0.0.0:8100", Some("abc123"));
        let head = |query: &str| format!("GET /{query} HTTP/1.1\r\nHost: 192.168.1.5:8100\r\n\r\n");
        assert!(is_allowed(&head("?token=abc123"), &open));
        for wrong in ["", "?token=", "?token=abc124", "?token=abc1234", "?other=abc123"] {
            assert!(!is_allowed(&head(wrong), &open), "{wrong}");
        }
    }

    proptest! {
        #[test]
        fn any_head_is_read_without_a_panic(head: String) {
            let _ = Request::parse(&head);
        }
    }
}
