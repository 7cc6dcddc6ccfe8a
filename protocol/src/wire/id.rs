//! Identifiers of eleven bits, which contain the kind of a packet and a node.
//!
//! ```text
//!   bit   10 9 8 | 7 6 5 4 3 2 1 0
//!          kind  |  node, or the command
//! ```
//!
//! Identifiers are fixed per cell and kind, so that a kernel filter can match exactly one of them. The lower
//! identifier wins arbitration: halt and joints come first, then sums and torques.

use thiserror::Error;

/// The node id of a cell on its bus, 1 to 254. In the node field of an identifier, 0 is the gateway and 255 is
/// everyone.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
#[cfg_attr(feature = "host", derive(serde::Serialize))]
pub struct CellId(u8);

/// The error for a number that is not the node id of a cell.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("{got} is not a node id: use 1 to {max} (0 is the gateway, 255 is everyone)", max = CellId::MAX.0)]
pub struct CellIdOutOfRange {
    /// The number outside the range 1 to 254.
    pub got: i64,
}

/// The error for a text that is not the node id of a cell.
#[derive(Clone, Copy, Debug, Eq, Error, PartialEq)]
#[error("it must be a node id, 1 to 254")]
pub struct InvalidNodeId;

impl CellId {
    /// The largest node id of a cell.
    pub const MAX: Self = Self(254);
    /// The maximum number of cells on a bus.
    pub const COUNT: usize = 254;

    /// Creates a node id from a number.
    ///
    /// # Errors
    /// Returns an error if the number is not in the range 1 to 254.
    pub fn new(number: i64) -> Result<Self, CellIdOutOfRange> {
        match u8::try_from(number) {
            Ok(number @ 1..=254) => Ok(Self(number)),
            _ => Err(CellIdOutOfRange { got: number }),
        }
    }

    /// Returns the node id as a number.
    #[must_use]
    pub const fn get(self) -> u8 {
        self.0
    }

    /// Returns the index of the cell in an array with an element for every possible node id: 0 to 253.
    #[must_use]
    pub const fn index(self) -> usize {
        self.0 as usize - 1
    }

    /// Returns all node ids of cells, in ascending order.
    pub fn all() -> impl Iterator<Item = Self> {
        (1..=Self::MAX.0).map(Self)
    }
}

impl core::str::FromStr for CellId {
    type Err = InvalidNodeId;

    /// Parses a node id in decimal digits.
    fn from_str(text: &str) -> Result<Self, InvalidNodeId> {
        text.parse().ok().and_then(|number| Self::new(number).ok()).ok_or(InvalidNodeId)
    }
}

impl core::fmt::Display for CellId {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        self.0.fmt(f)
    }
}

/// The sender or addressee in the node field of an identifier.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub enum Node {
    /// The gateway: 0.
    Gateway,
    /// A cell: 1 to 254.
    Cell(CellId),
    /// All cells: 255.
    Everyone,
}

impl Node {
    /// Decodes a node field.
    #[must_use]
    pub const fn from_byte(byte: u8) -> Self {
        match byte {
            0 => Self::Gateway,
            255 => Self::Everyone,
            number => Self::Cell(CellId(number)),
        }
    }

    /// Encodes the node field.
    #[must_use]
    pub const fn to_byte(self) -> u8 {
        match self {
            Self::Gateway => 0,
            Self::Cell(cell) => cell.0,
            Self::Everyone => 255,
        }
    }

    /// Returns true if the node field addresses `cell`, either by its node id or as one of all cells.
    #[must_use]
    pub fn addresses_cell(self, cell: CellId) -> bool {
        self == Self::Cell(cell) || self == Self::Everyone
    }
}

impl core::fmt::Display for Node {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Gateway => f.pad("gateway"),
            Self::Cell(cell) => cell.fmt(f),
            Self::Everyone => f.pad("everyone"),
        }
    }
}

/// The kind of a packet: bits 8 to 10 of an identifier.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
#[repr(u8)]
pub enum Kind {
    /// A command from the gateway's side to all cells; the node field is the [`Command`].
    Command = 0,
    /// The sum of the torques of a cell and of all cells below it in the tree.
    Sum = 1,
    /// The torque of one cell alone.
    Torque = 2,
    /// Measurements of a cell.
    Sensors = 3,
    /// A status page: heartbeat, counters, or the cell's part of the tree.
    Network = 4,
    /// A request to write or read a parameter of a cell.
    Configure = 5,
    /// A cell's reply to a configure request.
    Configured = 6,
    /// Simulated sensor values for a cell.
    Stimulus = 7,
}

impl Kind {
    /// All kinds, in the order of their numbers.
    pub const ALL: [Self; 8] = [
        Self::Command,
        Self::Sum,
        Self::Torque,
        Self::Sensors,
        Self::Network,
        Self::Configure,
        Self::Configured,
        Self::Stimulus,
    ];

    /// Returns the name of the kind in tables and errors.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Command => "command",
            Self::Sum => "sum",
            Self::Torque => "torque",
            Self::Sensors => "sensors",
            Self::Network => "network",
            Self::Configure => "configure",
            Self::Configured => "configured",
            Self::Stimulus => "stimulus",
        }
    }

    /// Returns true if cells send this kind, false if the gateway's side does.
    #[must_use]
    pub const fn is_from_cells(self) -> bool {
        match self {
            Self::Sum | Self::Torque | Self::Sensors | Self::Network | Self::Configured => true,
            Self::Command | Self::Configure | Self::Stimulus => false,
        }
    }

    const fn from_bits(bits: u16) -> Self {
        match bits & 7 {
            0 => Self::Command,
            1 => Self::Sum,
            2 => Self::Torque,
            3 => Self::Sensors,
            4 => Self::Network,
            5 => Self::Configure,
            6 => Self::Configured,
            _ => Self::Stimulus,
        }
    }
}

