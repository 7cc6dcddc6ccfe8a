//! The server of the page: HTTP for its files, and a WebSocket for what changes.
//!
//! Each client has a thread, and gets the newest snapshot whenever it can take one; a slow or stalled client holds up only its own. It is
//! refused unless it asks for this host, and comes from a page of this server.

mod client;
mod request;

use std::collections::BTreeMap;
use std::io;
use std::net::{SocketAddr, TcpListener};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

use tungstenite::{Bytes, Utf8Bytes};

use crate::command::{Chosen, Command};
use crate::locked;

/// Clients at the same time.
const CLIENTS: usize = 16;
/// Commands that wait; more are counted and dropped.
const COMMANDS: usize = 256;

/// Who may use the page, and for what.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct Access {
    /// Where the server listens.
    pub listen: SocketAddr,
    /// Whether pages may press cells, halt and resume, and command the bench.
    pub may_act: bool,
    /// Whether there is a recording that pages may play.
    pub may_play: bool,
    /// What every request has to carry, where others than this machine may come.
    pub token: Option<String>,
}

/// What the server has counted.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct Counts {
    /// Pages that were connected.
    pub clients: u64,
    /// Requests that were refused: another host or origin, no token, too many clients, no such file.
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
    /// The port that it listens on.
    port: u16,
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
    address: SocketAddr,
}

impl Server {
    /// Listens, and serves from now on. `scene` is the first message to every page, `surface` is what it gets as `/surface`.
    ///
    /// # Errors
    /// When the address cannot be listened on.
    pub fn start(access: Access, scene: String, surface: Vec<u8>) -> io::Result<Self> {
        let listener = TcpListener::bind(access.listen)?;
        let address = listener.local_addr()?;
        let (sender, commands) = sync_channel(COMMANDS);
        let shared = Arc::new(Shared {
            access,
            port: address.port(),
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
        let server = Self { shared: Arc::clone(&shared), commands, address };
        thread::Builder::new().name("view accept".to_owned()).spawn(move || accept(&listener, &shared))?;
        Ok(server)
    }

    /// Where it listens.
    #[must_use]
    pub const fn address(&self) -> SocketAddr {
        self.address
    }

    /// The page's address in a browser on this machine.
    #[must_use]
    pub fn url(&self) -> String {
        let token = self.shared.access.token.as_ref();
        let token = token.map_or_else(String::new, |token| format!("?token={token}"));
        format!("http://{}/{token}", self.address)
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
        // Wakes the thread that accepts.
        let _ = std::net::TcpStream::connect_timeout(&self.address, Duration::from_millis(200));
    }
}

fn accept(listener: &TcpListener, shared: &Arc<Shared>) {
    for (page, stream) in (0..).zip(listener.incoming()) {
        if shared.stop.load(Ordering::Relaxed) {
            return;
        }
        let Ok(stream) = stream else {
            // Out of files: the clients that are there go on.
            thread::sleep(Duration::from_millis(50));
            continue;
        };
        if shared.pages.fetch_add(1, Ordering::Relaxed) >= CLIENTS {
            shared.pages.fetch_sub(1, Ordering::Relaxed);
            shared.refused.fetch_add(1, Ordering::Relaxed);
            continue;
        }
        let of_thread = Arc::clone(shared);
        let started = thread::Builder::new().name(format!("view page {page}")).spawn(move || {
            client::serve(stream, page, &of_thread);
            of_thread.pages.fetch_sub(1, Ordering::Relaxed);
        });
        if started.is_err() {
            shared.pages.fetch_sub(1, Ordering::Relaxed);
        }
    }
}
