//! Answers to requests: files of the page, and the reasons why somebody is turned away.

use std::sync::atomic::Ordering;

use super::Shared;
use super::request::Request;
use crate::web;

/// Nothing from elsewhere, and no other page around it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A whole answer.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) bytes: Vec<u8>,
    /// Its client has shown the token, or needs none.
    pub(super) is_known: bool,
}

/// The reasons why a client gets nothing.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Turned {
    /// The head is no GET of HTTP/1.1.
    Malformed,
    /// It asks for another host, or comes from a page of another site.
    Elsewhere,
    /// Its token is missing or wrong.
    Unknown,
    /// There is no such file.
    NoFile,
    /// It asks for the WebSocket as for a file.
    NoPage,
    /// Its head took too long.
    Late,
    /// Its head is too long.
    Long,
    /// Too many others wait that have not sent a request.
    Crowded,
    /// There are as many pages as there may be.
    Full,
}

impl Turned {
    /// Returns the status and a line that says what to do.
    const fn words(self) -> (&'static str, &'static str) {
        match self {
            Self::Malformed => ("400 Bad Request", "only GET of HTTP/1.1 is answered"),
            Self::Elsewhere => (
                "403 Forbidden",
                "not for this host or this origin: open the address that was printed behind `view:`, with its host and port",
            ),
            Self::Unknown => (
                "403 Forbidden",
                "without the page's token, or with an old one: open the whole address that was printed behind `view:`, \
                 with ?token=...",
            ),
            Self::NoFile => {
                ("404 Not Found", "no such file: open the address that was printed behind `view:`")
            }
            Self::NoPage => ("426 Upgrade Required", "this is the page's WebSocket, and it is served"),
            Self::Late => ("408 Request Timeout", "the request took longer than 5 s"),
            Self::Long => ("431 Request Header Fields Too Large", "the request is longer than 8 KiB"),
            Self::Crowded => {
                ("503 Service Unavailable", "too many clients wait that have sent no request: try again")
            }
            Self::Full => (
                "503 Service Unavailable",
                "16 pages are open, and there may be no more: close one, try again",
            ),
        }
    }
}

impl Answer {
    /// Makes the answer for somebody who is turned away.
    pub(super) fn of(why: Turned) -> Self {
        let (status, words) = why.words();
        let number = status.split(' ').next().unwrap_or_default();
        Self::new(status, "text/plain; charset=utf-8", format!("{number}: {words}\n").as_bytes(), false)
    }

    fn new(status: &str, kind: &str, body: &[u8], is_known: bool) -> Self {
        let more = if status.starts_with("426") { "Upgrade: websocket\r\n" } else { "" };
        let mut bytes = format!(
            "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\nCache-Control: no-store\r\n\
             Content-Security-Policy: {POLICY}\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
             Cross-Origin-Resource-Policy: same-origin\r\n{more}\r\n",
            body.len()
        )
        .into_bytes();
        bytes.extend(body);
        Self { bytes, is_known }
    }
}

/// Answers a request with this head; `None` for one that becomes a page.
///
/// Scripts and styles are the same for everybody and tell nothing of the bench, so they need no token: the page's links to them
/// carry none.
pub(super) fn answer(head: &[u8], shared: &Shared) -> Option<Answer> {
    let turned = |why| {
        shared.refused.fetch_add(1, Ordering::Relaxed);
        Some(Answer::of(why))
    };
    let Some(request) = str::from_utf8(head).ok().and_then(Request::parse) else {
        return turned(Turned::Malformed);
    };
    if !request.is_for(shared.address) {
        return turned(Turned::Elsewhere);
    }
    let is_known = request.has(shared.access.token.as_ref());
    let is_code = web::is_code(&request.path);
    if !is_known && !is_code {
        return turned(Turned::Unknown);
    }
    match request.path.as_str() {
        "/live" if request.is_upgrade => None,
        "/live" if shared.pages.load(Ordering::Relaxed) >= super::PAGES => turned(Turned::Full),
        "/live" => turned(Turned::NoPage),
        "/surface" => Some(Answer::new("200 OK", "application/octet-stream", &shared.surface, is_known)),
        path => match web::file(path) {
            // Whoever asks for a script may be anybody.
            Some((kind, bytes)) => Some(Answer::new("200 OK", kind, bytes, is_known && !is_code)),
            None => turned(Turned::NoFile),
        },
    }
}