/// A command: the node field of an identifier of kind 0.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
#[repr(u8)]
pub enum Command {
    /// Cells stop sending torques and sums until [`Command::Resume`].
    Halt = 0,
    /// Joint positions of a new epoch.
    Joints = 1,
    /// Cells send a heartbeat after all replies to the last joints.
    Sync = 2,
    /// Cells leave the halted state.
    Resume = 3,
    /// Cells send the pages of counters.
    Report = 4,
}

impl Command {
    /// All commands, in the order of their numbers.
    pub const ALL: [Self; 5] = [Self::Halt, Self::Joints, Self::Sync, Self::Resume, Self::Report];

    /// Returns the command with this number; `None` for other numbers.
    #[must_use]
    pub const fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            0 => Some(Self::Halt),
            1 => Some(Self::Joints),
            2 => Some(Self::Sync),
            3 => Some(Self::Resume),
            4 => Some(Self::Report),
            _ => None,
        }
    }

    /// Returns the name of the command.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Halt => "halt",
            Self::Joints => "joints",
            Self::Sync => "sync",
            Self::Resume => "resume",
            Self::Report => "report",
        }
    }
}

/// An 11-bit identifier: kind and node field.
#[derive(Clone, Copy, Debug, Eq, Hash, Ord, PartialEq, PartialOrd)]
pub struct Id {
    /// The kind of the packet.
    pub kind: Kind,
    /// The node field; for [`Kind::Command`] the number of the command.
    pub node: u8,
}

impl Id {
    /// Returns the identifier of a command.
    #[must_use]
    pub const fn command(command: Command) -> Self {
        Self { kind: Kind::Command, node: command as u8 }
    }

    /// Returns the identifier of a packet from or to a node.
    #[must_use]
    pub const fn new(kind: Kind, node: Node) -> Self {
        Self { kind, node: node.to_byte() }
    }

    /// Returns the identifiers of all frames that a cell with this node id receives, in every network state. They are
    /// halt, joints, sync, resume and report; its own heartbeats, to detect another cell with its node id; and
    /// configuration and stimuli, addressed to the cell or to everyone. A cell also receives the sums of the cells at
    /// its ports, which are not listed here.
    #[must_use]
    pub const fn ids_received_by_cell(cell: CellId) -> [Self; 10] {
        let cell = Node::Cell(cell);
        [
            Self::command(Command::Halt),
            Self::command(Command::Joints),
            Self::command(Command::Sync),
            Self::command(Command::Resume),
            Self::command(Command::Report),
            Self::new(Kind::Network, cell),
            Self::new(Kind::Configure, cell),
            Self::new(Kind::Configure, Node::Everyone),
            Self::new(Kind::Stimulus, cell),
            Self::new(Kind::Stimulus, Node::Everyone),
        ]
    }

    /// Returns the identifier as eleven bits.
    #[must_use]
    pub const fn to_bits(self) -> u16 {
        ((self.kind as u16) << 8) | self.node as u16
    }

    /// Decodes eleven bits; higher bits are ignored.
    #[must_use]
    pub const fn from_bits(bits: u16) -> Self {
        let [node, _] = bits.to_le_bytes();
        Self { kind: Kind::from_bits(bits >> 8), node }
    }

    /// Returns the cell that sends frames with this identifier; `None` if the gateway's side does.
    #[must_use]
    pub const fn sender(self) -> Option<CellId> {
        match Node::from_byte(self.node) {
            Node::Cell(cell) if self.kind.is_from_cells() => Some(cell),
            Node::Cell(_) | Node::Gateway | Node::Everyone => None,
        }
    }

    /// Returns the name of the command, or for other packets the name of the kind.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match (self.kind, Command::from_byte(self.node)) {
            (Kind::Command, Some(command)) => command.name(),
            (kind, _) => kind.name(),
        }
    }
}

impl core::fmt::Display for Id {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{:03X}", self.to_bits())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_2048_identifiers_come_back() {
        for bits in 0..0x800 {
            assert_eq!(Id::from_bits(bits).to_bits(), bits);
        }
    }

    #[test]
    fn halt_wins_arbitration_then_joints_then_torques_and_stimuli_lose() {
        let cell = Node::Cell(CellId::new(1).unwrap());
        let order = [
            Id::command(Command::Halt),
            Id::command(Command::Joints),
            Id::new(Kind::Sum, cell),
            Id::new(Kind::Torque, cell),
            Id::new(Kind::Stimulus, cell),
        ];
        assert!(order.is_sorted_by_key(|id| id.to_bits()));
    }

    #[test]
    fn node_ids_of_cells_are_1_to_254() {
        assert_eq!(CellId::all().count(), CellId::COUNT);
        assert!(CellId::all().all(|cell| Node::from_byte(cell.get()) == Node::Cell(cell)));
        let error = CellId::new(255).unwrap_err().to_string();
        assert_eq!(error, "255 is not a node id: use 1 to 254 (0 is the gateway, 255 is everyone)");
    }
}
