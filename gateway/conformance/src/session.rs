//! A conversation with the cell: sends packets to it, collects the packets that it sends, and checks the rules that
//! hold for all of them.

mod accounts;
mod beats;
mod exchange;
mod joints;
mod known;
mod life;
mod receive;
mod request;

use protocol::can::{Format, Frame};
use protocol::candump::{Record, Timestamp};
use protocol::id::{CellId, Id};
use protocol::message::{Heartbeat, Joints, Message, NetworkPage, SensorPage};
use protocol::packet::{Epoch, Words};
use protocol::parameters::MAX_JOINTS;
use protocol::time::{Micros, Span};

use crate::bus::{ObservedFrame, StopReason, TestBus};
use crate::findings::Findings;
use crate::timings::Timings;

pub(crate) use exchange::Exchange;
pub(crate) use joints::JointsResult;
pub(crate) use known::{CellAbilities, KnownCellState};
use life::CellLife;
pub(crate) use request::Reply;

/// The time limit for the answer to a request or a sync.
pub(crate) const ANSWER_TIMEOUT: Span = Span::from_millis(300);
/// The additional wait for answers after the heartbeat that answers a sync.
pub(crate) const SYNC_ANSWER_GRACE: Span = Span::from_millis(5);
/// The time within which a sent frame appears on the bus, even on a busy computer.
const SEND_TIMEOUT: Span = Span::from_millis(1_200);
/// The time without packets after which the cell counts as silent, which ends the test.
const SILENCE_TIMEOUT: Span = Span::from_millis(3_000);

/// A packet that the cell sent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CellPacket {
    /// The time at which the packet was on the bus; of several segments, the last one.
    pub(crate) at: Micros,
    pub(crate) message: Message,
}

impl CellPacket {
    /// Returns the heartbeat and its epoch byte, if the packet is one.
    pub(crate) const fn heartbeat_and_epoch(&self) -> Option<(&Heartbeat, Epoch)> {
        if let Message::Network { page: NetworkPage::Heartbeat(beat), epoch, .. } = &self.message {
            Some((beat, *epoch))
        } else {
            None
        }
    }

    pub(crate) const fn torque(&self) -> Option<(Epoch, &Words)> {
        if let Message::Torque { epoch, torque, .. } = &self.message { Some((*epoch, torque)) } else { None }
    }

    pub(crate) const fn sensors(&self) -> Option<(Epoch, &SensorPage)> {
        if let Message::Sensors { epoch, page, .. } = &self.message { Some((*epoch, page)) } else { None }
    }
}

/// The times, delays and limits of the conversation.
#[derive(Clone, Copy, Debug)]
struct Clock {
    /// The time of the cell's last packet.
    last: Micros,
    /// The time at which the test must end.
    end: Micros,
    /// The maximum lateness of the bench since the exchange began.
    late: Span,
    /// The maximum lateness of the bench since a group of checks began, and since the test began.
    worst: Span,
    longest: Span,
    /// The number of packets whose segments came too late after each other.
    torn: usize,
    /// True if the cell's heartbeats were found not to have the epoch of the last joints.
    other_epochs: bool,
    /// True while the cell is being restored: other senders are then ignored.
    finishing: bool,
    /// True if the last joints were too old when the cell processed them.
    skipped: bool,
    /// The mean time from a request to its answer.
    round_trip: Span,
}

/// The log of the frames that the cell and the bench sent.
#[derive(Debug, Default)]
struct FrameLog {
    frames: Vec<ObservedFrame>,
    /// The index of the first frame of the present exchange.
    since: usize,
    /// The index after the last frame of the previous exchange.
    ended: usize,
}

impl FrameLog {
    /// Returns the frames of the present exchange.
    fn present_frames(&self) -> &[ObservedFrame] {
        self.frames.get(self.since..).unwrap_or_default()
    }
}

