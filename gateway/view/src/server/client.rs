//! One client: a file, or a page that stays.

use std::io::{self, Cursor, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpStream};
use std::sync::atomic::Ordering;
use std::time::Duration;

use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket, accept_with_config};

use super::Shared;
use super::request::{LONGEST, Request};
use crate::command::{self, Command};
use crate::locked;
use crate::web;

/// How long a client may take for its request, and to take in what it is sent.
const TIMEOUT: Duration = Duration::from_secs(5);
/// How long a page's message is waited for, before the next snapshot is looked for.
const LOOK: Duration = Duration::from_millis(15);
/// Messages that are read at once.
const AT_ONCE: usize = 64;

/// Nothing from elsewhere, and no other page around it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// A stream of which the beginning has been read.
#[derive(Debug)]
struct Begun {
    head: Cursor<Vec<u8>>,
    stream: TcpStream,
}

impl Read for Begun {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self.head.read(buffer)? {
            0 => self.stream.read(buffer),
            read => Ok(read),
        }
    }
}

impl Write for Begun {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.stream.write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// Serves a client until it goes.
pub(super) fn serve(stream: TcpStream, page: u64, shared: &Shared) {
    let end = stream.try_clone();
    if handle(stream, page, shared).is_err() {
        // It is gone, or took too long.
    }
    if let Ok(end) = end {
        let _ = end.shutdown(Shutdown::Both);
    }
}

fn handle(mut stream: TcpStream, page: u64, shared: &Shared) -> io::Result<()> {
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(TIMEOUT))?;
    stream.set_write_timeout(Some(TIMEOUT))?;
    let head = head(&mut stream)?;
    let request = str::from_utf8(&head).ok().and_then(Request::parse);
    let allowed = request.filter(|request| request.is_allowed(&shared.access, shared.port));
    let Some(request) = allowed else {
        shared.refused.fetch_add(1, Ordering::Relaxed);
        return answer(
            &mut stream,
            "403 Forbidden",
            "text/plain; charset=utf-8",
            b"403: not for this host, origin or token\n",
        );
    };
    if request.is_upgrade && request.path == "/live" {
        return live(Begun { head: Cursor::new(head), stream }, page, shared);
    }
    if request.path == "/surface" {
        return answer(&mut stream, "200 OK", "application/octet-stream", &shared.surface);
    }
    match web::file(&request.path) {
        Some((kind, bytes)) => answer(&mut stream, "200 OK", kind, bytes),
        None => {
            shared.refused.fetch_add(1, Ordering::Relaxed);
            answer(&mut stream, "404 Not Found", "text/plain; charset=utf-8", b"404: no such file\n")
        }
    }
}

/// The bytes up to the end of a request's head.
fn head(stream: &mut TcpStream) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    let mut piece = [0; 1024];
    while !head.windows(4).any(|end| end == b"\r\n\r\n") {
        let read = stream.read(&mut piece)?;
        if read == 0 || head.len() + read > LONGEST {
            return Err(ErrorKind::InvalidData.into());
        }
        head.extend(piece.iter().take(read));
    }
    Ok(head)
}

fn answer(stream: &mut TcpStream, status: &str, kind: &str, bytes: &[u8]) -> io::Result<()> {
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {}\r\nConnection: close\r\nCache-Control: no-store\r\n\
         Content-Security-Policy: {POLICY}\r\nX-Content-Type-Options: nosniff\r\nReferrer-Policy: no-referrer\r\n\
         Cross-Origin-Resource-Policy: same-origin\r\n\r\n",
        bytes.len()
    );
    stream.write_all(head.as_bytes())?;
    stream.write_all(bytes)?;
    stream.flush()
}

/// A page that stays: it gets the newest, and may send commands.
fn live(begun: Begun, page: u64, shared: &Shared) -> io::Result<()> {
    let config = WebSocketConfig::default()
        .max_message_size(Some(command::LONGEST))
        .max_frame_size(Some(command::LONGEST))
        .write_buffer_size(0)
        .max_write_buffer_size(64 << 20);
    let Ok(mut socket) = accept_with_config(begun, Some(config)) else {
        shared.refused.fetch_add(1, Ordering::Relaxed);
        return Ok(());
    };
    shared.clients.fetch_add(1, Ordering::Relaxed);
    let ended = talk(&mut socket, page, shared);
    locked(&shared.chosen).remove(&page);
    locked(&shared.gone).push(page);
    if ended.is_ok() {
        let _ = socket.close(None);
        let _ = socket.flush();
    }
    Ok(())
}

fn talk(socket: &mut WebSocket<Begun>, page: u64, shared: &Shared) -> Result<(), Error> {
    socket.send(Message::text(shared.scene.as_str()))?;
    socket.get_ref().stream.set_read_timeout(Some(LOOK))?;
    let (mut sent, mut said_number, mut jumps) = (0, 0, 0);
    while !shared.stop.load(Ordering::Relaxed) {
        let (history, snapshot, said) = {
            let newest = locked(&shared.newest);
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
        for _ in 0..AT_ONCE {
            match socket.read() {
                Ok(Message::Text(text)) => take(text.as_str(), page, shared),
                Ok(Message::Close(_)) => return Ok(()),
                Ok(Message::Binary(_)) => _ = shared.ignored.fetch_add(1, Ordering::Relaxed),
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => {}
                // A program that was stopped goes on with an interrupted call.
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

/// A page's message.
fn take(text: &str, page: u64, shared: &Shared) {
    let ignore = || _ = shared.ignored.fetch_add(1, Ordering::Relaxed);
    match Command::parse(text) {
        None => ignore(),
        Some(command) if command.acts() && !shared.access.may_act => ignore(),
        Some(command) if command.plays() && !shared.access.may_play => ignore(),
        Some(Command::Choose(chosen)) => _ = locked(&shared.chosen).insert(page, chosen),
        Some(Command::Unchoose) => _ = locked(&shared.chosen).remove(&page),
        Some(command) => {
            if shared.commands.try_send((page, command)).is_err() {
                ignore();
            }
        }
    }
}
