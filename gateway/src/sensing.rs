//! `gateway sensing`.

use std::collections::{BTreeMap, BTreeSet};
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use model::decode::{Decoded, Decoder};
use model::generate::Format;
use protocol::bus::{Bus, Choice, Filter, Inbox, Options};
use protocol::can;
use protocol::id::{CellId, Kind, Node};
use protocol::message::{Answer, Message, NetworkPage, Request, State};
use protocol::parameters::{Parameter, Sensing as Mode};
use protocol::skin::sensing::continuous;
use protocol::time::Micros;
use protocol::usage::{Failure, print};

use super::ack;

/// So long cells show that they are there: two heartbeats and some.
const LISTEN: Duration = Duration::from_millis(600);
/// From one word to a cell that does not answer to the next.
const AGAIN: Duration = Duration::from_millis(250);
/// Who has not answered by then will not.
const PATIENCE: Duration = Duration::from_secs(3);
/// Comes back in the answers, so that they are not taken for those to somebody else.
const TAG: u8 = 0x57;

/// Say when the cells of a running bench tell what they feel: never, at a rate, or when it changes
///
/// Takes effect at once, waits until every cell that is heard has confirmed it, and names those that do not. A
/// gateway that runs on the bus keeps it: it switches a cell that starts anew to what the cell was last. Which
/// changes count is parameter 8, which a skin has under [events]: `gateway frame configure --write events`.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway sensing vcan0 event
  gateway sensing vcan0 continuous 62.5 --node 12
  gateway sensing vcan0 off")]
pub(crate) struct Sensing {
    /// The bus
    bus: String,
    /// When cells tell
    #[arg(value_enum)]
    mode: Kinds,
    /// How often, in continuous mode: frames of each cell a second
    #[arg(value_name = "HZ", allow_negative_numbers = true)]
    hz: Option<f64>,
    /// Only this cell, 1 to 254; else all
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=254))]
    node: Option<u8>,
    /// What a packet travels in on the bus
    #[arg(long, value_enum, default_value = "fd")]
    format: Format,
    /// socketcan or embedded; else SocketCAN where the kernel has CAN, the embedded bus where not
    #[arg(long, value_name = "KIND", default_value_t = Choice::Auto)]
    bus_kind: Choice,
}

#[derive(Clone, Copy, Debug, Eq, PartialEq, ValueEnum)]
enum Kinds {
    /// Only when a report asks
    Off,
    /// At a rate
    Continuous,
    /// When it changes, and with each heartbeat
    Event,
}

impl Sensing {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let mode = self.mode().map_err(Failure::usage)?;
        let format = ack::wire(self.format);
        let filters = [Kind::Network, Kind::Configured].map(Filter::kind).to_vec();
        let options = Options { filters, fd: format == can::Format::Fd, ..Options::default() };
        let bus = Bus::open(&self.bus, self.bus_kind, &options).map_err(Failure::usage)?;
        let answers = self.ask(&bus, format, mode)?;
        let told = answers.verdict(bus.name(), self.format).map_err(Failure::run)?;
        let mode = model::decode::parameter::Words(Parameter::Sensing.number(), mode.words());
        print(&format!("{told} on {} ({}): {mode}\n", bus.name(), bus.kind()))
    }

    fn mode(&self) -> Result<Mode, String> {
        match (self.mode, self.hz) {
            (Kinds::Off, None) => Ok(Mode::Off),
            (Kinds::Event, None) => Ok(Mode::Event),
            (Kinds::Continuous, Some(hz)) => continuous(hz).map_err(|why| format!("HZ = {hz}: {why}")),
            (Kinds::Continuous, None) => Err("continuous needs a rate, such as `continuous 62.5`".to_owned()),
            (Kinds::Off | Kinds::Event, Some(hz)) => {
                Err(format!("HZ = {hz}: only continuous has a rate; leave it out"))
            }
        }
    }

    /// Tells the cells until all that are there have answered, or will not.
    fn ask(&self, bus: &Bus, format: can::Format, mode: Mode) -> Result<Answers, Failure> {
        let only = self.node.and_then(|node| CellId::new(node.into()).ok());
        let mut answers = Answers { only, ..Answers::default() };
        let tell = |to| {
            let request = Request::Write { number: Parameter::Sensing.number(), words: mode.words() };
            let message = Message::Configure { to, tag: TAG, request };
            let frames: Vec<_> = message.encode().frames(format).collect();
            bus.send(&frames).map_err(|error| Failure::run(error.cause))
        };
        tell(only.map_or(Node::Everyone, Node::Cell))?;
        let began = Instant::now();
        let (mut told, mut inbox, mut decoder) = (began, Inbox::new(), Decoder::new(Some(format)));
        while began.elapsed() < PATIENCE && !answers.are_complete(began.elapsed() >= LISTEN) {
            if bus.wait(Some(Duration::from_millis(20))).map_err(Failure::run)? {
                bus.receive(&mut inbox).map_err(Failure::run)?;
                for received in inbox.frames() {
                    let at = Micros(received.at_nanos / 1_000);
                    if let Decoded::Message(message) = decoder.decode(at, bus.name(), &received.frame) {
                        answers.take(&message);
                    }
                }
            }
            if told.elapsed() >= AGAIN {
                told = Instant::now();
                for cell in answers.missing() {
                    tell(Node::Cell(cell))?;
                }
            }
        }
        Ok(answers)
    }
}

/// Who is there, and what they answered.
#[derive(Debug, Default)]
struct Answers {
    /// The one cell that is asked; else all.
    only: Option<CellId>,
    heard: BTreeSet<CellId>,
    confirmed: BTreeSet<CellId>,
    refused: BTreeMap<CellId, i16>,
}