/// A conversation with one cell.
pub struct Session<'a> {
    bus: &'a mut dyn TestBus,
    name: String,
    pub(crate) cell: CellId,
    pub(crate) format: Format,
    log: FrameLog,
    /// The packets that the cell sent.
    pub(crate) packets: Vec<CellPacket>,
    /// The index in `heard` at which the present exchange begins.
    pub(crate) from: usize,
    /// The index in `heard` up to which packets were expected.
    consumed: usize,
    /// The number of joints whose answers came so late that the cell may have skipped them.
    pub(crate) skips: u16,
    life: CellLife,
    /// The cell's frames since a restart began, held until it is known whether they are from before or after the
    /// restart.
    held: Option<Vec<(ObservedFrame, Id)>>,
    /// The results.
    pub findings: Findings,
    pub(crate) known: KnownCellState,
    pub(crate) about: CellAbilities,
    tag: u8,
    pub(crate) timings: Timings,
    clock: Clock,
}

impl core::fmt::Debug for Session<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Session")
            .field("cell", &self.cell)
            .field("known", &self.known)
            .finish_non_exhaustive()
    }
}

impl<'a> Session<'a> {
    /// Creates a conversation with a cell on a bus of this name and format, with a time limit.
    pub fn new(bus: &'a mut dyn TestBus, name: &str, cell: CellId, format: Format, longest: Span) -> Self {
        let now = bus.now();
        Self {
            bus,
            name: name.to_owned(),
            cell,
            format,
            log: FrameLog::default(),
            packets: Vec::new(),
            from: 0,
            consumed: 0,
            skips: 0,
            life: CellLife::default(),
            held: None,
            findings: Findings::default(),
            known: KnownCellState::default(),
            about: CellAbilities::default(),
            tag: 0x50,
            timings: Timings::default(),
            clock: Clock {
                last: now,
                end: now + longest,
                late: Span(0),
                worst: Span(0),
                longest: Span(0),
                torn: 0,
                other_epochs: false,
                finishing: false,
                skipped: false,
                round_trip: Span(0),
            },
        }
    }

    pub(crate) fn bus_name(&self) -> &str {
        &self.name
    }

    pub(crate) fn now(&self) -> Micros {
        self.bus.now()
    }

    /// Sets the remaining time, and ignores signals from now on.
    pub(crate) fn set_remaining_time(&mut self, span: Span) {
        self.bus.ignore_signals();
        self.clock.finishing = true;
        self.clock.end = self.bus.now() + span;
        self.clock.last = self.bus.now();
    }

    pub(crate) fn remaining_time(&self) -> Span {
        self.clock.end.elapsed_since(self.bus.now())
    }

    /// Notes that the cell was allowed to be silent until now.
    pub(crate) fn excuse_silence_until_now(&mut self) {
        self.clock.last = self.bus.now();
    }

    pub(crate) fn supports_format(&self, format: Format) -> bool {
        self.bus.supports_format(format)
    }

    pub(crate) fn can_restart(&self) -> bool {
        self.bus.can_restart()
    }

    /// Records the result of a check of requirement `id`; `what` describes a failure. Returns `is_so`.
    pub(crate) fn check(&mut self, id: &'static str, is_so: bool, what: impl FnOnce() -> String) -> bool {
        if is_so {
            self.findings.count_passed(id);
        } else if !self.clock.skipped {
            let (log, name) = (&self.log, &self.name);
            self.findings.count_failed(id, what(), || {
                log.present_frames().iter().map(|seen| frame_line(name, seen)).collect()
            });
        }
        is_so
    }

    /// Begins a new exchange. Packets since the last exchange fail a requirement, unless a cell may send them
    /// unrequested.
    pub(crate) fn begin_exchange(&mut self) {
        let strays: Vec<_> = self.packets.get(self.consumed..).unwrap_or_default().to_vec();
        for stray in strays {
            if let Some(id) = self.known.violated_requirement(&stray.message) {
                let kind = stray.message.id().kind.name();
                self.check(id, false, || {
                    format!("the cell must not send an unrequested {kind} packet, but it sent one")
                });
            }
        }
        self.begin_expected_exchange();
    }

