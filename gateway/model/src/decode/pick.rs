//! Filters that select frames to show.

use core::fmt;
use core::str::FromStr;

use protocol::can::{EXTENDED_MASK, Frame, STANDARD_MASK};
use protocol::id::{Command, Id, Kind, Node};
use protocol::packet::data_frame_id;
use protocol::skin::split_bus;
use thiserror::Error;

use super::Decoded;

/// A class of frames to show.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum FrameSelector {
    /// A kind of packet.
    Kind(Kind),
    /// A command of one kind.
    Command(Command),
    /// Messages over simulated wires.
    Wire,
    /// Frames that are foreign or damaged.
    Foreign,
    /// Damaged frames, whose identifier carries packets although they are not packets themselves.
    Damaged,
}

/// The given word is not a kind of frame.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[error(
    "{got:?} is not a kind of frame: use command, sum, torque, sensors, network, configure, \
     configured, stimulus; halt, joints, sync, resume, report; wire, foreign or damaged"
)]
pub struct UnknownFrameSelector {
    /// The given word.
    pub got: String,
}

impl FromStr for FrameSelector {
    type Err = UnknownFrameSelector;

    fn from_str(word: &str) -> Result<Self, UnknownFrameSelector> {
        let kind = Kind::ALL.into_iter().find(|kind| kind.name() == word).map(Self::Kind);
        let command = || Command::ALL.into_iter().find(|command| command.name() == word).map(Self::Command);
        let other = || match word {
            "wire" => Some(Self::Wire),
            "foreign" => Some(Self::Foreign),
            "damaged" => Some(Self::Damaged),
            _ => None,
        };
        kind.or_else(command).or_else(other).ok_or_else(|| UnknownFrameSelector { got: word.to_owned() })
    }
}

/// Parses a node: `gateway`, `everyone`, or a node id.
///
/// # Errors
/// Returns the text with the allowed values.
pub fn parse_node(word: &str) -> Result<Node, String> {
    match word {
        "gateway" => Ok(Node::Gateway),
        "everyone" => Ok(Node::Everyone),
        number => number
            .parse()
            .map(Node::Cell)
            .map_err(|_| format!("{word:?} is not a node: use a node id from 1 to 254, gateway or everyone")),
    }
}

/// A node, on one bus or on any.
#[derive(Clone, Debug, Eq, PartialEq)]
pub struct NodeSelector {
    /// The bus; `None` matches any.
    pub bus: Option<String>,
    /// The node on that bus.
    pub node: Node,
}

impl NodeSelector {
    /// Returns true if a packet with this identifier, on this bus, is from or to the node.
    #[must_use]
    pub fn matches(&self, id: Id, bus: &str) -> bool {
        let node = match id.kind {
            Kind::Command => Node::Gateway,
            Kind::Sum
            | Kind::Torque
            | Kind::Sensors
            | Kind::Network
            | Kind::Configure
            | Kind::Configured
            | Kind::Stimulus => Node::from_byte(id.node),
        };
        self.node == node && self.bus.as_ref().is_none_or(|it| it == bus)
    }
}

impl fmt::Display for NodeSelector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if let Some(bus) = &self.bus {
            write!(f, "{bus}:")?;
        }
        write!(f, "{}", self.node)
    }
}

impl FromStr for NodeSelector {
    type Err = String;

    /// Parses `NODE` or `BUS:NODE`; a node is `gateway`, `everyone`, or a node id.
    fn from_str(word: &str) -> Result<Self, String> {
        let (bus, name) = split_bus(word)?;
        Ok(Self { bus: bus.map(str::to_owned), node: parse_node(name)? })
    }
}

/// An identifier and the bits that are compared: `ID` or `ID:MASK`, in hexadecimal as candump prints it.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct IdMask {
    id: u32,
    mask: u32,
    is_extended: bool,
}

