//! A connected page. Its thread sends the newest messages to it, and receives its commands.

use std::io::{self, Cursor, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::Ordering;
use std::time::Duration;

use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket, accept_with_config};

use super::ServerState;
use crate::command::ControlCommand;
use crate::lock_ignoring_poison;
use crate::page_command::{MAX_MESSAGE_BYTES, PageCommand, SelectionCommand};

/// The time within which a page must receive each piece of a message.
const MESSAGE_TIMEOUT: Duration = Duration::from_secs(5);
/// The time for which the thread waits for a message from the page before it checks for a new snapshot.
const POLL_INTERVAL: Duration = Duration::from_millis(15);
/// The maximum number of messages that are read from the page before the next snapshot.
const MAX_MESSAGES_AT_ONCE: usize = 64;

/// A stream whose first bytes, the head of a request, were already read.
#[derive(Debug)]
pub(crate) struct PrefixedStream {
    head: Cursor<Vec<u8>>,
    stream: TcpStream,
}

impl PrefixedStream {
    pub(crate) const fn new(head: Vec<u8>, stream: TcpStream) -> Self {
        Self { head: Cursor::new(head), stream }
    }

    pub(crate) fn into_stream(self) -> TcpStream {
        self.stream
    }

    pub(crate) const fn stream(&self) -> &TcpStream {
        &self.stream
    }
}

impl Read for PrefixedStream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.head.read(buffer)? {
            0 => self.stream.read(buffer),
            read => Ok(read),
        }
    }
}

impl Write for PrefixedStream {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.stream.write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// Serves a page until it disconnects, or receives messages too slowly.
pub(super) fn serve_page(begun: PrefixedStream, page: u64, shared: &ServerState) {
    let _ = serve_websocket(begun, page, shared);
}

fn serve_websocket(begun: PrefixedStream, page: u64, shared: &ServerState) -> io::Result<()> {
    let stream = &begun.stream;
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(MESSAGE_TIMEOUT))?;
    stream.set_write_timeout(Some(MESSAGE_TIMEOUT))?;
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE_BYTES))
        .max_frame_size(Some(MAX_MESSAGE_BYTES))
        .write_buffer_size(0)
        .max_write_buffer_size(64 << 20);
    let Ok(mut socket) = accept_with_config(begun, Some(config)) else {
        shared.refused.fetch_add(1, Ordering::Relaxed);
        return Ok(());
    };
    shared.clients.fetch_add(1, Ordering::Relaxed);
    let ended = exchange_messages(&mut socket, page, shared);
    lock_ignoring_poison(&shared.chosen).remove(&page);
    if shared.access.may_act {
        // In the queue, the release follows the page's last press.
        let release = PageCommand::Control(ControlCommand::Release { cell: None });
        let _ = shared.commands.send((page, release));
    }
    if ended.is_ok() {
        let _ = socket.close(None);
        let _ = socket.flush();
    }
    let _ = socket.get_ref().stream.shutdown(Shutdown::Both);
    Ok(())
}

fn exchange_messages(
    socket: &mut WebSocket<PrefixedStream>,
    page: u64,
    shared: &ServerState,
) -> Result<(), Error> {
    socket.send(Message::text(shared.scene.as_str()))?;
    socket.get_ref().stream.set_read_timeout(Some(POLL_INTERVAL))?;
    let (mut sent, mut said_number, mut jumps) = (0, 0, 0);
    while !shared.stop.load(Ordering::Relaxed) {
        let (history, snapshot, said) = {
            let newest = lock_ignoring_poison(&shared.newest);
            let history = (newest.jumps != jumps).then(|| newest.history.clone());
            let snapshot = (newest.number != sent).then(|| newest.snapshot.clone());
            let own = newest.own.get(&page).unwrap_or(&newest.said);
            let said = (newest.said_number != said_number).then(|| own.clone());
            (sent, said_number, jumps) = (newest.number, newest.said_number, newest.jumps);
            (history, snapshot, said)
        };
        for bytes in [history, snapshot].into_iter().flatten() {
            socket.send(Message::Binary(bytes))?;
        }
        if let Some(said) = said {
            socket.send(Message::Text(said))?;
        }
        for _ in 0..MAX_MESSAGES_AT_ONCE {
            match socket.read() {
                Ok(Message::Text(text)) => handle_message(text.as_str(), page, shared),
                Ok(Message::Close(_)) => return Ok(()),
                Ok(Message::Binary(_)) => _ = shared.ignored.fetch_add(1, Ordering::Relaxed),
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => {}
                // A signal such as SIGCONT has interrupted the read, which is repeated.
                Err(Error::Io(error))
                    if matches!(
                        error.kind(),
                        ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted
                    ) =>
                {
                    break;
                }
                Err(error) => return Err(error),
            }
        }
    }
    Ok(())
}

/// Handles a message that a page has sent.
fn handle_message(text: &str, page: u64, shared: &ServerState) {
    let ignore = || _ = shared.ignored.fetch_add(1, Ordering::Relaxed);
    match PageCommand::parse(text) {
        None => ignore(),
        Some(PageCommand::Select(SelectionCommand::Choose(chosen))) => {
            _ = lock_ignoring_poison(&shared.chosen).insert(page, chosen);
        }
        Some(PageCommand::Select(SelectionCommand::Unchoose {})) => {
            _ = lock_ignoring_poison(&shared.chosen).remove(&page);
        }
        Some(PageCommand::Control(_)) if !shared.access.may_act => ignore(),
        Some(PageCommand::Playback(_)) if !shared.access.may_play => ignore(),
        // A full queue delays the page that fills it; a press or a halt of another page must not be lost.
        Some(command) => {
            if shared.commands.send((page, command)).is_err() {
                ignore();
            }
        }
    }
}