impl Answers {
    fn take(&mut self, message: &Message) {
        let wanted = |cell: CellId| self.only.is_none_or(|only| only == cell);
        match *message {
            Message::Network { from: Node::Cell(cell), page: NetworkPage::Heartbeat(heartbeat), .. }
                if wanted(cell) && !heartbeat.state.has(State::CLAIMING) =>
            {
                self.heard.insert(cell);
            }
            Message::Configured { from, tag: TAG, answer } if wanted(from) => {
                match answer {
                    Answer::Value { .. } => _ = self.confirmed.insert(from),
                    Answer::Refused { reason, .. } => _ = self.refused.insert(from, reason),
                }
                self.heard.insert(from);
            }
            Message::Halt
            | Message::Joints { .. }
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Sum { .. }
            | Message::Torque { .. }
            | Message::Sensors { .. }
            | Message::Network { .. }
            | Message::Configure { .. }
            | Message::Configured { .. }
            | Message::Stimulus { .. } => {}
        }
    }

    /// Those that are there and have not answered, or the one that is asked.
    fn missing(&self) -> Vec<CellId> {
        let known = self.heard.iter().copied().chain(self.only).collect::<BTreeSet<_>>();
        let answered = |cell: &CellId| self.confirmed.contains(cell) || self.refused.contains_key(cell);
        known.into_iter().filter(|cell| !answered(cell)).collect()
    }

    /// Whether nobody is waited for any more; others than one cell show up as long as it is listened.
    fn are_complete(&self, listened: bool) -> bool {
        self.missing().is_empty() && (self.only.is_some() || (listened && !self.heard.is_empty()))
    }

    /// Who was switched, in words; or why not all that should be were.
    fn verdict(&self, bus: &str, format: Format) -> Result<String, String> {
        let missing = self.missing();
        let other = match format {
            Format::Fd => "classic",
            Format::Classic => "fd",
        };
        if self.confirmed.is_empty() && self.refused.is_empty() {
            let who = self.only.map_or_else(|| "no cell".to_owned(), |cell| format!("no cell {cell}"));
            return Err(format!(
                "{who} answers on {bus}: start it, or name the bus' format with --format {other}"
            ));
        }
        if let Some((_, reason)) = self.refused.iter().next() {
            let cells = names(self.refused.keys());
            return Err(format!(
                "{cells} on {bus} refused with reason {reason}: docs/protocol.md says what it means"
            ));
        }
        if !missing.is_empty() {
            let done = self.confirmed.len();
            return Err(format!(
                "{} on {bus} did not answer, {done} did: switch them again when they are back",
                names(missing.iter())
            ));
        }
        Ok(match self.confirmed.len() {
            1 => names(self.confirmed.iter()),
            count => format!("{count} cells"),
        })
    }
}

fn names<'a>(cells: impl Iterator<Item = &'a CellId>) -> String {
    let names: Vec<_> = cells.map(ToString::to_string).collect();
    match names.as_slice() {
        [one] => format!("cell {one}"),
        [first, .., last] if names.len() > 12 => format!("{} cells ({first} to {last})", names.len()),
        several => format!("cells {}", several.join(", ")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::message::Heartbeat;
    use protocol::packet::{Epoch, WORDS};

    fn cell(node: i64) -> CellId {
        CellId::new(node).unwrap()
    }

    fn beat(node: i64) -> Message {
        let page = NetworkPage::Heartbeat(Heartbeat::default());
        Message::Network { from: Node::Cell(cell(node)), epoch: Epoch(0), page }
    }

    fn confirms(node: i64, tag: u8) -> Message {
        let answer = Answer::Value { number: 7, written: true, words: [0; WORDS] };
        Message::Configured { from: cell(node), tag, answer }
    }

    #[test]
    fn all_who_are_heard_have_to_answer() {
        let mut answers = Answers::default();
        assert!(!answers.are_complete(true), "nobody is there yet");
        for message in [beat(1), confirms(1, TAG), confirms(2, TAG), beat(3), confirms(3, TAG ^ 1)] {
            answers.take(&message);
        }
        assert!(!answers.are_complete(true));
        assert_eq!(answers.missing(), [cell(3)], "the answer to somebody else is none");
        let why = "cell 3 on vcan0 did not answer, 2 did: switch them again when they are back";
        assert_eq!(answers.verdict("vcan0", Format::Fd), Err(why.to_owned()));
        answers.take(&confirms(3, TAG));
        assert!(!answers.are_complete(false) && answers.are_complete(true));
        assert_eq!(answers.verdict("vcan0", Format::Fd), Ok("3 cells".to_owned()));
    }

    #[test]
    fn one_cell_is_asked_and_waited_for_alone() {
        let mut answers = Answers { only: Some(cell(7)), ..Answers::default() };
        answers.take(&confirms(1, TAG));
        assert_eq!(answers.missing(), [cell(7)]);
        let why = "no cell 7 answers on vcan0: start it, or name the bus' format with --format classic";
        assert_eq!(answers.verdict("vcan0", Format::Fd), Err(why.to_owned()));
        answers.take(&confirms(7, TAG));
        assert!(answers.are_complete(false));
        assert_eq!(answers.verdict("vcan0", Format::Fd), Ok("cell 7".to_owned()));
    }

    #[test]
    fn who_refuses_is_named() {
        let mut answers = Answers::default();
        let answer = Answer::Refused { number: 7, reason: Answer::UNKNOWN };
        answers.take(&Message::Configured { from: cell(9), tag: TAG, answer });
        let why = "cell 9 on vcan0 refused with reason 18: docs/protocol.md says what it means";
        assert_eq!(answers.verdict("vcan0", Format::Fd), Err(why.to_owned()));
    }
}
