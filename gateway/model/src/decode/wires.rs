//! Text of messages over wires.

use core::fmt::{self, Display, Formatter};

use protocol::message::VERSION;
use protocol::packet::{Bytes, PACKET_BYTES};
use protocol::port::{Hello, LinkId, NodeIdWalk, PortMessage, TreeRank};
use protocol::schema::{self, Layout};

use super::fields::write_layout;
use super::ports::PortName;

/// Encodes a message over a wire. Returns the bytes and the layout of their fields.
pub(super) fn encode_with_layout(message: PortMessage) -> (Bytes, &'static Layout) {
    let body = message.encode();
    let bytes = body.into_iter().chain([0; PACKET_BYTES]).take(PACKET_BYTES).collect();
    (
        bytes,
        schema::wire_layouts()
            .iter()
            .find(|layout| layout.number == body[0])
            .expect("every message has a layout"),
    )
}

pub(super) const fn message_epoch(message: PortMessage) -> Option<u8> {
    if let PortMessage::State(epoch) | PortMessage::Nack(epoch) = message { Some(epoch.0) } else { None }
}

/// A message over a wire, formatted with the wire's number and direction: `wire 12 ->: join`.
pub(super) struct WireText(pub(super) LinkId, pub(super) PortMessage);

impl Display for WireText {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(LinkId { wire, back }, message) = *self;
        let (bytes, layout) = encode_with_layout(message);
        write!(f, "wire {wire} {}: {}", if back { "<-" } else { "->" }, layout.name)?;
        if let PortMessage::Hello(hello) = message {
            return write_hello(f, hello);
        }
        if let PortMessage::Return(NodeIdWalk { walk, first, last }) = message {
            write!(f, ", walk {walk}, ")?;
            return if first > last {
                f.write_str("none remaining")
            } else {
                write!(f, "{first} to {last} remaining")
            };
        }
        write_layout(f, layout, &bytes)
    }
}

fn write_hello(f: &mut Formatter<'_>, hello: Hello) -> fmt::Result {
    let Hello { version, number, port, receives: hears, is_parent: up, unnumbered, rank } = hello;
    if version != VERSION {
        write!(f, ", version {version}")?;
    }
    match number {
        0 => f.write_str(", no node id")?,
        number => write!(f, ", node id {number}")?,
    }
    write!(f, ", {}", PortName(i64::from(port)))?;
    for (set, word) in [(hears, "receives"), (up, "sends sums here"), (unnumbered, "a cell lacks a node id")]
    {
        if set {
            write!(f, ", {word}")?;
        }
    }
    write!(f, ", {}", RankText(rank))
}

/// The rank of a cell as text; `None` for a cell without a route.
struct RankText(Option<TreeRank>);

impl Display for RankText {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(TreeRank { round, depth }) => write!(f, "round {round} depth {depth}"),
            None => f.write_str("unreachable"),
        }
    }
}
