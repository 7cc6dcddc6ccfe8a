//! The server of the pages: HTTP for files, and a WebSocket for messages.
//!
//! The door (`door.rs`) reads all requests. It accepts a request that is addressed to this host, comes from a page of
//! this server, and carries the token if there is one. Each page then has a thread, which sends it the newest snapshot
//! whenever the page can receive one. A slow page therefore delays no other.

pub(crate) mod answer;
pub(crate) mod door;
pub(crate) mod page;
pub(crate) mod request;

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread;

use tungstenite::{Bytes, Utf8Bytes};

use self::answer::{HttpResponse, RefusalReason};
use self::door::DoorKeeper;
use self::page::PrefixedStream;
use crate::curves::RecordedCurves;
use crate::lock_ignoring_poison;
use crate::page_command::{PageCommand, SelectedCell};
use crate::token::Token;

/// The maximum number of pages at the same time.
const MAX_PAGES: usize = 16;
/// The maximum number of commands that wait to be executed. Pages that send more wait.
const COMMAND_QUEUE_SIZE: usize = 256;

/// The rights of the pages, and the token that they need.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct PageAccess {
    /// True if pages may press cells, halt and resume the robot, and control the bench.
    pub may_act: bool,
    /// True if pages may control the playback of a recording.
    pub may_play: bool,
    /// The token that every request must carry, except requests for scripts and styles.
    pub token: Option<Token>,
}

/// Counts of the server's clients and their requests.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct ServerCounts {
    /// The number of pages that have connected.
    pub clients: u64,
    /// The number of refused requests: for another host, from another site, without the token, too slow, too many, or
    /// for a missing file.
    pub refused: u64,
    /// The number of messages from pages that were not commands, or were not allowed.
    pub ignored: u64,
}

/// The newest messages for the pages.
#[derive(Debug, Default)]
struct LatestMessages {
    snapshot: Bytes,
    number: u64,
    /// The torques before the first snapshot after a jump, for the plots; and the number of jumps so far.
    history: Bytes,
    jumps: u64,
    /// The status for pages that have selected no cell, and the status for each of the other pages.
    said: Utf8Bytes,
    own: BTreeMap<u64, Utf8Bytes>,
    said_number: u64,
}

/// The state that all threads of the server share.
#[derive(Debug)]
struct ServerState {
    access: PageAccess,
    /// The address on which the server listens.
    address: SocketAddr,
    scene: String,
    /// The bytes served as `/surface`.
    surface: Vec<u8>,
    /// The source of `/curves` and `/events`; unset for a live view.
    recording: OnceLock<RecordedCurves>,
    newest: Mutex<LatestMessages>,
    chosen: Mutex<BTreeMap<u64, SelectedCell>>,
    commands: SyncSender<(u64, PageCommand)>,
    stop: AtomicBool,
    pages: AtomicUsize,
    clients: AtomicU64,
    refused: AtomicU64,
    ignored: AtomicU64,
}

impl DoorKeeper for ServerState {
    const MAX_CLIENTS: usize = MAX_PAGES;
    const FULL: RefusalReason = RefusalReason::Full;
    const THREAD_NAME: &'static str = "view page";

    fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    fn count_refusal(&self) {
        self.refused.fetch_add(1, Ordering::Relaxed);
    }

    fn served(&self) -> &AtomicUsize {
        &self.pages
    }

    fn answer(&self, head: &[u8]) -> Option<HttpResponse> {
        answer::answer_request(head, self)
    }

    fn serve(&self, begun: PrefixedStream, number: u64) {
        page::serve_page(begun, number, self);
    }
}

/// A running server. Dropping it stops its threads.
#[derive(Debug)]
pub struct Server {
    shared: Arc<ServerState>,
    commands: Receiver<(u64, PageCommand)>,
}

