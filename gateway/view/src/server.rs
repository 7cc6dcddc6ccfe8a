//! The server of the page: HTTP for its files, and a WebSocket for what changes.
//!
//! Requests come through a door (`door.rs`), which opens to those that ask for this host, come from a page of this server, and
//! carry the token where there is one. Behind it each page has a thread, and gets the newest snapshot whenever it can take one; a
//! slow or stalled page holds up only its own.

mod answer;
mod door;
mod page;
mod request;

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;

use tungstenite::{Bytes, Utf8Bytes};

use crate::command::{Chosen, Command};
use crate::locked;
use crate::token::Token;

/// The most pages at the same time.
const PAGES: usize = 16;
/// Commands that wait; more are counted and dropped.
const COMMANDS: usize = 256;

/// The powers of the page, and the token that they need.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Access {
    /// Pages may press cells, halt and resume, and command the bench.
    pub may_act: bool,
    /// There is a recording that pages may play.
    pub may_play: bool,
    /// The token of all requests that ask for more than the page's code.
    pub token: Option<Token>,
}

/// What the server has counted.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Counts {
    /// Pages that were connected.
    pub clients: u64,
    /// Requests that were refused: another host or origin, no token, too slow or too many, no such file.
    pub refused: u64,
    /// Messages of pages that were no command, or not allowed, or for which there was no room.
    pub ignored: u64,
}

/// The newest of everything.
#[derive(Debug, Default)]
struct Newest {
    snapshot: Bytes,
    number: u64,
    /// What was before the first snapshot behind a jump, and how many there were.
    history: Bytes,
    jumps: u64,
    /// For pages without a chosen cell, and for those with one.
    said: Utf8Bytes,
    own: BTreeMap<u64, Utf8Bytes>,
    said_number: u64,
}

/// What all threads of the server share.
#[derive(Debug)]
struct Shared {
    access: Access,
    /// Where it listens.
    address: SocketAddr,
    scene: String,
    /// What is served as /surface.
    surface: Vec<u8>,
    newest: Mutex<Newest>,
    chosen: Mutex<BTreeMap<u64, Chosen>>,
    gone: Mutex<Vec<u64>>,
    commands: SyncSender<(u64, Command)>,
    stop: AtomicBool,
    pages: AtomicUsize,
    clients: AtomicU64,
    refused: AtomicU64,
    ignored: AtomicU64,
}

/// A running server; it ends with this value.
#[derive(Debug)]
pub struct Server {
    shared: Arc<Shared>,
    commands: Receiver<(u64, Command)>,
}

impl Server {
    /// Serves from now on whoever comes to `listener`. `scene` is the first message to every page, `surface` is what it gets as `/surface`.
    ///
    /// # Errors
    /// When that is no listener, or there is no thread for it.
    pub fn start(listener: TcpListener, access: Access, scene: String, surface: Vec<u8>) -> io::Result<Self> {
        listener.set_nonblocking(true)?;
        let address = listener.local_addr()?;
        let (sender, commands) = sync_channel(COMMANDS);
        let shared = Arc::new(Shared {
            access,
            address,
            scene,
            surface,
            newest: Mutex::default(),
            chosen: Mutex::default(),
            gone: Mutex::default(),
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
        named("view pages").spawn(move || door::open(begun, &of_pages))?;
        named("view door").spawn(move || door::serve(&listener, &shared, &pages))?;
        Ok(server)
    }

    /// Returns where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.shared.address
    }

    /// What is to be known before the next snapshot.
    pub fn publish_history(&self, history: Vec<u8>) {
        let mut newest = locked(&self.shared.newest);
        newest.jumps += 1;
        newest.history = history.into();
    }

    /// A new snapshot, and now and then what is said beside it: for pages without a chosen cell, and for the others.
    pub fn publish(&self, snapshot: Vec<u8>, said: Option<(String, BTreeMap<u64, String>)>) {
        let mut newest = locked(&self.shared.newest);
        newest.number += 1;
        newest.snapshot = snapshot.into();
        if let Some((said, own)) = said {
            newest.said_number += 1;
            newest.said = said.into();
            newest.own = own.into_iter().map(|(page, said)| (page, said.into())).collect();
        }
    }

    /// The commands that pages have sent, each with the page's number.
    pub fn commands(&self) -> impl Iterator<Item = (u64, Command)> + '_ {
        self.commands.try_iter()
    }

    /// Counts a command that is not carried out.
    pub fn ignore(&self) {
        self.shared.ignored.fetch_add(1, Ordering::Relaxed);
    }

    /// Pages that have gone since the last call.
    #[must_use]
    pub fn gone(&self) -> Vec<u64> {
        std::mem::take(&mut *locked(&self.shared.gone))
    }

    /// The cells that pages have chosen.
    #[must_use]
    pub fn chosen(&self) -> BTreeMap<u64, Chosen> {
        locked(&self.shared.chosen).clone()
    }

    /// Pages that are connected now.
    #[must_use]
    pub fn pages(&self) -> usize {
        self.shared.pages.load(Ordering::Relaxed)
    }

    /// What it has counted.
    #[must_use]
    pub fn counts(&self) -> Counts {
        let count = |count: &AtomicU64| count.load(Ordering::Relaxed);
        let Shared { clients, refused, ignored, .. } = &*self.shared;
        Counts { clients: count(clients), refused: count(refused), ignored: count(ignored) }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.stop.store(true, Ordering::Relaxed);
    }
}

/// Returns the page's address for a browser on the machine that listens there.
#[must_use]
pub fn url(listen: SocketAddr, token: Option<&Token>) -> String {
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
