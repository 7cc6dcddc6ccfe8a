//! A connected viewer. Its thread sends the messages of its queue, and never waits for the viewer while others do.

use std::io::{self, ErrorKind};
use std::net::Shutdown;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::http::{HeaderValue, StatusCode};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket, accept_hdr_with_config};

use super::hub::MessageHub;
use super::protocol::{ClientMessage, SUBPROTOCOLS};
use super::queue::QueuedMessage;
use crate::server::page::PrefixedStream;

/// The name of the header by which client and server agree on a subprotocol.
const SUBPROTOCOL_HEADER: &str = "Sec-WebSocket-Protocol";
/// The time within which the answer to the request must be sent.
const HANDSHAKE_TIMEOUT: Duration = Duration::from_secs(5);
/// The time after which a thread looks for new messages, if it has sent all.
const POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 10_000_000 };
/// The time for which a thread waits until a viewer that reads slowly can receive more.
const SLOW_POLL_INTERVAL: Timespec = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
/// The interval between reports of dropped messages.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);
/// The maximum number of messages that are sent, and that are read, before the other direction has its turn.
const MAX_MESSAGES_AT_ONCE: usize = 64;
/// The maximum length of a message from a viewer, in bytes.
const MAX_MESSAGE_BYTES: usize = 64 << 10;
/// The size of the send buffer of a viewer's socket, in bytes. What waits there cannot be replaced by newer messages.
const SEND_BUFFER_BYTES: usize = 256 << 10;

/// Serves a viewer until it disconnects.
pub(super) fn serve_viewer(
    begun: PrefixedStream,
    viewer: u64,
    hub: &MessageHub,
    stop: &AtomicBool,
) -> io::Result<()> {
    let stream = begun.stream();
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(HANDSHAKE_TIMEOUT))?;
    stream.set_write_timeout(Some(HANDSHAKE_TIMEOUT))?;
    let _ = rustix::net::sockopt::set_socket_send_buffer_size(stream, SEND_BUFFER_BYTES);
    let config = WebSocketConfig::default()
        .max_message_size(Some(MAX_MESSAGE_BYTES))
        .max_frame_size(Some(MAX_MESSAGE_BYTES))
        .write_buffer_size(0)
        .max_write_buffer_size(usize::MAX);
    let Ok(mut socket) = accept_hdr_with_config(begun, choose_subprotocol, Some(config)) else {
        return Ok(());
    };
    socket.get_ref().stream().set_nonblocking(true)?;
    hub.add_viewer(viewer);
    let ended = exchange_messages(&mut socket, viewer, hub, stop);
    hub.remove_viewer(viewer);
    if ended.is_ok() {
        let _ = socket.close(None);
        let _ = socket.flush();
    }
    let _ = socket.get_ref().stream().shutdown(Shutdown::Both);
    Ok(())
}

/// Answers with the first of this server's subprotocols that the viewer offers, or refuses it.
#[expect(clippy::result_large_err, reason = "the type is that of the WebSocket's library")]
fn choose_subprotocol(request: &Request, mut response: Response) -> Result<Response, ErrorResponse> {
    let offered = request.headers().get_all(SUBPROTOCOL_HEADER).iter();
    let offered: Vec<_> = offered
        .filter_map(|value| value.to_str().ok())
        .flat_map(|value| value.split(','))
        .map(str::trim)
        .collect();
    match SUBPROTOCOLS.into_iter().find(|known| offered.contains(known)) {
        Some(chosen) => {
            response.headers_mut().insert(SUBPROTOCOL_HEADER, HeaderValue::from_static(chosen));
            Ok(response)
        }
        None => {
            let [newer, older] = SUBPROTOCOLS;
            let why = format!("400: the viewer must offer the subprotocol {newer} or {older}\n");
            let mut refused = ErrorResponse::new(Some(why));
            *refused.status_mut() = StatusCode::BAD_REQUEST;
            Err(refused)
        }
    }
}

fn exchange_messages(
    socket: &mut WebSocket<PrefixedStream>,
    viewer: u64,
    hub: &MessageHub,
    stop: &AtomicBool,
) -> Result<(), Error> {
    let (mut is_blocked, mut reported) = (false, Instant::now());
    while !stop.load(Ordering::Relaxed) {
        if is_blocked {
            is_blocked = is_busy(socket.flush())?;
        }
        let mut sent = 0;
        while !is_blocked && sent < MAX_MESSAGES_AT_ONCE {
            let message = match hub.next_message(viewer) {
                Some(QueuedMessage::Text(text)) => Message::text(text),
                Some(QueuedMessage::Binary(bytes)) => Message::binary(bytes),
                None => break,
            };
            sent += 1;
            // A message that does not fit into the socket is kept by the WebSocket, and flushed later.
            is_blocked = is_busy(socket.send(message))?;
        }
        for _ in 0..MAX_MESSAGES_AT_ONCE {
            match socket.read() {
                Ok(Message::Text(text)) => hub.handle_message(viewer, ClientMessage::parse(text.as_str())),
                Ok(Message::Binary(_)) => {
                    let why = "binary messages are not supported: this server only sends".to_owned();
                    hub.handle_message(viewer, Err(why));
                }
                Ok(Message::Close(_)) => return Ok(()),
                Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_)) => {}
                Err(error) => {
                    is_busy(Err(error))?;
                    break;
                }
            }
        }
        if reported.elapsed() >= REPORT_INTERVAL {
            reported = Instant::now();
            hub.report_dropped(viewer);
        }
        if is_blocked || sent < MAX_MESSAGES_AT_ONCE {
            wait(socket, is_blocked);
        }
    }
    Ok(())
}

/// Waits until the viewer sends something or, if `is_blocked` is true, can receive more; or until new messages may be in
/// the queue.
fn wait(socket: &WebSocket<PrefixedStream>, is_blocked: bool) {
    let (flags, timeout) = if is_blocked {
        (PollFlags::IN | PollFlags::OUT, SLOW_POLL_INTERVAL)
    } else {
        (PollFlags::IN, POLL_INTERVAL)
    };
    // After an error the next read or write tells it.
    let _ = poll(&mut [PollFd::new(socket.get_ref().stream(), flags)], Some(&timeout));
}

/// Returns true if a socket can neither send nor receive more at present.
fn is_busy(done: Result<(), Error>) -> Result<bool, Error> {
    match done {
        Ok(()) => Ok(false),
        Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {
            Ok(true)
        }
        Err(error) => Err(error),
    }
}
