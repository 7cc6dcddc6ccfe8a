//! Which frames are shown.

use core::str::FromStr;

use protocol::can::Frame;
use protocol::id::{CellId, Command, Id, Kind, Node};
use protocol::packet::data_id;
use thiserror::Error;

use super::wired;

/// A kind of frame that is wanted.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub enum Wanted {
    /// A kind of packet.
    Kind(Kind),
    /// One command.
    Command(Command),
    /// What cells say over simulated wires.
    Wire,
    /// What is not of this protocol.
    Foreign,
}

/// A word that is no kind.
#[derive(Clone, Debug, Eq, Error, PartialEq)]
#[error(
    "{got:?} is no kind: command, sum, torque, sensors, network, configure, configured, stimulus are; also halt, \
     joints, sync, resume, report alone, wire, and foreign"
)]
pub struct UnknownWanted {
    /// The word.
    pub got: String,
}

impl FromStr for Wanted {
    type Err = UnknownWanted;

    fn from_str(word: &str) -> Result<Self, UnknownWanted> {
        let kind = Kind::ALL.into_iter().find(|kind| kind.name() == word).map(Self::Kind);
        let command = || Command::ALL.into_iter().find(|command| command.name() == word).map(Self::Command);
        let other = || match word {
            "wire" => Some(Self::Wire),
            "foreign" => Some(Self::Foreign),
            _ => None,
        };
        kind.or_else(command).or_else(other).ok_or_else(|| UnknownWanted { got: word.to_owned() })
    }
}

/// Whom a word names: `gateway`, `everyone`, or a cell's number.
///
/// # Errors
/// What it is and what would be right.
pub fn node(word: &str) -> Result<Node, String> {
    match word {
        "gateway" => Ok(Node::Gateway),
        "everyone" => Ok(Node::Everyone),
        number => match number.parse().ok().and_then(|number| CellId::new(number).ok()) {
            Some(cell) => Ok(Node::Cell(cell)),
            None => Err(format!("{word:?} is no node: a cell's number, 1 to 254, gateway or everyone is")),
        },
    }
}

/// What is shown; everything by default.
#[derive(Clone, Debug, Default)]
pub struct Pick {
    /// Any of these; all when empty.
    pub kinds: Vec<Wanted>,
    /// Any of these, as sender or addressee; all when empty. Commands are the gateway's.
    pub nodes: Vec<Node>,
    /// From so many nanoseconds after the first frame on.
    pub from: Option<u64>,
    /// Up to, and without, so many nanoseconds after the first frame.
    pub to: Option<u64>,
}

impl Pick {
    /// Whether a frame is shown that came at `nanos`, when the first one came at `first`.
    #[must_use]
    pub fn takes(&self, first: u64, nanos: u64, frame: &Frame) -> bool {
        let id = data_id(frame).ok();
        self.takes_time(first, nanos) && self.takes_kind(id, frame) && self.takes_node(id)
    }

    fn takes_time(&self, first: u64, nanos: u64) -> bool {
        let after_from = self.from.is_none_or(|from| nanos >= first.saturating_add(from));
        let before_to = self.to.is_none_or(|to| nanos < first.saturating_add(to));
        after_from && before_to
    }

    fn takes_kind(&self, id: Option<Id>, frame: &Frame) -> bool {
        self.kinds.is_empty()
            || self.kinds.iter().any(|wanted| match (wanted, id) {
                (Wanted::Kind(kind), Some(id)) => id.kind == *kind,
                (Wanted::Command(command), Some(id)) => id == Id::command(*command),
                (Wanted::Foreign, None) => wired(frame).is_none(),
                (Wanted::Wire, None) => wired(frame).is_some(),
                (Wanted::Foreign | Wanted::Wire, Some(_)) | (Wanted::Kind(_) | Wanted::Command(_), None) => {
                    false
                }
            })
    }

    fn takes_node(&self, id: Option<Id>) -> bool {
        let node = id.map(|id| match id.kind {
            Kind::Command => Node::Gateway,
            Kind::Sum
            | Kind::Torque
            | Kind::Sensors
            | Kind::Network
            | Kind::Configure
            | Kind::Configured
            | Kind::Stimulus => Node::from_byte(id.node),
        });
        self.nodes.is_empty() || node.is_some_and(|node| self.nodes.contains(&node))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::can::EXTENDED;
    use protocol::wire;

    fn frame(id: u32) -> Frame {
        Frame::classic(id, &[]).unwrap()
    }

    #[test]
    fn kinds_and_nodes_are_told_by_the_identifier() {
        let ids = [0x000, 0x001, 0x20C, 0x50C, 0x5FF, 0x400, 0x1234 | EXTENDED];
        let taken = |kinds: &[&str], nodes: &[&str]| -> Vec<u32> {
            let pick = Pick {
                kinds: kinds.iter().map(|word| word.parse().unwrap()).collect(),
                nodes: nodes.iter().map(|word| node(word).unwrap()).collect(),
                ..Pick::default()
            };
            ids.into_iter().filter(|&id| pick.takes(0, 0, &frame(id))).collect()
        };
        assert_eq!(taken(&[], &[]), ids);
        assert_eq!(taken(&["command"], &[]), [0x000, 0x001]);
        assert_eq!(taken(&["joints", "foreign"], &[]), [0x001, 0x1234 | EXTENDED]);
        assert_eq!(taken(&[], &["12"]), [0x20C, 0x50C]);
        assert_eq!(taken(&["configure"], &["12", "everyone"]), [0x50C, 0x5FF]);
        assert_eq!(taken(&[], &["gateway"]), [0x000, 0x001, 0x400]);
        let wire = wire::Lane { wire: 3, back: true }.frame(wire::PortMessage::Join);
        let takes = |kind: &str| {
            let kinds = vec![kind.parse().unwrap()];
            Pick { kinds, ..Pick::default() }.takes(0, 0, &wire)
        };
        assert_eq!(["wire", "foreign", "command"].map(takes), [true, false, false]);
        assert!(Pick::default().takes(0, 0, &wire));
    }

    #[test]
    fn times_count_from_the_first_frame_and_leave_out_the_end() {
        let pick = Pick { from: Some(10), to: Some(20), ..Pick::default() };
        let taken: Vec<u64> = (95..=125).filter(|&at| pick.takes(100, at, &frame(1))).collect();
        assert_eq!(taken, (110..120).collect::<Vec<_>>());
    }

    #[test]
    fn words_that_are_none_say_which_are() {
        let kind = "torqe".parse::<Wanted>().unwrap_err().to_string();
        assert!(kind.starts_with("\"torqe\" is no kind: command, sum, torque, "), "{kind}");
        let expected = "\"255\" is no node: a cell's number, 1 to 254, gateway or everyone is";
        assert_eq!(node("255"), Err(expected.to_owned()));
    }
}