impl IdMask {
    /// Returns true if a frame's identifier matches. An 11-bit and a 29-bit identifier never match.
    #[must_use]
    pub fn matches(&self, frame: &Frame) -> bool {
        frame.is_extended() == self.is_extended
            && !frame.is_error()
            && (frame.id() ^ self.id) & self.mask == 0
    }
}

impl FromStr for IdMask {
    type Err = String;

    /// Parses an identifier (up to 3 hexadecimal digits for 11 bits, 8 digits for 29 bits) and its mask.
    fn from_str(word: &str) -> Result<Self, String> {
        let allowed = || {
            format!(
                "{word:?} is not an identifier: use up to 3 hexadecimal digits (11 bits), 8 digits (29 bits), or \
                 ID:MASK"
            )
        };
        let number = |digits: &str| {
            let digits = digits.strip_prefix("0x").unwrap_or(digits);
            let is_extended = digits.len() == 8;
            let longest = if is_extended { EXTENDED_MASK } else { STANDARD_MASK };
            let value = u32::from_str_radix(digits, 16).ok().filter(|value| *value <= longest)?;
            (!digits.starts_with('+') && (is_extended || digits.len() <= 3)).then_some((
                value,
                is_extended,
                longest,
            ))
        };
        let (id, mask) = word.split_once(':').map_or((word, None), |(id, mask)| (id, Some(mask)));
        let (id, is_extended, all) = number(id).ok_or_else(allowed)?;
        let mask = match mask {
            None => all,
            Some(mask) => number(mask).filter(|(mask, ..)| *mask <= all).ok_or_else(allowed)?.0,
        };
        Ok(Self { id, mask, is_extended })
    }
}

/// The filters of a command. The default shows everything.
#[derive(Clone, Debug, Default)]
pub struct FrameFilter {
    /// Shows any of these kinds; all if empty.
    pub kinds: Vec<FrameSelector>,
    /// Shows frames with any of these senders or addressees; all if empty. Commands are from the gateway.
    pub parties: Vec<NodeSelector>,
    /// Shows frames of these buses; of all if empty.
    pub buses: Vec<String>,
    /// Shows frames with any of these identifiers; all if empty.
    pub ids: Vec<IdMask>,
    /// Start, in ns after the origin of times.
    pub from: Option<u64>,
    /// End, in ns after the origin of times; frames at this time are not shown.
    pub to: Option<u64>,
}

impl FrameFilter {
    /// Returns true if all filters match a frame. The frame arrived on `bus` at `nanos`, has the class `decoded`, and
    /// its time counts from `origin`.
    #[must_use]
    pub fn matches(&self, origin: u64, nanos: u64, bus: &str, frame: &Frame, decoded: &Decoded) -> bool {
        let is_foreign = matches!(decoded, Decoded::Foreign(_));
        let id = data_frame_id(frame).ok().filter(|_| !is_foreign);
        self.matches_time(origin, nanos)
            && (self.buses.is_empty() || self.buses.iter().any(|it| it == bus))
            && (self.ids.is_empty() || self.ids.iter().any(|it| it.matches(frame)))
            && self.matches_kind(id, decoded)
            && self.matches_node(id, bus)
    }

    /// Returns the buses that the filters name, with repetitions.
    pub fn bus_names(&self) -> impl Iterator<Item = &str> {
        let of_parties = self.parties.iter().filter_map(|party| party.bus.as_deref());
        self.buses.iter().map(String::as_str).chain(of_parties)
    }

    /// Checks that each given node is on one of the given buses.
    ///
    /// # Errors
    /// Returns a sentence that names the node and the buses, if the filters exclude each other.
    pub fn check_consistency(&self) -> Result<(), String> {
        let is_out = |party: &&NodeSelector| party.bus.as_ref().is_some_and(|bus| !self.buses.contains(bus));
        match self.parties.iter().find(is_out).filter(|_| !self.buses.is_empty()) {
            Some(NodeSelector { bus: Some(bus), node }) => {
                let buses = self.buses.join(", ");
                Err(format!("{bus}:{node} is not on a selected bus ({buses}): omit one of the two filters"))
            }
            _ => Ok(()),
        }
    }

