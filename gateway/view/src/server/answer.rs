//! The answers to requests: files of the page, and refusals.

use std::sync::atomic::Ordering;

use super::ServerState;
use super::request::Request;
use crate::web;

/// The content security policy: a page loads nothing from other servers, and no other page can embed it.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A complete HTTP answer.
#[derive(Debug)]
pub(crate) struct HttpResponse {
    pub(crate) bytes: Vec<u8>,
    /// True if the client has sent the token, or if none is needed.
    pub(crate) is_known: bool,
}

/// The reason why a request is refused.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(crate) enum RefusalReason {
    /// The request is not a GET request of HTTP/1.1.
    Malformed,
    /// The request is addressed to another host, or comes from a page of another site.
    Elsewhere,
    /// The request does not carry the right token.
    Unknown,
    /// The file does not exist.
    NoFile,
    /// The path of the WebSocket was requested like a file.
    NoPage,
    /// The head of the request did not arrive in time.
    Late,
    /// The head of the request is too long.
    Long,
    /// Too many other clients are connected that have not sent their requests yet.
    Crowded,
    /// The maximum number of pages is connected.
    Full,
    /// A viewer's request is addressed to another host, or comes from a page of a site that is not known as a viewer.
    ViewerElsewhere,
    /// A viewer's request does not carry the right token.
    ViewerUnknown,
    /// The address of the viewers' WebSocket was requested like a file.
    NoViewer,
    /// The maximum number of viewers is connected.
    ViewersFull,
}

impl RefusalReason {
    /// Returns the HTTP status line, and a text that tells the user what to do.
    const fn status_and_advice(self) -> (&'static str, &'static str) {
        match self {
            Self::Malformed => ("400 Bad Request", "only GET requests of HTTP/1.1 are answered"),
            Self::Elsewhere => (
                "403 Forbidden",
                "wrong host or origin: open the address printed after `view:`, with its host and port",
            ),
            Self::Unknown => (
                "403 Forbidden",
                "the token is missing or outdated: open the whole address printed after `view:`, \
                 with ?token=...",
            ),
            Self::NoFile => ("404 Not Found", "no such file: open the address printed after `view:`"),
            Self::NoPage => ("426 Upgrade Required", "this address accepts only the WebSocket of the page"),
            Self::Late => ("408 Request Timeout", "the request took longer than 5 s"),
            Self::Long => ("431 Request Header Fields Too Large", "the request is longer than 8 KiB"),
            Self::Crowded => {
                ("503 Service Unavailable", "too many clients are connected without a request: try again")
            }
            Self::Full => {
                ("503 Service Unavailable", "16 pages are open, the maximum: close one and try again")
            }
            Self::ViewerElsewhere => (
                "403 Forbidden",
                "wrong host or origin: connect to the address printed after `foxglove:`; a viewer on another \
                 site needs a token, see --token-file",
            ),
            Self::ViewerUnknown => (
                "403 Forbidden",
                "the token is missing or outdated: connect to the address printed after `foxglove:`, with \
                 ?token=...",
            ),
            Self::NoViewer => (
                "426 Upgrade Required",
                "this address accepts only a WebSocket: connect to it in Foxglove or Lichtblick",
            ),
            Self::ViewersFull => (
                "503 Service Unavailable",
                "32 viewers are connected, the maximum: disconnect one and try again",
            ),
        }
    }
}

impl HttpResponse {
    /// Returns the answer for a request that is refused.
    pub(crate) fn from_refusal(why: RefusalReason) -> Self {
        let (status, words) = why.status_and_advice();
        let number = status.split(' ').next().unwrap_or_default();
        Self::new(status, "text/plain; charset=utf-8", format!("{number}: {words}\n").as_bytes(), false)
    }

    fn new(status: &str, kind: &str, body: &[u8], is_known: bool) -> Self {
        let more = if status.starts_with("426") { "Upgrade: websocket\r\n" } else { "" };
        let mut bytes = format!(
            "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\nCache-Control: no-store\r\n\
             Content-Security-Policy: {CONTENT_SECURITY_POLICY}\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
             Cross-Origin-Resource-Policy: same-origin\r\n{more}\r\n",
            body.len()
        )
        .into_bytes();
        bytes.extend(body);
        Self { bytes, is_known }
    }
}

/// Answers a request with this head. Returns `None` if the client becomes a page, with a WebSocket.
///
/// Scripts and styles need no token, because the page requests them by links without one. They are the same for every
/// client and reveal nothing about the bench.
pub(super) fn answer_request(head: &[u8], shared: &ServerState) -> Option<HttpResponse> {
    let turned = |why| {
        shared.refused.fetch_add(1, Ordering::Relaxed);
        Some(HttpResponse::from_refusal(why))
    };
    let Some(request) = str::from_utf8(head).ok().and_then(Request::parse) else {
        return turned(RefusalReason::Malformed);
    };
    if !request.is_addressed_to(shared.address) {
        return turned(RefusalReason::Elsewhere);
    }
    let is_known = request.has_token(shared.access.token.as_ref());
    let is_code = web::is_script_or_style(&request.path);
    if !is_known && !is_code {
        return turned(RefusalReason::Unknown);
    }
    match request.path.as_str() {
        "/live" if request.is_upgrade => None,
        "/live" if shared.pages.load(Ordering::Relaxed) >= super::MAX_PAGES => turned(RefusalReason::Full),
        "/live" => turned(RefusalReason::NoPage),
        "/surface" => {
            Some(HttpResponse::new("200 OK", "application/octet-stream", &shared.surface, is_known))
        }
        path @ ("/curves" | "/events") => {
            let recording = shared.recording.get();
            match recording.and_then(|recording| recording.answer(path, &request.query)) {
                Some((kind, bytes)) => Some(HttpResponse::new("200 OK", kind, &bytes, is_known)),
                None => turned(RefusalReason::NoFile),
            }
        }
        path => match web::media_type_and_contents(path) {
            // A request for a script does not show that the client knows the token.
            Some((kind, bytes)) => Some(HttpResponse::new("200 OK", kind, bytes, is_known && !is_code)),
            None => turned(RefusalReason::NoFile),
        },
    }
}
