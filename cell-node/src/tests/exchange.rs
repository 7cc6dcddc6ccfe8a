//! Test of the cell with `protocol/tests/golden/exchange.log`, which a Python program wrote from the protocol document.
//! The cell receives the frames of the log. It must send exactly the frames that the log contains, at the times in the
//! log.
#![allow(clippy::indexing_slicing, clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use std::collections::{BTreeMap, VecDeque};

use crate::flash::FlashState;
use crate::identity::Identity;
use crate::node::Node;
use protocol::can::{Format, Frame};
use protocol::candump::{self, CandumpLine};
use protocol::id::CellId;
use protocol::message::{Message, Request};
use protocol::packet::Packet;
use protocol::parameters::{Parameter, Parameters};
use protocol::time::{Micros, Span};

const EXCHANGE: &str = include_str!("../../../protocol/tests/golden/exchange.log");
const SESSION: &str = include_str!("../../../protocol/tests/golden/session.log");
/// Interval in µs between the starts of two exchanges in the log.
const APART: u64 = 10_000_000;

/// A cell, with the frames that it has sent and their times.
struct Cell {
    node: Node,
    format: Format,
    sent: VecDeque<(u64, String)>,
}

impl Cell {
    /// Starts a cell as a line of the log describes.
    fn start(fields: &str) -> Self {
        let fields: BTreeMap<_, _> = fields.split(' ').map(|field| field.split_once('=').unwrap()).collect();
        let format = if fields["format"] == "fd" { Format::Fd } else { Format::Classic };
        let identity = Identity {
            cell: Some(CellId::new(fields["node"].parse().unwrap()).unwrap()),
            serial: fields["serial"].parse().unwrap(),
        };
        let flash =
            if fields["flash"] == "session" { FlashState::Valid(configuration()) } else { FlashState::Empty };
        let node = Node::new(identity, format, &flash, fields["test"] == "1", Micros(0));
        Self { node, format, sent: VecDeque::new() }
    }

    fn collect(&mut self, at: u64) {
        if self.node.poll_store().is_some() {
            self.node.handle_stored(true);
        }
        while let Some(packet) = self.node.poll_transmit() {
            self.sent.extend(packet.frames(self.format).map(|frame| (at, frame.to_string())));
        }
    }

    /// Advances the time of the cell. A cell that has given up its node id does nothing.
    fn until(&mut self, at: u64) {
        while self.node.other_owner().is_none() && self.node.poll_timeout() <= Micros(at) {
            let due = self.node.poll_timeout();
            self.node.handle_timeout(due);
            self.collect(due.0);
        }
    }

    fn take(&mut self, at: u64, frame: &Frame) {
        self.node.handle_frame(Micros(at), Span(0), frame);
        self.collect(at);
    }
}

/// Returns the parameters that result from the writes in the configuration session of the log.
fn configuration() -> Parameters {
    let mut parameters = Parameters::default();
    for line in SESSION.lines() {
        if let CandumpLine::Frame(record) = candump::parse(line).unwrap()
            && let Ok(message) = Message::decode(&Packet::from_fd(&record.frame).unwrap())
            && let Message::Configure { request: Request::Write { number, words }, .. } = message
            && let Some(parameter) = Parameter::from_number(number).filter(|it| it.is_stored())
        {
            parameters.set(parameter, words).unwrap();
        }
    }
    parameters
}

#[test]
fn the_cell_sends_what_the_log_says_when_the_log_says_it() {
    let mut cell: Option<Cell> = None;
    let (mut comment, mut title, mut frames) = ("", "", 0);
    for line in EXCHANGE.lines() {
        let CandumpLine::Frame(record) = candump::parse(line).unwrap() else {
            title = line.strip_prefix("## ").unwrap_or(title);
            comment = line.strip_prefix("# ").unwrap_or(comment);
            if let Some(fields) = line.strip_prefix("# start ") {
                // Heartbeats of the second after an exchange are not in the log, so only what was sent so far
                // counts.
                let rest = cell.replace(Cell::start(fields)).map(|cell| cell.sent).unwrap_or_default();
                assert!(rest.is_empty(), "before {title}: {rest:?}");
            }
            continue;
        };
        let (cell, at) = (cell.as_mut().unwrap(), record.time.nanos / 1_000 % APART);
        cell.until(at);
        frames += 1;
        match comment.split(' ').next() {
            Some("bus") => {
                assert!(cell.sent.is_empty(), "{title}, before {comment}: {:?}", cell.sent);
                cell.take(at, &record.frame);
            }
            Some("cell") => {
                let sent = cell.sent.pop_front();
                assert_eq!(sent, Some((at, record.frame.to_string())), "{title}: {comment}");
            }
            _ => panic!("{comment}"),
        }
    }
    let rest = cell.unwrap().sent;
    assert!(rest.is_empty(), "at the end: {rest:?}");
    assert!(frames > 200, "{frames} frames");
}

#[test]
fn a_cell_that_gave_way_says_so() {
    let starts = EXCHANGE
        .split("\n## ")
        .filter(|exchange| exchange.contains("give way") || exchange.contains("gives way"));
    let mut gave_way = 0;
    for exchange in starts {
        let fields = exchange.lines().find_map(|line| line.strip_prefix("# start ")).unwrap();
        let mut cell = Cell::start(fields);
        let (mut comment, mut at) = ("", 0);
        for line in exchange.lines().skip(1) {
            comment = line.strip_prefix("# ").unwrap_or(comment);
            if let CandumpLine::Frame(record) = candump::parse(line).unwrap() {
                at = record.time.nanos / 1_000 % APART;
                cell.until(at);
                if comment.starts_with("bus ") {
                    cell.take(at, &record.frame);
                }
            }
        }
        assert!(cell.node.other_owner().is_some(), "{exchange}, at {at} us");
        gave_way += 1;
    }
    assert_eq!(gave_way, 3);
}