    fn matches_time(&self, origin: u64, nanos: u64) -> bool {
        let after_from = self.from.is_none_or(|from| nanos >= origin.saturating_add(from));
        let before_to = self.to.is_none_or(|to| nanos < origin.saturating_add(to));
        after_from && before_to
    }

    fn matches_kind(&self, id: Option<Id>, decoded: &Decoded) -> bool {
        let is_damaged = matches!(decoded, Decoded::Damaged { .. });
        self.kinds.is_empty()
            || self.kinds.iter().any(|selector| match selector {
                FrameSelector::Kind(kind) => id.is_some_and(|id| id.kind == *kind),
                FrameSelector::Command(command) => id == Some(Id::command(*command)),
                FrameSelector::Foreign => is_damaged || matches!(decoded, Decoded::Foreign(_)),
                FrameSelector::Damaged => is_damaged,
                FrameSelector::Wire => matches!(decoded, Decoded::Wire(..)),
            })
    }

    fn matches_node(&self, id: Option<Id>, bus: &str) -> bool {
        self.parties.is_empty() || id.is_some_and(|id| self.parties.iter().any(|it| it.matches(id, bus)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::{Decoder, ForeignReason};
    use protocol::can::{EXTENDED, Format};
    use protocol::packet::{Epoch, Packet};
    use protocol::port;
    use protocol::time::Micros;

    /// Returns a packet of this identifier, or a foreign frame.
    fn frame(id: u32) -> Frame {
        let Ok(bits) = u16::try_from(id) else { return Frame::classic(id, &[]).unwrap() };
        let packet = Packet { id: Id::from_bits(bits), words: [0; 6].into(), epoch: Epoch(0), count: 1 };
        packet.frames(Format::Fd).next().unwrap()
    }

    fn takes(pick: &FrameFilter, frame: &Frame) -> bool {
        pick.matches(0, 0, "can0", frame, &Decoder::new(None).decode(Micros(0), "can0", frame))
    }

    #[test]
    fn kinds_and_nodes_follow_from_the_identifier_of_a_packet() {
        let ids = [0x000, 0x001, 0x20C, 0x50C, 0x5FF, 0x400, 0x1234 | EXTENDED];
        let taken = |kinds: &[&str], nodes: &[&str]| -> Vec<u32> {
            let pick = FrameFilter {
                kinds: kinds.iter().map(|word| word.parse().unwrap()).collect(),
                parties: nodes.iter().map(|word| word.parse().unwrap()).collect(),
                ..FrameFilter::default()
            };
            ids.into_iter().filter(|&id| takes(&pick, &frame(id))).collect()
        };
        assert_eq!(taken(&[], &[]), ids);
        assert_eq!(taken(&["command"], &[]), [0x000, 0x001]);
        assert_eq!(taken(&["joints", "foreign"], &[]), [0x001, 0x1234 | EXTENDED]);
        assert_eq!(taken(&[], &["12"]), [0x20C, 0x50C]);
        assert_eq!(taken(&["configure"], &["12", "everyone"]), [0x50C, 0x5FF]);
        assert_eq!(taken(&[], &["gateway"]), [0x000, 0x001, 0x400]);
        assert_eq!(taken(&[], &["can0:12", "can1:everyone"]), [0x20C, 0x50C]);
        assert_eq!(taken(&[], &["can1:12"]), [0_u32; 0]);
        assert_eq!(taken(&["damaged"], &[]), [0_u32; 0]);
        let wire = port::LinkId { wire: 3, back: true }.encode_frame(port::PortMessage::Join);
        let kinds = ["wire", "foreign", "command"];
        let of = |kind: &str| FrameFilter { kinds: vec![kind.parse().unwrap()], ..FrameFilter::default() };
        assert_eq!(kinds.map(|kind| takes(&of(kind), &wire)), [true, false, false]);
        assert!(takes(&FrameFilter::default(), &wire));
    }

    #[test]
    fn a_frame_that_is_no_packet_is_foreign_with_every_identifier_and_damaged_only_with_ours() {
        let wrong = Frame::fd(0x20C, 0, &[1; 16]).unwrap();
        let of = |kind: &str| FrameFilter { kinds: vec![kind.parse().unwrap()], ..FrameFilter::default() };
        let mut decoder = Decoder::new(None);
        let mut taken = |frame: &Frame| {
            let decoded = decoder.decode(Micros(0), "can0", frame);
            ["torque", "foreign", "damaged"].map(|kind| of(kind).matches(0, 0, "can0", frame, &decoded))
        };
        assert_eq!(taken(&wrong), [false, true, false]);
        assert_eq!([0, 1].map(|_| taken(&frame(0x20C))), [[true, false, false]; 2]);
        assert_eq!(taken(&wrong), [true, true, true]);
        let cell = FrameFilter { parties: vec!["12".parse().unwrap()], ..FrameFilter::default() };
        assert!(!takes(&cell, &wrong), "nothing is known of another bus");
    }

    #[test]
    fn times_count_from_the_first_frame_and_leave_out_the_end() {
        let pick = FrameFilter { from: Some(10), to: Some(20), ..FrameFilter::default() };
        let taken: Vec<u64> = (95..=125)
            .filter(|&at| pick.matches(100, at, "can0", &frame(1), &Decoded::Foreign(ForeignReason::Remote)))
            .collect();
        assert_eq!(taken, (110..120).collect::<Vec<_>>());
    }

    #[test]
    fn identifiers_are_compared_by_the_bits_of_the_mask() {
        let ids = [0x000, 0x001, 0x20C, 0x50C, 0x5FF, 0x1234 | EXTENDED, 0x20C | EXTENDED];
        let taken = |words: &[&str]| -> Vec<u32> {
            let pick = FrameFilter {
                ids: words.iter().map(|word| word.parse().unwrap()).collect(),
                ..FrameFilter::default()
            };
            ids.into_iter().filter(|&id| takes(&pick, &frame(id))).collect()
        };
        assert_eq!(taken(&["0x20C"]), [0x20C]);
        assert_eq!(taken(&["20c:7FF", "1"]), [0x001, 0x20C]);
        assert_eq!(taken(&["0x200:0x700"]), [0x20C]);
        assert_eq!(taken(&["500:700"]), [0x50C, 0x5FF]);
        assert_eq!(taken(&["0:0"]), [0x000, 0x001, 0x20C, 0x50C, 0x5FF]);
        assert_eq!(taken(&["0000020C"]), [0x20C | EXTENDED]);
        assert_eq!(taken(&["00000000:00000000"]), [0x1234 | EXTENDED, 0x20C | EXTENDED]);
        for wrong in
            ["", "x", "800", "2000", "20C:800", "20C:", ":7FF", "+20", "FFFFFFFF", "20C:7FF:1", "123456789"]
        {
            let said = wrong.parse::<IdMask>().unwrap_err();
            assert!(
                said.contains("3 hexadecimal digits (11 bits), 8 digits (29 bits), or ID:MASK"),
                "{wrong}: {said}"
            );
        }
    }

    #[test]
    fn unknown_words_are_errors_that_list_the_known_ones() {
        let kind = "torqe".parse::<FrameSelector>().unwrap_err().to_string();
        assert!(kind.starts_with("\"torqe\" is not a kind of frame: use command, sum, torque, "), "{kind}");
        let expected = "\"255\" is not a node: use a node id from 1 to 254, gateway or everyone";
        assert_eq!(parse_node("255"), Err(expected.to_owned()));
    }
}
