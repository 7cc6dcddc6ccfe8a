//! Exports a skin's bus as a DBC file, for tools that do not know this protocol.
//!
//! ```text
//!   Skin, one of its buses ──> messages, each with its signals ──> text
//! ```
//!
//! Every identifier of the bus is a message, every field of a packet a signal with its scale, unit and range; where
//! byte 13 selects the meaning of the words, it multiplexes them. Angles are in rad, whose step is pi / 2^15: exact to
//! the last bit of a double.
//!
//! Frames of simulated wires are omitted: real buses do not have them, and their identifiers number wires instead of
//! cells. `skinbus dump` shows them.
//!
//! A DBC cannot express the CRC beyond its position, nor that a packet on a classic bus is sent in several frames with
//! one identifier. For a classic bus the text describes packets, for programs that join the frames first.

mod signal;
mod text;

use core::iter;

use protocol::can::Format;
use protocol::id::{Command, Id, Kind, Node};
use protocol::packet::{Length, Lengths};
use protocol::schema::{BusUnits, PacketSchema, packet_schemas};
use protocol::skin::{Skin, SkinBus};

use signal::Signal;

/// Period of heartbeats, in ms.
const HEARTBEAT_MS: u32 = 250;

/// Returns the DBC of one bus, given as an index into [`Skin::buses`]; an empty text if the bus does not exist.
///
/// # Panics
/// Never: writing to a string cannot fail.
#[must_use]
pub fn dbc_text(skin: &Skin, bus: usize) -> String {
    let mut out = String::new();
    if let Some(description) = skin.buses.get(bus) {
        text::write_dbc(&mut out, skin, bus, description, &messages(skin, bus))
            .expect("writing to a string cannot fail");
    }
    out
}

/// A sender or receiver of a message.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum DbcNode {
    Gateway,
    Cell(u8),
    /// All cells of the bus.
    Cells,
    /// A node that the skin does not contain.
    Unnamed,
}

/// The times at which a message is sent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum SendSchedule {
    /// The message is sent on events.
    OnEvent,
    /// The message is periodic, with the period in ms.
    Cyclic(u32),
    /// The message is periodic while the cell is in contact, with the period in ms.
    WhileActive(u32),
}

/// The DBC message of one identifier: its sender, receivers, schedule and signals.
#[derive(Clone, Debug, PartialEq)]
struct DbcMessage {
    id: Id,
    name: String,
    from: DbcNode,
    to: DbcNode,
    rhythm: SendSchedule,
    comment: &'static str,
    /// Length of the message's data.
    length: Length,
    signals: Vec<Signal>,
}

/// Returns all messages of a bus, by identifier.
fn messages(skin: &Skin, bus: usize) -> Vec<DbcMessage> {
    let mut nodes: Vec<_> = skin.cells_on_bus(bus).map(|cell| Node::Cell(cell.node)).collect();
    nodes.sort_unstable_by_key(|node| node.to_byte());
    let (units, rows) = (BusUnits::for_bus(skin, bus), skin.chain(bus).rows.len());
    let chain = signal::BusChain { length: skin.packet_length(bus), units, rows };
    let of = |schema: &'static PacketSchema| {
        let said = |node| dbc_message(schema, node, period_ms(skin), &chain);
        let each = nodes.iter().map(|node| said(*node));
        match schema.kind {
            Kind::Command => vec![said(Node::Everyone)],
            Kind::Network => {
                let (from, to, rhythm) = (DbcNode::Gateway, DbcNode::Unnamed, SendSchedule::OnEvent);
                let comment = "For several gateways on one bus: sending it is optional; receiving it shows that there is another gateway.";
                let other = DbcMessage { from, to, rhythm, comment, ..said(Node::Gateway) };
                iter::once(other).chain(each).collect()
            }
            Kind::Configure | Kind::Stimulus => {
                each.chain([DbcMessage { to: DbcNode::Cells, ..said(Node::Everyone) }]).collect()
            }
            Kind::Sum | Kind::Torque | Kind::Sensors | Kind::Configured => each.collect(),
        }
    };
    packet_schemas().iter().flat_map(of).collect()
}

/// Returns the DBC message for a kind of packet that a cell sends or receives, or for a command to all cells.
fn dbc_message(
    schema: &'static PacketSchema,
    node: Node,
    period_ms: u32,
    chain: &signal::BusChain,
) -> DbcMessage {
    let PacketSchema { kind, command, meaning, .. } = schema;
    let cell = if command.is_some() { DbcNode::Cells } else { DbcNode::Cell(node.to_byte()) };
    let (from, to) = if kind.is_from_cells() { (cell, DbcNode::Gateway) } else { (DbcNode::Gateway, cell) };
    let rhythm = match kind {
        Kind::Command if *command == Some(Command::Joints) => SendSchedule::Cyclic(period_ms),
        Kind::Torque => SendSchedule::WhileActive(period_ms),
        Kind::Network => SendSchedule::Cyclic(HEARTBEAT_MS),
        Kind::Command | Kind::Sum | Kind::Sensors | Kind::Configure | Kind::Configured | Kind::Stimulus => {
            SendSchedule::OnEvent
        }
    };
    let (id, name) = match command {
        Some(command) => (Id::command(*command), command.name().to_owned()),
        None => (Id::new(*kind, node), format!("{}_{node}", kind.name())),
    };
    let grows = Lengths::for_id(id) == Lengths::ALL;
    let length = if grows { chain.length } else { Length::Six };
    DbcMessage {
        id,
        name,
        from,
        to,
        rhythm,
        comment: meaning,
        length,
        signals: signal::packet_signals(schema, length, chain),
    }
}

/// Returns the period of the joint broadcast, rounded to whole ms as a DBC requires.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "1 to 65.5 ms: the skin is checked"
)]
fn period_ms(skin: &Skin) -> u32 {
    (1e3 / skin.timing.broadcast_hz()).round() as u32
}

/// Returns true if the DBC of a bus describes packets that are joined from several frames, false if it describes single
/// frames.
const fn describes_packets(bus: &SkinBus) -> bool {
    matches!(bus.format, Format::Classic)
}

#[cfg(test)]
mod tests;
