//! What is said over wires between ports, and what the network pages say of them.

use core::fmt::{self, Display, Formatter};

use protocol::message::{PortState, Ports, Tree, VERSION};
use protocol::wire::{Hello, Label, Lane, PortMessage, UPLINK, Walk};

/// A message over a wire, with the wire and the direction in it: `wire 12 ->: join`.
pub(super) struct Said(pub(super) Lane, pub(super) PortMessage);

impl Display for Said {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self(Lane { wire, back }, message) = *self;
        write!(f, "wire {wire} {}: {}", if back { "<-" } else { "->" }, name(message))?;
        match message {
            PortMessage::Hello(hello) => greet(f, hello),
            PortMessage::Grant(label) => write!(f, ", {}", Far(Some(label))),
            PortMessage::State(epoch) => write!(f, ", sums from epoch {epoch} on"),
            PortMessage::Missed(epoch) => write!(f, ", the sum of epoch {epoch}"),
            PortMessage::Seek(round) => write!(f, ", a round later than {round}"),
            PortMessage::Number(Walk { walk, first, last }) => write!(f, ", walk {walk}, {first} to {last}"),
            PortMessage::Return(Walk { walk, first, last }) if first > last => {
                write!(f, ", walk {walk}, none left")
            }
            PortMessage::Return(Walk { walk, first, last }) => {
                write!(f, ", walk {walk}, {first} to {last} left")
            }
            PortMessage::Join
            | PortMessage::Refuse
            | PortMessage::Leave
            | PortMessage::Left
            | PortMessage::Ask => Ok(()),
        }
    }
}

fn greet(f: &mut Formatter<'_>, hello: Hello) -> fmt::Result {
    let Hello { version, number, port, hears, up, unnumbered, label } = hello;
    if version != VERSION {
        write!(f, ", version {version}")?;
    }
    match number {
        0 => f.write_str(", no number")?,
        number => write!(f, ", number {number}")?,
    }
    write!(f, ", {}", Port(port))?;
    for (set, word) in [(hears, "hears"), (up, "sums go here"), (unnumbered, "somebody has no number")] {
        if set {
            write!(f, ", {word}")?;
        }
    }
    write!(f, ", {}", Far(label))
}

/// What a message is called.
pub(super) const fn name(message: PortMessage) -> &'static str {
    match message {
        PortMessage::Hello(_) => "hello",
        PortMessage::Join => "join",
        PortMessage::Grant(_) => "grant",
        PortMessage::Refuse => "refuse",
        PortMessage::Leave => "leave",
        PortMessage::Left => "left",
        PortMessage::Ask => "ask",
        PortMessage::State(_) => "state",
        PortMessage::Missed(_) => "missed",
        PortMessage::Seek(_) => "seek",
        PortMessage::Number(_) => "number",
        PortMessage::Return(_) => "return",
    }
}

/// How far somebody is from the gateway.
struct Far(Option<Label>);

impl Display for Far {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        match self.0 {
            Some(Label { round, depth }) => write!(f, "round {round} depth {depth}"),
            None => f.write_str("no way up"),
        }
    }
}

/// A port by its number; the last one leads to the gateway's side.
struct Port(u8);

impl Display for Port {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        if usize::from(self.0) == UPLINK { f.write_str("uplink") } else { write!(f, "port {}", self.0) }
    }
}

/// The ports whose bits are set: `0+2`, or `none`.
pub(super) struct Bits(pub(super) u8);

impl Bits {
    /// Their numbers.
    pub(super) fn ports(&self) -> impl Iterator<Item = u8> + use<> {
        let bits = self.0;
        (0..8).filter(move |port| bits >> port & 1 == 1)
    }
}

impl Display for Bits {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        for (index, port) in self.ports().enumerate() {
            write!(f, "{}{port}", if index == 0 { "" } else { "+" })?;
        }
        if self.0 == 0 { f.write_str("none") } else { Ok(()) }
    }
}

/// Page 3 in words.
pub(super) struct Place(pub(super) Tree);

impl Display for Place {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Tree { parent, up, depth, round, children, works, sent, taken, dropped } = self.0;
        match parent {
            None => write!(f, "tree: no way up (last round {round}), ")?,
            Some(0) => write!(f, "tree: root by {}, depth {depth} of round {round}, ", Port(up))?,
            Some(parent) => {
                write!(f, "tree: child of {parent} by {}, depth {depth} of round {round}, ", Port(up))?;
            }
        }
        write!(f, "children at ports {}, working ports {}, ", Bits(children), Bits(works))?;
        write!(f, "sums sent {sent}, taken {taken}, not taken {dropped}")
    }
}

/// Page 4 in words.
pub(super) struct Around(pub(super) Ports);

impl Display for Around {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        f.write_str("ports:")?;
        for (index, port) in self.0.ports.into_iter().enumerate() {
            write!(f, "{} {index} {}", if index == 0 { "" } else { "," }, End(port))?;
        }
        write!(f, "; parent changed {} times", self.0.changes)
    }
}

/// What is at the other end of a wire.
struct End(PortState);

impl Display for End {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let PortState { number, port, hears, works, other_version } = self.0;
        if !hears {
            return f.write_str("silent");
        }
        match number {
            0 => write!(f, "leads to {} of somebody without a number", Port(port))?,
            number => write!(f, "leads to {} of {number}", Port(port))?,
        }
        if other_version {
            f.write_str(" (other version)")
        } else if works {
            Ok(())
        } else {
            f.write_str(" (one way)")
        }
    }
}
