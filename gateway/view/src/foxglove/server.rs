//! The server of viewers: who may connect, and a thread for each.

use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::mpsc::channel;
use std::thread;

use bench::bus::listen::now;
use trace::recording::robot::RecordedRobot;

use super::hub::MessageHub;
use super::viewer::serve_viewer;
use crate::server::answer::{HttpResponse, RefusalReason};
use crate::server::door::{self, DoorKeeper};
use crate::server::page::PrefixedStream;
use crate::server::request::Request;
use crate::token::Token;

/// The maximum number of viewers at the same time.
const MAX_VIEWERS: usize = 32;

/// The settings of the server of viewers.
#[derive(Debug)]
pub struct FoxgloveOptions {
    /// The socket that viewers connect to.
    pub listener: TcpListener,
    /// The token that viewers must have; `None` if the user has chosen none.
    pub token: Option<Token>,
    /// The geometry of the robot's links, if it is known. A recording has its own.
    pub robot: Option<RecordedRobot>,
}

/// The state that the threads of the server share.
#[derive(Debug)]
struct FoxgloveState {
    hub: Arc<MessageHub>,
    token: Option<Token>,
    address: SocketAddr,
    stop: AtomicBool,
    viewers: AtomicUsize,
}

/// A running server of viewers. Dropping it stops its threads.
#[derive(Debug)]
pub(crate) struct FoxgloveServer {
    state: Arc<FoxgloveState>,
}

impl FoxgloveServer {
    /// Serves all viewers that connect to `listener`. `name` is shown in them. Messages come from a recording if
    /// `is_played` is true.
    ///
    /// # Errors
    /// Returns an error if the listener cannot be set up, or if the system refuses a thread.
    pub(crate) fn start(
        listener: TcpListener,
        token: Option<Token>,
        name: String,
        is_played: bool,
    ) -> io::Result<Self> {
        listener.set_nonblocking(true)?;
        let state = Arc::new(FoxgloveState {
            hub: Arc::new(MessageHub::new(name, now().0.to_string(), is_played)),
            token,
            address: listener.local_addr()?,
            stop: AtomicBool::new(false),
            viewers: AtomicUsize::new(0),
        });
        let (begun, clients) = channel();
        let (of_viewers, of_door) = (Arc::clone(&state), Arc::clone(&state));
        let named = |name: &str| thread::Builder::new().name(name.to_owned());
        named("foxglove viewers").spawn(move || door::start_client_threads(clients, &of_viewers))?;
        named("foxglove door").spawn(move || door::serve_clients(&listener, &*of_door, &begun))?;
        Ok(Self { state })
    }

    pub(super) fn hub(&self) -> Arc<MessageHub> {
        Arc::clone(&self.state.hub)
    }
}

impl Drop for FoxgloveServer {
    fn drop(&mut self) {
        self.state.stop.store(true, Ordering::Relaxed);
    }
}

impl DoorKeeper for FoxgloveState {
    const MAX_CLIENTS: usize = MAX_VIEWERS;
    const FULL: RefusalReason = RefusalReason::ViewersFull;
    const THREAD_NAME: &'static str = "foxglove viewer";

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn count_refusal(&self) {}

    fn served(&self) -> &AtomicUsize {
        &self.viewers
    }

    fn answer(&self, head: &[u8]) -> Option<HttpResponse> {
        let request = str::from_utf8(head).ok().and_then(Request::parse);
        let refused = match &request {
            None => Some(RefusalReason::Malformed),
            Some(request) => refusal(request, self.address, self.token.as_ref()),
        };
        refused.map(HttpResponse::from_refusal)
    }

    fn serve(&self, begun: PrefixedStream, number: u64) {
        let _ = serve_viewer(begun, number, &self.hub, &self.stop);
    }
}

/// Returns the reason why a request for the WebSocket is refused, if there is one.
///
/// Any web page can connect to this machine from its visitor's browser, and could read the robot's data. A browser says
/// which site a page is from, so without a token only sites that are viewers may connect. Programs other than browsers
/// need no origin: they run on this machine and could read the buses themselves.
fn refusal(request: &Request, address: SocketAddr, token: Option<&Token>) -> Option<RefusalReason> {
    if !request.names_host(address) {
        return Some(RefusalReason::ViewerElsewhere);
    }
    match token {
        Some(_) if !request.has_token(token) => return Some(RefusalReason::ViewerUnknown),
        None if !request.origin.as_deref().is_none_or(is_viewer_origin) => {
            return Some(RefusalReason::ViewerElsewhere);
        }
        Some(_) | None => {}
    }
    (!request.is_upgrade).then_some(RefusalReason::NoViewer)
}

