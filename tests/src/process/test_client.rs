//! A client of a bench's bus beside gateway and cells, which decodes and sends messages.

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

use model::decode::{Decoded, Decoder};
use protocol::bus::{Bus, BusOptions, Inbox, KindChoice};
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage, State};
use protocol::time::Micros;

use super::{TIMEOUT, TestDir, until};

/// A client of a bus with a given format.
pub struct TestClient {
    pub bus: Bus,
    format: Format,
    decoder: RefCell<Decoder>,
}

impl TestDir {
    /// Opens a client of the bus `vcan0` with CAN FD frames.
    pub fn test_client(&self) -> TestClient {
        self.test_client_of(Format::Fd)
    }

    /// Opens a client of the bus `vcan0` with frames of this format.
    pub fn test_client_of(&self, format: Format) -> TestClient {
        TestClient::on(self, "vcan0", format)
    }
}

impl TestClient {
    pub fn on(place: &TestDir, bus: &str, format: Format) -> Self {
        Self::on_kind(place, bus, format, KindChoice::Only(place.kind()))
    }

    pub fn on_kind(place: &TestDir, bus: &str, format: Format, kind: KindChoice) -> Self {
        let fd = format == Format::Fd;
        let options = BusOptions { directory: Some(place.buses()), fd, ..BusOptions::default() };
        let bus = until("the bus", || Bus::open(bus, kind, &options).ok());
        Self { bus, format, decoder: RefCell::new(Decoder::new(Some(format))) }
    }

    /// Decodes a frame.
    pub fn decodes(&self, at: Micros, frame: &Frame) -> Decoded {
        self.decoder.borrow_mut().decode(at, self.bus.name(), frame)
    }

    /// Sends a message to all.
    pub fn send(&self, message: &Message) {
        let frames: Vec<_> = message.encode().frames(self.format).collect();
        self.bus.send(&frames).unwrap();
    }

    /// Receives messages until `enough` holds, or until `TIMEOUT` is over; returns true if it held.
    pub fn receive_until(&self, mut enough: impl FnMut(&Message) -> bool) -> bool {
        let mut inbox = Inbox::new();
        let give_up = Instant::now() + TIMEOUT;
        while Instant::now() < give_up {
            self.bus.wait(Some(Duration::from_millis(100))).unwrap();
            self.bus.receive(&mut inbox).unwrap();
            for received in inbox.frames() {
                let decoded = self.decodes(Micros(received.at_nanos / 1_000), &received.frame);
                if let Decoded::Message(message) = decoded
                    && enough(&message)
                {
                    return true;
                }
            }
        }
        false
    }

    /// Waits for a message for which `enough` holds.
    pub fn waits_for(&self, what: &str, enough: impl FnMut(&Message) -> bool) {
        assert!(self.receive_until(enough), "waited {TIMEOUT:?} for {what} on {}", self.bus.name());
    }

    /// Waits until each of these cells has sent a torque that is not zero.
    pub fn waits_for_torques(&self, cells: RangeInclusive<u8>) {
        let mut missing: BTreeSet<u8> = cells.collect();
        self.waits_for("torques", |message| {
            if let Message::Torque { from, torque, .. } = message
                && !torque.is_zero()
            {
                missing.remove(&from.get());
            }
            missing.is_empty()
        });
    }

    /// Waits for a sum of this number of cells.
    pub fn waits_for_a_sum_of(&self, cells: u8) {
        self.waits_for("a sum", |message| matches!(message, Message::Sum { count, .. } if *count == cells));
    }

    /// Waits for a number of joints messages.
    pub fn waits_for_joints(&self, mut count: u32) {
        self.waits_for("joints", |message| {
            count -= u32::from(matches!(message, Message::Joints { .. }));
            count == 0
        });
    }

    /// Waits until each of these cells has reported that it is halted.
    pub fn waits_for_halted_cells(&self, cells: RangeInclusive<u8>) {
        let mut missing: BTreeSet<u8> = cells.collect();
        self.waits_for("cells that are halted", |message| {
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

    /// Waits until this many joints have been on the bus since the loop began.
    pub fn waits_for_epoch(&self, number: u8) {
        let there = |message: &Message| matches!(message, Message::Joints { epoch, .. } if epoch.0 >= number);
        self.waits_for(&format!("joints of epoch {number}"), there);
    }

    /// Waits until the robot has been in four positions.
    pub fn waits_for_motion(&self) {
        let mut seen = BTreeSet::new();
        self.waits_for("a robot that moves", |message| {
            if let Message::Joints { joints, .. } = message {
                seen.insert(joints.positions);
            }
            seen.len() >= 4
        });
    }

    /// Waits until the cells from 1 to `cells` have reported their node ids and parameters.
    pub fn waits_for_settled_cells(&self, cells: usize) {
        let mut settled = BTreeSet::new();
        self.waits_for("cells that have their node ids", |message| {
            if let Message::Network {
                from: Node::Cell(cell), page: NetworkPage::Heartbeat(heartbeat), ..
            } = message
                && heartbeat.state.has(State::CONFIGURED)
                && !heartbeat.state.has(State::CLAIMING_NODE_ID)
            {
                settled.insert(cell.get());
            }
            settled.len() == cells
        });
    }
}