    /// Begins a new exchange, and treats the packets since the last one as expected.
    pub(crate) fn begin_expected_exchange(&mut self) {
        self.clock.skipped = false;
        self.log.since = self.log.ended;
        (self.from, self.consumed) = (self.packets.len(), self.packets.len());
        self.bench_lateness();
        self.clock.late = Span(0);
    }

    /// Marks the packets since the exchange began as expected.
    pub(crate) fn mark_packets_expected(&mut self) {
        self.consumed = self.packets.len();
        self.log.ended = self.log.frames.len();
    }

    /// Returns the packets since the last exchange ended.
    pub(crate) fn packets_since_exchange(&self) -> Vec<CellPacket> {
        self.packets.get(self.consumed..).unwrap_or_default().to_vec()
    }

    /// Returns the cell's packets since the exchange began.
    pub(crate) fn answers(&self) -> &[CellPacket] {
        self.packets.get(self.from..).unwrap_or_default()
    }

    /// Discards the known state of the cell, except its last epoch and its number of joints.
    pub(crate) fn forget_cell_state(&mut self) {
        self.known = KnownCellState {
            last_epoch: self.known.last_epoch,
            joints: self.known.joints,
            hash: None,
            ..KnownCellState::default()
        };
    }

    /// Sends frames, and returns the time at which the last one was on the bus.
    pub(crate) fn send(&mut self, frames: &[Frame]) -> Result<Micros, StopReason> {
        let times = self.send_all(frames)?;
        Ok(times.last().copied().unwrap_or_else(|| self.now()))
    }

    /// Sends frames, and returns the time at which each was on the bus.
    pub(crate) fn send_all(&mut self, frames: &[Frame]) -> Result<Vec<Micros>, StopReason> {
        let Some(last) = frames.last() else { return Ok(Vec::new()) };
        let before = self.log.frames.len();
        let sent = self.bus.now();
        self.bus.send(frames)?;
        let give_up = self.bus.now() + SEND_TIMEOUT;
        loop {
            let own = self.log.frames.get(before..).unwrap_or_default().iter().filter(|seen| seen.own);
            let own: Vec<_> = own.map(|seen| seen.at).collect();
            if own.len() >= frames.len() {
                let waited = own.last().map_or(Span(0), |at| at.elapsed_since(sent));
                self.clock.worst = self.clock.worst.max(waited);
                return Ok(own);
            }
            if self.bus.now() >= give_up {
                return Err(StopReason::Bus(format!(
                    "{}: frame {last} was sent, but did not appear on the bus",
                    self.name
                )));
            }
            self.process_next_frame(give_up)?;
        }
    }

    /// Encodes a packet as frames for this bus.
    pub(crate) fn frames(&self, message: &Message) -> Vec<Frame> {
        message.encode().frames(self.format).collect()
    }

    /// Sends packets, and returns the time at which the first one was completely on the bus.
    pub(crate) fn send_messages(&mut self, messages: &[Message]) -> Result<Micros, StopReason> {
        let mut at = None;
        for message in messages {
            let frames = self.frames(message);
            let on_bus = self.send(&frames)?;
            at.get_or_insert(on_bus);
        }
        Ok(at.unwrap_or_else(|| self.now()))
    }

    /// Receives until a time, or until a condition on the packets since the exchange began is met. Returns true if it
    /// was met.
    pub(crate) fn wait_for_packets(
        &mut self,
        until: Micros,
        mut done: impl FnMut(&[CellPacket]) -> bool,
    ) -> Result<bool, StopReason> {
        loop {
            if done(self.answers()) {
                return Ok(true);
            }
            if self.bus.now() >= until {
                return Ok(false);
            }
            self.process_next_frame(until)?;
        }
    }

    /// Receives packets for this time.
    pub(crate) fn receive_for(&mut self, span: Span) -> Result<(), StopReason> {
        let until = self.bus.now() + span;
        self.wait_for_packets(until, |_| false).map(|_| ())
    }

