//! The record of a server's bus: read, and compared with the second program.
//!
//! ```text
//!   # skinbus timed bus 1 rates 1M/5M queue priority:32 errors 0 seed 1
//!   Q NUMBER AT_NS NODE FRAME      requested
//!   X AT_NS NODE FRAME             refused: the node's transmit queue was full
//!   B AT_NS NODE FRAME             passed at once, because only a bench sends it
//!   S NUMBER START_NS END_NS       sent; END is the end of the intermission
//!   D NUMBER START_NS END_NS       damaged; sent again later
//! ```

use std::collections::{BTreeMap, HashMap};
use std::fmt::Debug;
use std::str::FromStr;

use protocol::can::Frame;
use protocol::candump::parse_frame;
use protocol::message::Message;
use protocol::packet::Epoch;
use protocol::packets::PacketReader;
use protocol::time::Micros;
use protocol::wire_time::BitRates;

use super::{BusResult, FrameRequest, NodeQueues, SentOnBus, WireFrame, transmit};

/// The figures of a record that is equal to the second program's results.
#[derive(Clone, Debug, Default)]
pub struct RecordFigures {
    /// Number of frames that nodes requested, without the refused ones.
    pub requested: usize,
    /// Number of frames that a full transmit queue refused.
    pub refused: usize,
    /// Number of frames that passed at once, because only a bench sends them.
    pub bench: usize,
    /// Number of damaged transmissions.
    pub damaged: usize,
    /// Complete transmissions in order.
    pub sent: Vec<SentFrame>,
    /// Start and end of every transmission in ns, in order.
    occupied: Vec<(u64, u64)>,
}

/// A frame that was sent.
#[derive(Clone, Copy, Debug)]
pub struct SentFrame {
    /// Number of the sending node.
    pub node: u16,
    /// The frame.
    pub frame: Frame,
    /// Time of the request in ns.
    pub at: u64,
    /// Start of the first bit in ns.
    pub start: u64,
    /// End of the intermission in ns.
    pub end: u64,
}

/// The joints of an epoch, and the answers to them.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub struct EpochFigures {
    /// The epoch.
    pub epoch: Epoch,
    /// Time in ns at which the last frame of the joints was requested.
    pub requested_at: u64,
    /// End of the joints in ns.
    pub joints_end: u64,
    /// Number of torques and sums that answer these joints.
    pub answers: usize,
    /// End of the last answer in ns.
    pub last_end: Option<u64>,
}

impl RecordFigures {
    /// Returns the share of the time between two times in ns in which the bus was busy.
    #[must_use]
    #[expect(clippy::cast_precision_loss, reason = "a share")]
    pub fn busy_share(&self, from: u64, to: u64) -> f64 {
        let within = |(start, end): &(u64, u64)| (*end).min(to).saturating_sub((*start).max(from));
        let busy: u64 = self.occupied.iter().map(within).sum();
        busy as f64 / (to - from) as f64
    }

    /// Returns the epochs in the order of their joints. Answers to joints from before the record are left out.
    #[must_use]
    pub fn epochs(&self) -> Vec<EpochFigures> {
        let mut reader = PacketReader::default();
        let mut epochs = Vec::<EpochFigures>::new();
        for sent in &self.sent {
            match reader.read(Micros(sent.end / 1_000), &sent.frame).message() {
                Some(&Message::Joints { epoch, .. }) => {
                    let (requested_at, joints_end) = (sent.at, sent.end);
                    epochs.push(EpochFigures { epoch, requested_at, joints_end, answers: 0, last_end: None });
                }
                Some(Message::Torque { epoch, .. } | Message::Sum { epoch, .. }) => {
                    let answered = epochs.iter_mut().rev().find(|it| it.epoch == *epoch);
                    answered.into_iter().for_each(|it| {
                        it.answers += 1;
                        it.last_end = Some(sent.end);
                    });
                }
                _ => {}
            }
        }
        epochs
    }
}

/// Checks that a record is equal to the results of the second program. The last frames may be unsent.
///
/// # Panics
/// Panics with the first line that is malformed or different.
#[must_use]
pub fn check_record(text: &str) -> RecordFigures {
    let record = Record::read(text);
    record.check_priorities();
    record.check_distances();
    let result = record.check_transmissions();
    let sent = record.sent.iter().filter(|it| !it.is_damaged).map(|it| {
        let FrameRequest { at, node, frame } = record.requests[it.request];
        SentFrame { node, frame, at, start: it.start, end: it.end }
    });
    RecordFigures {
        requested: record.requests.len() - result.refused.len(),
        refused: result.refused.len(),
        bench: record.bench,
        damaged: record.sent.iter().filter(|it| it.is_damaged).count(),
        sent: sent.collect(),
        occupied: record.sent.iter().map(|it| (it.start, it.end)).collect(),
    }
}

