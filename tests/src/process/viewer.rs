//! A client of Foxglove's WebSocket protocol, written from its specification.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::net::{SocketAddr, TcpStream};
use std::time::Instant;

use rustix::net::sockopt::set_socket_recv_buffer_size;
use rustix::net::{AddressFamily, SocketType, connect, socket};
use serde_json::{Value, json};
use tungstenite::{Error, Message, WebSocket};

use super::page::{announced_url, shake_hands};
use super::{Running, TIMEOUT};

/// The size of the receive buffer of a viewer's socket, in bytes: small, so that a viewer that sleeps is noticed soon.
const RECEIVE_BUFFER_BYTES: usize = 8 << 10;

/// A connected viewer, and the channels that the server has advertised.
pub struct Viewer {
    pub socket: WebSocket<TcpStream>,
    pub info: Value,
    pub channels: BTreeMap<u64, Value>,
    /// The status messages so far.
    pub status: Vec<Value>,
    /// The last time that the server has told, in ns since 1970.
    pub time: Option<u64>,
}

/// A message of a topic.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct TopicMessage {
    pub topic: String,
    pub nanos: u64,
    pub message: Vec<u8>,
}

/// Returns the address that a view reports for viewers, such as `ws://127.0.0.1:8765`.
pub fn viewer_url(served: &Running) -> String {
    announced_url(served, "foxglove", "ws")
}

/// Requests a WebSocket with these headers.
pub fn request(url: &str, headers: &[(&'static str, &str)]) -> Result<WebSocket<TcpStream>, Error> {
    let host: SocketAddr = url.strip_prefix("ws://").unwrap().split('/').next().unwrap().parse().unwrap();
    let connected = socket(AddressFamily::INET, SocketType::STREAM, None).unwrap();
    set_socket_recv_buffer_size(&connected, RECEIVE_BUFFER_BYTES).unwrap();
    connect(&connected, &host).unwrap();
    Ok(shake_hands(TcpStream::from(connected), url, headers)?.0)
}

impl Viewer {
    /// Connects a viewer that has subscribed to nothing.
    pub fn new(url: &str) -> Self {
        Self::attempt(url).unwrap()
    }

    /// Connects a viewer, unless it is refused.
    pub fn attempt(url: &str) -> Result<Self, Error> {
        let socket = request(url, &[("Sec-WebSocket-Protocol", "foxglove.websocket.v1")])?;
        let mut viewer =
            Self { socket, info: Value::Null, channels: BTreeMap::new(), status: Vec::new(), time: None };
        while viewer.info.is_null() || viewer.channels.is_empty() {
            assert_eq!(viewer.read()?, None);
        }
        Ok(viewer)
    }

    /// Subscribes to all channels, with other numbers than those of the channels.
    pub fn subscribe_to_all(&mut self) {
        let all = self.channels.keys().map(|id| json!({"id": 1_000 + id, "channelId": id}));
        let text = json!({"op": "subscribe", "subscriptions": all.collect::<Vec<_>>()}).to_string();
        self.send(&text);
    }

    pub fn send(&mut self, text: &str) {
        self.socket.send(Message::text(text)).unwrap();
    }

    /// Returns the definition of the type of a topic.
    pub fn definition(&self, topic: &str) -> &str {
        let channel = self.channels.values().find(|channel| channel["topic"] == topic).unwrap();
        channel["schema"].as_str().unwrap()
    }

    /// Reads one message; returns it if it is one of a topic.
    pub fn read(&mut self) -> Result<Option<TopicMessage>, Error> {
        let message = loop {
            match self.socket.read() {
                Err(Error::Io(error)) if error.kind() == ErrorKind::Interrupted => {}
                message => break message?,
            }
        };
        match message {
            Message::Text(text) => {
                let said: Value = serde_json::from_str(text.as_str()).unwrap();
                match said["op"].as_str().unwrap() {
                    "serverInfo" => self.info = said,
                    "advertise" => {
                        let channels = said["channels"].as_array().unwrap().iter().cloned();
                        self.channels.extend(channels.map(|it| (it["id"].as_u64().unwrap(), it)));
                    }
                    "status" => self.status.push(said),
                    other => panic!("{other}"),
                }
                Ok(None)
            }
            Message::Binary(bytes) => {
                let nanos = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
                match bytes[0] {
                    1 => {
                        let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                        let topic =
                            self.channels[&u64::from(id - 1_000)]["topic"].as_str().unwrap().to_owned();
                        Ok(Some(TopicMessage { topic, nanos: nanos(5), message: bytes[13..].to_vec() }))
                    }
                    2 => {
                        self.time = Some(nanos(1));
                        Ok(None)
                    }
                    other => panic!("operation code {other}"),
                }
            }
            other => panic!("{other:?}"),
        }
    }

    /// Reads until a condition holds, and returns the messages of topics.
    pub fn read_until(
        &mut self,
        what: &str,
        mut is: impl FnMut(&Self, &[TopicMessage]) -> bool,
    ) -> Vec<TopicMessage> {
        let (give_up, mut all) = (Instant::now() + TIMEOUT, Vec::new());
        while !is(self, &all) {
            assert!(Instant::now() < give_up, "not there after {TIMEOUT:?}: {what}");
            all.extend(self.read().unwrap());
        }
        all
    }
}