    /// Waits 15 ms for late packets of the cell, and begins a new exchange.
    pub(crate) fn wait_for_late_packets(&mut self) -> Result<(), StopReason> {
        self.receive_for(Span::from_millis(15))?;
        self.begin_exchange();
        Ok(())
    }

    /// Returns the maximum lateness of the bench since the exchange began.
    pub(crate) fn bench_lateness(&mut self) -> Span {
        self.clock.late = self.clock.late.max(self.bus.bench_lateness());
        self.clock.worst = self.clock.worst.max(self.clock.late);
        self.clock.longest = self.clock.longest.max(self.clock.late);
        self.clock.late
    }

    /// Returns the maximum lateness of the bench since the last call, over all exchanges.
    pub(crate) fn worst_bench_lateness(&mut self) -> Span {
        self.bench_lateness();
        core::mem::take(&mut self.clock.worst)
    }

    /// Checks that the segments of packets followed each other in time; a busy processor may delay them in a few
    /// packets.
    pub(crate) fn check_segment_times(&mut self) -> Result<(), StopReason> {
        const MAX_TORN_PACKETS: usize = 3;
        if self.format == Format::Classic {
            if self.life.has_waiting_segment() {
                self.receive_for(Span(ANSWER_TIMEOUT.0 + 10_000))?;
            }
            let torn = self.clock.torn;
            self.check("SEND-1", torn <= MAX_TORN_PACKETS, || {
                format!(
                    "the segments of a packet must follow each other without long pauses, but {torn} packets \
                     had a late segment"
                )
            });
        }
        Ok(())
    }

    /// Measures the mean time from a request to its answer.
    pub(crate) fn measure_round_trip(&mut self) -> Result<(), StopReason> {
        const MEASURED_READ_COUNT: u64 = 8;
        let began = self.now();
        for _ in 0..MEASURED_READ_COUNT {
            self.read_parameter(0)?;
        }
        self.clock.round_trip = Span(self.now().elapsed_since(began).0 / MEASURED_READ_COUNT);
        Ok(())
    }

    /// Returns true if answers are so slow that checks have to be reduced.
    pub(crate) fn are_answers_slow(&self) -> bool {
        self.clock.round_trip > Span::from_millis(4)
    }

    /// Returns the number of attempts of a check: `many`, or a quarter of it if answers are slow.
    pub(crate) fn reduced_attempts(&self, many: usize) -> usize {
        if self.are_answers_slow() { many.div_ceil(4) } else { many }
    }

    /// Records the time from a request to its answer, with the lateness of the bench meanwhile.
    pub(crate) fn record_answer_time(&mut self, what: &'static str, asked: Micros, answered: Micros) {
        let late = self.bench_lateness();
        self.timings.record_answer(what, answered.elapsed_since(asked), late);
    }

    /// Returns a joints message for the chain in use.
    pub(crate) fn joints_message(&self, epoch: u8, positions: &[i16; MAX_JOINTS]) -> Message {
        self.joints_message_for_chain(epoch, positions, self.known.joints)
    }

    /// Returns a joints message for a chain of `in_use` joints; further words are 0.
    pub(crate) fn joints_message_for_chain(
        &self,
        epoch: u8,
        positions: &[i16; MAX_JOINTS],
        in_use: u8,
    ) -> Message {
        let mut words = *positions;
        words.iter_mut().skip(in_use.into()).for_each(|word| *word = 0);
        let positions = words.map(protocol::fixed::Q1_14::from_bits);
        Message::Joints { epoch: Epoch(epoch), joints: Joints { positions, in_use } }
    }
}

/// Formats a frame in candump's notation, with T for frames of the bench and R for others.
fn frame_line(name: &str, seen: &ObservedFrame) -> String {
    let time = Timestamp::with_six_digits(seen.at.0 * 1_000);
    let record = Record { time, interface: name, frame: seen.frame, direction: None };
    format!("{record} {}", if seen.own { 'T' } else { 'R' })
}