/// A record, with the requests and the transmissions in their order.
#[derive(Debug)]
struct Record {
    rates: BitRates,
    queues: NodeQueues,
    /// True if bits may be damaged.
    has_errors: bool,
    requests: Vec<FrameRequest>,
    frames: Vec<WireFrame>,
    /// Number of the line of each request, from 1.
    request_lines: Vec<usize>,
    /// Indices of the refused requests.
    refused: Vec<usize>,
    bench: usize,
    sent: Vec<SentOnBus>,
    /// Number of the line of each transmission, from 1.
    sent_lines: Vec<usize>,
}

/// Parses a word of a line.
fn parsed<T: FromStr<Err: Debug>>(line: usize, word: &str) -> T {
    word.parse().unwrap_or_else(|error| panic!("line {line}: {word:?}: {error:?}"))
}

impl FrameRequest {
    fn parse(line: usize, at: &str, node: &str, frame: &str) -> Self {
        let frame = parse_frame(frame).unwrap_or_else(|error| panic!("line {line}: {frame:?}: {error}"));
        Self { at: parsed(line, at), node: parsed(line, node), frame }
    }
}

impl Record {
    /// Reads a record, and checks the order of its times and numbers.
    fn read(text: &str) -> Self {
        let mut lines = (1..).zip(text.lines());
        let mut record = Self::read_header(lines.next().expect("a record has a first line").1);
        let mut by_number = HashMap::<u64, usize>::new();
        let (mut newest, mut last_number) = (0, None);
        for (line, text) in lines {
            let words: Vec<_> = text.split(' ').collect();
            match words[..] {
                ["Q", number, at, node, frame] => {
                    let number = parsed(line, number);
                    assert!(last_number < Some(number), "line {line}: number {number} after {last_number:?}");
                    last_number = Some(number);
                    by_number.insert(number, record.requests.len());
                    record.add_request(line, at, node, frame);
                }
                ["X", at, node, frame] => {
                    record.refused.push(record.requests.len());
                    record.add_request(line, at, node, frame);
                }
                ["B", at, node, frame] => {
                    record.bench += 1;
                    let at = FrameRequest::parse(line, at, node, frame).at;
                    assert!(at >= newest, "line {line}: earlier than the request before it");
                    newest = at;
                }
                [kind @ ("S" | "D"), number, start, end] => {
                    let request = by_number.get(&parsed(line, number)).copied();
                    let request = request.unwrap_or_else(|| panic!("line {line}: {number} does not wait"));
                    let is_damaged = kind == "D";
                    if !is_damaged {
                        by_number.remove(&parsed(line, number));
                    }
                    let (start, end) = (parsed(line, start), parsed(line, end));
                    record.add_sent(line, SentOnBus { request, start, end, is_damaged });
                }
                _ => panic!("line {line}: {text:?} is not a line of a record"),
            }
            if let (Some(request), "Q" | "X") = (record.requests.last(), words[0]) {
                assert!(request.at >= newest, "line {line}: earlier than the request before it");
                newest = request.at;
            }
        }
        record
    }

    fn read_header(text: &str) -> Self {
        let words: Vec<_> = text.split(' ').collect();
        let [
            "#",
            "skinbus",
            "timed",
            "bus",
            "1",
            "rates",
            rates,
            "queue",
            queue,
            "errors",
            errors,
            "seed",
            seed,
        ] = words[..]
        else {
            panic!("line 1: {text:?} is not the first line of a record")
        };
        let _: u64 = parsed(1, seed);
        let (order, depth) = queue.split_once(':').expect("the order and the depth of the queues");
        assert!(["fifo", "priority"].contains(&order), "line 1: {order:?} is not an order of queues");
        Self {
            rates: parsed(1, rates),
            queues: NodeQueues { is_fifo: order == "fifo", depth: parsed(1, depth) },
            has_errors: parsed::<f64>(1, errors) > 0.0,
            requests: Vec::new(),
            frames: Vec::new(),
            request_lines: Vec::new(),
            refused: Vec::new(),
            bench: 0,
            sent: Vec::new(),
            sent_lines: Vec::new(),
        }
    }

    fn add_request(&mut self, line: usize, at: &str, node: &str, frame: &str) {
        let request = FrameRequest::parse(line, at, node, frame);
        self.requests.push(request);
        self.frames.push(WireFrame::new(&request.frame));
        self.request_lines.push(line);
    }