impl Server {
    /// Serves all clients that connect to `listener`. `scene` is the first message to every page, and `surface` is the
    /// file `/surface`.
    ///
    /// # Errors
    /// Returns an error if the listener cannot be set up, or if the system refuses a thread.
    pub fn start(
        listener: TcpListener,
        access: PageAccess,
        scene: String,
        surface: Vec<u8>,
    ) -> io::Result<Self> {
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (sender, commands) = sync_channel(COMMAND_QUEUE_SIZE);
        let shared = Arc::new(ServerState {
            access,
            address,
            scene,
            surface,
            recording: OnceLock::new(),
            newest: Mutex::default(),
            chosen: Mutex::default(),
            commands: sender,
            stop: AtomicBool::new(false),
            pages: AtomicUsize::new(0),
            clients: AtomicU64::new(0),
            refused: AtomicU64::new(0),
            ignored: AtomicU64::new(0),
        });
        let server = Self { shared: Arc::clone(&shared), commands };
        let (pages, begun) = channel();
        let of_pages = Arc::clone(&shared);
        let named = |name: &str| thread::Builder::new().name(name.to_owned());
        named("view pages").spawn(move || door::start_client_threads(begun, &of_pages))?;
        named("view door").spawn(move || door::serve_clients(&listener, &*shared, &pages))?;
        Ok(server)
    }

    /// Returns the address on which the server listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.shared.address
    }

    /// Sets the recording from which the pages get curves and events. Only the first call has an effect.
    pub fn set_recording(&self, recording: RecordedCurves) {
        let _ = self.shared.recording.set(recording);
    }

    /// Sends the pages the torques before the next snapshot, for the plots.
    pub fn publish_history(&self, history: Vec<u8>) {
        let mut newest = lock_ignoring_poison(&self.shared.newest);
        newest.jumps += 1;
        newest.history = history.into();
    }

    /// Sends the pages a snapshot, and the status if there is a new one. The status is given for pages that have
    /// selected no cell, and for each of the other pages by its number.
    pub fn publish_snapshot(&self, snapshot: Vec<u8>, said: Option<(String, BTreeMap<u64, String>)>) {
        let mut newest = lock_ignoring_poison(&self.shared.newest);
        newest.number += 1;
        newest.snapshot = snapshot.into();
        if let Some((said, own)) = said {
            newest.said_number += 1;
            newest.said = said.into();
            newest.own = own.into_iter().map(|(page, said)| (page, said.into())).collect();
        }
    }

    /// Returns the next commands of pages, each with the number of the page: at most as many as wait, so that a flood
    /// does not hold the caller. The last command of a page that may act is a release, when it disconnects.
    pub fn commands(&self) -> impl Iterator<Item = (u64, PageCommand)> + '_ {
        self.commands.try_iter().take(COMMAND_QUEUE_SIZE)
    }

    /// Counts a command that was not executed.
    pub fn count_ignored_command(&self) {
        self.shared.ignored.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns the cell that each page has selected, by the number of the page.
    #[must_use]
    pub fn selected_cells(&self) -> BTreeMap<u64, SelectedCell> {
        lock_ignoring_poison(&self.shared.chosen).clone()
    }

    /// Returns the number of pages that are connected now.
    #[must_use]
    pub fn page_count(&self) -> usize {
        self.shared.pages.load(Ordering::Relaxed)
    }

    /// Returns the counts so far.
    #[must_use]
    pub fn counts(&self) -> ServerCounts {
        let count = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let ServerState { clients, refused, ignored, .. } = &*self.shared;
        ServerCounts { clients: count(clients), refused: count(refused), ignored: count(ignored) }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

/// Returns the address by which a browser on the same machine opens the page.
#[must_use]
pub fn page_url(listen: SocketAddr, token: Option<&Token>) -> String {
    let ip = match listen.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip @ (IpAddr::V4(_) | IpAddr::V6(_)) => ip,
    };
    let query = token.map_or_else(String::new, |token| format!("?token={}", token.as_str()));
    format!("http://{}/{query}", SocketAddr::new(ip, listen.port()))
}

#[cfg(test)]
mod tests;
