//! Benches of several buses, of which some carry CAN FD and some classic frames.

use std::cell::RefCell;
use std::collections::{BTreeSet, HashMap};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use protocol::bus::{Bus, Choice, Inbox, Options};
use protocol::can::{Format, Frame};
use protocol::candump::{Line, parse};
use protocol::fixed::Q3_12;
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::{Half, Packet, Paired, WORDS, data_id};
use protocol::time::Micros;

use super::{PATIENCE, Place, until};

/// The same skin, with classic frames on these buses.
pub(crate) fn mixed_skin(skin: &str, classic: &[&str]) -> String {
    let mut text = skin.to_owned();
    for bus in classic {
        let table = format!("name = \"{bus}\"");
        let from = text.find(&table).unwrap_or_else(|| panic!("no {table} in {skin}"));
        let (before, after) = text.split_at(from);
        text = before.to_owned() + &after.replacen("format = \"fd\"", "format = \"classic\"", 1);
    }
    text
}

/// Whether a log has torques of a bus, in frames of its format and no others.
pub(crate) fn carries(log: &str, bus: &str, format: Format) -> bool {
    let frames = log.lines().filter_map(|line| match parse(line) {
        Ok(Line::Frame(record)) if record.interface == bus => Some(record.frame),
        _ => None,
    });
    let frames: Vec<_> = frames.collect();
    let torques = frames.iter().filter(|frame| (0x201..0x300).contains(&frame.id()));
    frames.iter().all(|frame| frame.format() == format) && torques.count() > 0
}

/// Somebody who listens on a bus of a format.
pub(crate) struct Listener {
    bus: Bus,
    format: Format,
    halves: RefCell<HashMap<u16, Half>>,
}

impl Listener {
    pub(crate) fn on(place: &Place, bus: &str, format: Format) -> Self {
        Self::on_kind(place, bus, format, Choice::Only(place.kind()))
    }

    pub(crate) fn on_kind(place: &Place, bus: &str, format: Format, kind: Choice) -> Self {
        let fd = format == Format::Fd;
        let options = Options { directory: Some(place.buses()), fd, ..Options::default() };
        let bus = until("the bus", || Bus::open(bus, kind, &options).ok());
        Self { bus, format, halves: RefCell::default() }
    }

    /// The message that a frame makes whole.
    fn message(&self, at: Micros, frame: &Frame) -> Option<Message> {
        let packet = match self.format {
            Format::Fd => Packet::from_fd(frame).ok()?,
            Format::Classic => {
                let id = data_id(frame).ok()?;
                let mut halves = self.halves.borrow_mut();
                match halves.entry(id.to_bits()).or_insert(Half::NONE).push(at, id, frame.data()) {
                    Ok(Paired::Whole(packet)) => packet,
                    _ => return None,
                }
            }
        };
        Message::decode(&packet).ok()
    }

    /// Says something to everyone.
    pub(crate) fn sends(&self, message: &Message) {
        let frames: Vec<_> = message.encode().frames(self.format).collect();
        self.bus.send(&frames).unwrap();
    }

    /// Hears messages until somebody has enough, or until `PATIENCE` is over: whether somebody had.
    pub(crate) fn hears(&self, mut enough: impl FnMut(&Message) -> bool) -> bool {
        let mut inbox = Inbox::new();
        let give_up = Instant::now() + PATIENCE;
        while Instant::now() < give_up {
            self.bus.wait(Some(Duration::from_millis(100))).unwrap();
            self.bus.receive(&mut inbox).unwrap();
            for received in inbox.frames() {
                let message = self.message(Micros(received.at_nanos / 1_000), &received.frame);
                if message.is_some_and(|message| enough(&message)) {
                    return true;
                }
            }
        }
        false
    }

    fn waits_until(&self, what: &str, enough: impl FnMut(&Message) -> bool) {
        assert!(self.hears(enough), "waited {PATIENCE:?} for {what} on {}", self.bus.name());
    }

    /// Waits until each of these cells has said a torque that is not zero.
    pub(crate) fn waits_for_torques(&self, cells: RangeInclusive<u8>) {
        let mut missing: BTreeSet<u8> = cells.collect();
        self.waits_until("torques", |message| {
            if let Message::Torque { from, torque, .. } = message
                && *torque != [Q3_12::ZERO; WORDS]
            {
                missing.remove(&from.get());
            }
            missing.is_empty()
        });
    }

    /// Waits for a sum of so many cells.
    pub(crate) fn waits_for_a_sum_of(&self, cells: u8) {
        self.waits_until("a sum", |message| matches!(message, Message::Sum { count, .. } if *count == cells));
    }

    /// Waits for so many joints.
    pub(crate) fn waits_for_joints(&self, mut count: u32) {
        self.waits_until("joints", |message| {
            count -= u32::from(matches!(message, Message::Joints { .. }));
            count == 0
        });
    }

    /// Waits until each of these cells has said that it is halted.
    pub(crate) fn waits_for_halted_cells(&self, cells: RangeInclusive<u8>) {
        let mut missing: BTreeSet<u8> = cells.collect();
        self.waits_until("cells that are halted", |message| {
            if let Message::Network {
                from: Node::Cell(from), page: NetworkPage::Heartbeat(heartbeat), ..
            } = message
                && heartbeat.state.has(State::HALTED)
            {
                missing.remove(&from.get());
            }
            missing.is_empty()
        });
    }
}