    fn add_sent(&mut self, line: usize, sent: SentOnBus) {
        let before = self.sent.last().map_or(0, |before| before.end);
        assert!(sent.start >= before, "line {line}: it starts before {before}, the end of the one before it");
        let at = self.requests[sent.request].at;
        assert!(sent.start >= at, "line {line}: it starts before {at}, the time of its request");
        assert!(sent.end > sent.start, "line {line}: it ends before it starts");
        assert!(self.has_errors || !sent.is_damaged, "line {line}: damaged on a bus without errors");
        self.sent.push(sent);
        self.sent_lines.push(line);
    }

    /// Returns the number of bits up to the damaged one of each transmission.
    fn damaged_bits(&self) -> Vec<Option<u32>> {
        let bit = |(sent, line): (&SentOnBus, &usize)| {
            let took_ns = sent.end - sent.start;
            let bit = || self.frames[sent.request].damaged_bit(self.rates, took_ns);
            let wrong = || panic!("line {line}: no damaged bit makes it take {took_ns} ns");
            sent.is_damaged.then(|| bit().unwrap_or_else(wrong))
        };
        self.sent.iter().zip(&self.sent_lines).map(bit).collect()
    }

    /// Calls a function for each transmission, with its position and with the lists of frames that had been requested
    /// by its start and wait.
    fn for_each_sent(&self, mut check: impl FnMut(usize, &SentOnBus, &BTreeMap<u16, Vec<usize>>)) {
        let mut refused = self.refused.iter().peekable();
        let mut lists = BTreeMap::<u16, Vec<usize>>::new();
        let mut requests = self.requests.iter().enumerate().peekable();
        for (position, sent) in self.sent.iter().enumerate() {
            while let Some((index, request)) = requests.next_if(|(_, it)| it.at <= sent.start) {
                if refused.next_if(|&&it| it == index).is_none() {
                    lists.entry(request.node).or_default().push(index);
                }
            }
            check(position, sent, &lists);
            if !sent.is_damaged {
                lists.values_mut().for_each(|list| list.retain(|&it| it != sent.request));
            }
        }
    }

    /// Checks that no frame started while another one with a higher priority took part in arbitration.
    fn check_priorities(&self) {
        self.for_each_sent(|position, sent, lists| {
            let bits = |request: usize| self.frames[request].arbitration_bits();
            let eligible = || lists.values().flat_map(|list| self.queues.eligible(list));
            let line = self.sent_lines[position];
            assert!(
                eligible().any(|&it| it == sent.request),
                "line {line}: an older frame of its node waits"
            );
            if let Some(&other) = eligible().find(|&&it| bits(it) < bits(sent.request)) {
                let (other, frame) = (self.request_lines[other], self.requests[other].frame);
                panic!("line {line}: {frame} of line {other} waited, and has priority");
            }
        });
    }

    /// Checks that no two ends are closer than the exact duration of the later transmission, and that they are exactly
    /// that far apart if a frame waited at the earlier one.
    fn check_distances(&self) {
        let damaged_bits = self.damaged_bits();
        let mut before = None;
        self.for_each_sent(|position, sent, lists| {
            let took = self.frames[sent.request].nanoseconds(self.rates, damaged_bits[position]);
            let line = self.sent_lines[position];
            if let Some(before) = before {
                let distance = sent.end - before;
                assert!(
                    distance >= took,
                    "line {line}: ends are {distance} ns apart, but the frame takes {took} ns"
                );
                let waited = lists.values().flatten().any(|&it| self.requests[it].at <= before);
                assert!(
                    distance == took || !waited,
                    "line {line}: ends are {distance} ns apart, but a frame of {took} ns waited"
                );
            }
            before = Some(sent.end);
        });
    }

    /// Checks that requests and transmissions are those of the second program, and returns its results.
    fn check_transmissions(&self) -> BusResult {
        let result = transmit(self.rates, self.queues, &self.requests, &self.damaged_bits());
        for (index, line) in self.request_lines.iter().enumerate() {
            let [refused, expected] =
                [&self.refused, &result.refused].map(|list| list.binary_search(&index).is_ok());
            assert!(refused == expected, "line {line}: refused is {refused}, expected {expected}");
        }
        for (position, (sent, expected)) in self.sent.iter().zip(&result.sent).enumerate() {
            let line = self.sent_lines[position];
            assert!(
                sent == expected,
                "line {line}: expected the frame of line {} from {} to {}",
                self.request_lines[expected.request],
                expected.start,
                expected.end
            );
        }
        // A frame that was sent before the last request has its line.
        if let (Some(missing), Some(last)) = (result.sent.get(self.sent.len()), self.requests.last()) {
            let frame = &self.frames[missing.request];
            let took =
                if self.has_errors { frame.longest_ns(self.rates) } else { missing.end - missing.start };
            let line = self.request_lines[missing.request];
            assert!(
                missing.start + took >= last.at,
                "line {line}: sent from {} to {}, but no line says so",
                missing.start,
                missing.end
            );
        }
        result
    }
}
