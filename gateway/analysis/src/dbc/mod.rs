//! A skin's bus as a DBC file, for tools that know nothing of this protocol.
//!
//! ```text
//!   Skin, one of its buses ──> messages, each with its signals ──> text
//! ```
//!
//! Every identifier of the bus is a message, every field of a packet a signal with its scale, unit and range;
//! where byte 13 says what the words are, it multiplexes them. Angles are in rad, whose step is pi / 2^15: exact to the
//! last bit of a double.
//!
//! What cells say over simulated wires is not in it: these frames are on no real bus, and their identifiers number
//! wires and not cells. `gateway dump` shows them.
//!
//! A DBC knows nothing of the CRC beyond its place, nor that a packet on a classic bus travels in two frames
//! under one identifier. For a classic bus the text describes packets, for programs that join the frames first.

mod layout;
mod signal;
mod text;

use protocol::can::Format;
use protocol::id::{Command, Id, Kind, Node};
use protocol::skin::{Bus, Skin};

use signal::Signal;

/// How often a cell says that it is there, in ms.
const HEARTBEAT_MS: u32 = 250;

/// The DBC of one bus, an index into [`Skin::buses`]; of one that does not exist, an empty text.
///
/// # Panics
/// Never: a string takes whatever is written.
#[must_use]
pub fn dbc(skin: &Skin, bus: usize) -> String {
    let mut out = String::new();
    if let Some(description) = skin.buses.get(bus) {
        text::write(&mut out, skin, bus, description, &messages(skin, bus))
            .expect("a string takes whatever is written");
    }
    out
}

/// Who sends or receives.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Party {
    Gateway,
    Cell(u8),
    /// All cells of the bus.
    Cells,
    /// Nobody whom the skin names.
    Unnamed,
}

/// When a message is sent.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Rhythm {
    /// When there is reason to.
    Seldom,
    /// So many ms after the last.
    Every(u32),
    /// The same, while the cell is in contact.
    WhileActive(u32),
}

/// One identifier of the bus.
#[derive(Clone, Debug, PartialEq)]
struct Message {
    id: Id,
    name: String,
    from: Party,
    to: Party,
    rhythm: Rhythm,
    comment: &'static str,
    signals: Vec<Signal>,
}

/// All messages of a bus, by identifier.
fn messages(skin: &Skin, bus: usize) -> Vec<Message> {
    let period = Rhythm::Every(period_ms(skin));
    let mut all: Vec<_> = Command::ALL.into_iter().map(|command| commanded(command, period)).collect();
    let nodes = || {
        let mut nodes: Vec<_> = skin.cells_of(bus).map(|cell| cell.node).collect();
        nodes.sort_unstable();
        nodes
    };
    for kind in Kind::ALL.into_iter().filter(|kind| *kind != Kind::Command) {
        if kind == Kind::Network {
            all.push(Message {
                from: Party::Gateway,
                to: Party::Unnamed,
                rhythm: Rhythm::Seldom,
                comment: "Another gateway: none has to send this, whoever hears it knows of it.",
                ..from_or_to(kind, Node::Gateway, period)
            });
        }
        all.extend(nodes().into_iter().map(|cell| from_or_to(kind, Node::Cell(cell), period)));
        if matches!(kind, Kind::Configure | Kind::Stimulus) {
            all.push(Message { to: Party::Cells, ..from_or_to(kind, Node::Everyone, period) });
        }
    }
    all
}

fn commanded(command: Command, period: Rhythm) -> Message {
    let (signals, rhythm, comment) = match command {
        Command::Halt => (layout::bare(), Rhythm::Seldom, "Stop answering joints until a resume."),
        Command::Joints => (
            layout::joints(),
            period,
            "The robot's joint positions; count is the joints in use, the others are 0. Cells in contact answer \
             with their torque.",
        ),
        Command::Sync => (
            layout::bare(),
            Rhythm::Seldom,
            "Every cell answers with a heartbeat when all that the last joints asked is done.",
        ),
        Command::Resume => (layout::bare(), Rhythm::Seldom, "Leave the halted state."),
        Command::Report => {
            (layout::bare(), Rhythm::Seldom, "Every cell answers with its pages of counters and sensors.")
        }
    };
    let (id, name) = (Id::command(command), command.name().to_owned());
    Message { id, name, from: Party::Gateway, to: Party::Cells, rhythm, comment, signals }
}

/// What a cell says of this kind, or what is said to it.
fn from_or_to(kind: Kind, node: Node, period: Rhythm) -> Message {
    let cell = Party::Cell(node.to_byte());
    let (up, down) = ((cell, Party::Gateway), (Party::Gateway, cell));
    let active = match period {
        Rhythm::Every(ms) | Rhythm::WhileActive(ms) => Rhythm::WhileActive(ms),
        Rhythm::Seldom => Rhythm::Seldom,
    };
    let ((from, to), rhythm, signals, comment) = match kind {
        Kind::Command => (down, Rhythm::Seldom, layout::bare(), ""),
        Kind::Sum => (
            up,
            Rhythm::Seldom,
            layout::sum(),
            "The cell's torques and those of the cells below it in the tree, answering the joints of this epoch, where \
             a bus replies with sums. count is the cells in it that feel something, 0 the end of a contact; of two for \
             one epoch the one with more cells counts.",
        ),
        Kind::Torque => (
            up,
            active,
            layout::torque(),
            "The cell's torques about joints 1 to 6, answering the joints of this epoch; sent while in contact, and \
             once with zeros when the contact ends.",
        ),
        Kind::Sensors => (up, Rhythm::Seldom, layout::sensors(), "What the cell measures, by page."),
        Kind::Network => (
            up,
            Rhythm::Every(HEARTBEAT_MS),
            layout::network(),
            "Page 0: heartbeat, four times a second and after each sync. Pages 1 to 4: counters modulo 65536, the \
             place in the tree, the ports; on report, and page 3 when the parent changes. epoch is that of the last \
             joints taken.",
        ),
        Kind::Configure => (
            down,
            Rhythm::Seldom,
            layout::configure(),
            "Reads a parameter, or writes its staged copy, which a commit with the right hash takes into use. The \
             tag comes back in the answer.",
        ),
        Kind::Configured => (
            up,
            Rhythm::Seldom,
            layout::configured(),
            "The answer to configure: the value in force or written, or a refusal.",
        ),
        Kind::Stimulus => (
            down,
            Rhythm::Seldom,
            layout::stimulus(),
            "What a cell in test mode shall feel, from the joints of this epoch on or from the next ones.",
        ),
    };
    let name = format!("{}_{node}", kind.name());
    Message { id: Id::new(kind, node), name, from, to, rhythm, comment, signals }
}

/// The period of the joint broadcast in whole ms, as a DBC has it.
#[expect(
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "1 to 65.5 ms: the skin is checked"
)]
fn period_ms(skin: &Skin) -> u32 {
    (1e3 / skin.timing.broadcast_hz()).round() as u32
}

/// What a bus' DBC describes: its frames, or the packets that are made of them.
const fn are_packets(bus: &Bus) -> bool {
    matches!(bus.format, Format::Classic)
}

#[cfg(test)]
mod tests;