/// Returns true for the origins of viewers: Foxglove's own site, its desktop program (a local file), and pages that
/// this machine serves, such as Lichtblick. A page that hides its origin (`null`) may be from any site.
fn is_viewer_origin(origin: &str) -> bool {
    if origin == "file://" {
        return true;
    }
    let Some((scheme, place)) = origin.split_once("://") else { return false };
    let is_port = |port: &str| !port.is_empty() && port.bytes().all(|byte| byte.is_ascii_digit());
    let is_foxglove = scheme == "https" && (place == "foxglove.dev" || place.ends_with(".foxglove.dev"));
    let is_local = ["localhost", "127.0.0.1", "[::1]"].iter().any(|host| {
        place
            .strip_prefix(host)
            .is_some_and(|rest| rest.is_empty() || rest.strip_prefix(':').is_some_and(is_port))
    });
    is_foxglove || (is_local && matches!(scheme, "http" | "https"))
}

/// Returns the address that viewers connect to.
#[must_use]
pub fn foxglove_url(address: SocketAddr, token: Option<&Token>) -> String {
    let query = token.map_or_else(String::new, |token| format!("/?token={}", token.as_str()));
    format!("ws://{address}{query}")
}

#[cfg(test)]
mod tests {
    use super::*;

    const ADDRESS: &str = "127.0.0.1:8765";

    fn answer(target: &str, lines: &str, token: Option<&Token>) -> Option<RefusalReason> {
        let head = format!("GET {target} HTTP/1.1\r\n{lines}\r\n");
        refusal(&Request::parse(&head).unwrap(), ADDRESS.parse().unwrap(), token)
    }

    #[test]
    fn pages_of_other_sites_are_refused_and_viewers_are_not() {
        let with = |origin: &str| {
            let lines = format!("Host: localhost:8765\r\nUpgrade: websocket\r\nOrigin: {origin}\r\n");
            answer("/", &lines, None)
        };
        for viewer in [
            "https://app.foxglove.dev",
            "https://foxglove.dev",
            "http://localhost:8080",
            "http://127.0.0.1",
            "https://[::1]:3000",
            "file://",
        ] {
            assert_eq!(with(viewer), None, "{viewer}");
        }
        for other in [
            "null",
            "https://evil.example",
            "http://app.foxglove.dev",
            "https://evilfoxglove.dev",
            "https://foxglove.dev.evil.example",
            "http://localhost.evil.example",
            "http://localhost:8080@evil.example",
            "http://localhost:",
            "file://evil.example",
            "localhost",
            "",
        ] {
            assert_eq!(with(other), Some(RefusalReason::ViewerElsewhere), "{other}");
        }
    }

    #[test]
    fn the_host_is_this_machine_and_a_token_is_enough_for_any_site() {
        let upgrade = "Upgrade: websocket\r\n";
        let at = |host: &str| answer("/", &format!("Host: {host}\r\n{upgrade}"), None);
        assert_eq!([at("localhost:8765"), at("127.0.0.1:8765")], [None, None]);
        assert_eq!(at("evil.example:8765"), Some(RefusalReason::ViewerElsewhere), "a rebound name");
        assert_eq!(answer("/", "Host: localhost:8765\r\n", None), Some(RefusalReason::NoViewer));
        let token = Token::parse("abcdef0123456789").unwrap();
        let lines = format!("Host: localhost:8765\r\n{upgrade}Origin: https://my.example\r\n");
        assert_eq!(answer("/?token=abcdef0123456789", &lines, Some(&token)), None);
        assert_eq!(answer("/", &lines, Some(&token)), Some(RefusalReason::ViewerUnknown));
        let lines = format!("Host: localhost:8765\r\n{upgrade}");
        assert_eq!(answer("/?token=no", &lines, Some(&token)), Some(RefusalReason::ViewerUnknown));
        assert_eq!(foxglove_url(ADDRESS.parse().unwrap(), None), "ws://127.0.0.1:8765");
        let url = foxglove_url(ADDRESS.parse().unwrap(), Some(&token));
        assert_eq!(url, "ws://127.0.0.1:8765/?token=abcdef0123456789");
    }
}
