//! Frames from the bus to a line: encodes them as text, and queues them until the line and the bus behind the adapter
//! have had time to carry the frames before.

use std::collections::VecDeque;
use std::time::Duration;

use protocol::can::{BIT_RATE_SWITCH, Format, Frame};
use protocol::slcan::{CR, encode};
use protocol::wire_time::{BitRates, FrameBits};

use super::account::BusToLineCounts;
use super::options::{LineOptions, OpeningStage, OpeningStep};

/// The maximum number of queued frames: those that a line at 1 Mbaud carries in a tenth of a second.
pub const MAX_WAITING_FRAMES: usize = 256;
/// The time by which writing may be ahead of the computed pace. It corresponds to what an adapter buffers.
pub const MAX_WRITE_AHEAD: Duration = Duration::from_millis(2);

/// The rates from which the time for a frame is computed.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct LinePace {
    /// The bit rates of the bus behind the adapter.
    pub bit_rates: Option<BitRates>,
    /// The speed of the serial line in bit/s. A byte takes ten bits.
    pub baud: Option<u32>,
}

impl LinePace {
    /// Returns the rates of a line and of the bus behind its adapter.
    #[must_use]
    pub const fn from_options(options: &LineOptions) -> Self {
        Self { bit_rates: options.bit_rates, baud: options.baud }
    }

    fn sending_time(self, frame: &Frame, bytes: usize) -> Duration {
        let bus = self
            .bit_rates
            .zip(FrameBits::from_frame(frame))
            .map_or(0, |(rates, bits)| bits.nanoseconds(rates));
        let wire = self.baud.map_or(0, |baud| bytes as u64 * 10_000_000_000 / u64::from(baud.max(1)));
        Duration::from_nanos(bus.max(wire))
    }
}

/// A frame or command as text that is queued or being written.
#[derive(Debug)]
struct QueuedText {
    bytes: usize,
    cost: Duration,
    kind: QueuedTextKind,
}

/// The kind of text in an entry.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum QueuedTextKind {
    Frame,
    /// A command, which is not counted as a frame. The adapter is in this stage once the command is written.
    Command(OpeningStage),
}

impl QueuedText {
    fn is_frame(&self) -> bool {
        self.kind == QueuedTextKind::Frame
    }
}

/// The queue of frames from the bus to a line.
#[derive(Debug, Default)]
pub struct BusToLineQueue {
    classic: bool,
    one_rate: bool,
    pace: LinePace,
    text: VecDeque<u8>,
    entries: VecDeque<QueuedText>,
    written: usize,
    /// The number of entries that may be written by now, and the number of their bytes that are not written yet.
    released: usize,
    released_bytes: usize,
    busy_until: Duration,
    is_up: bool,
    stage: OpeningStage,
    since_open: u64,
    /// True if a setting was written, and no frame since then.
    is_setting_unproven: bool,
    /// The counts of the frames.
    pub account: BusToLineCounts,
}

impl BusToLineQueue {
    /// Creates an empty queue to a line that is not open yet. With `classic`, FD frames are dropped.
    #[must_use]
    pub fn new(classic: bool, pace: LinePace) -> Self {
        Self { classic, pace, ..Self::default() }
    }

    /// Creates an empty queue to a line with these options.
    #[must_use]
    pub fn from_options(options: &LineOptions) -> Self {
        let one_rate = !options.switches_bit_rate();
        Self { one_rate, ..Self::new(options.classic, LinePace::from_options(options)) }
    }

    /// Records that the line is open. The commands `opening` are written before any frame.
    pub fn handle_line_opened(&mut self, opening: &[OpeningStep]) {
        self.handle_line_lost();
        self.is_up = true;
        opening.iter().for_each(|step| self.push_opening_step(step));
    }

    /// Queues the commands `opening` to open the adapter again. They are written after a frame that is being written,
    /// and before all others.
    pub fn queue_reopening(&mut self, opening: &[OpeningStep]) {
        let begun = usize::from(self.written > 0);
        let rest = self.entries.front().filter(|_| begun > 0).map_or(0, |entry| entry.bytes - self.written);
        let text = self.text.split_off(rest);
        let entries = self.entries.split_off(begun);
        (self.released, self.released_bytes) = (begun, rest);
        self.stage = OpeningStage::Away;
        opening.iter().for_each(|step| self.push_opening_step(step));
        self.text.extend(text);
        self.entries.extend(entries);
    }

    /// Returns the stage that the opening of the adapter has reached.
    #[must_use]
    pub const fn opening_stage(&self) -> OpeningStage {
        self.stage
    }

    /// Returns the stage of what the adapter may be refusing now. Before the first frame, a refusal by an open adapter
    /// is a late answer to a setting, if there was one.
    #[must_use]
    pub const fn refused_stage(&self) -> OpeningStage {
        if self.is_setting_unproven && matches!(self.stage, OpeningStage::Open) {
            OpeningStage::Setting
        } else {
            self.stage
        }
    }

    /// Records that the adapter refused `lines` lines. As many sent frames are counted as refused instead of sent.
    pub fn count_refused(&mut self, lines: u64) {
        let frames = lines.min(self.since_open);
        self.since_open -= frames;
        self.account.sent -= frames;
        self.account.dropped.refused += frames;
    }

    /// Records that the line was lost, and drops the queued frames.
    pub fn handle_line_lost(&mut self) {
        let waiting = self.clear_and_count();
        self.account.dropped.line_away += waiting;
        self.is_up = false;
    }

    /// Queues a frame of the bus, or drops it if the line cannot carry it or the queue is full.
    pub fn push_frame(&mut self, frame: &Frame) {
        self.account.received += 1;
        let dropped = &mut self.account.dropped;
        let one_rate = frame.flags() & BIT_RATE_SWITCH != 0 && self.one_rate;
        let unswitched = one_rate.then(|| without_rate_switch(frame)).flatten();
        let frame = unswitched.as_ref().unwrap_or(frame);
        let Some(text) = encode(frame) else {
            dropped.error_frame += 1;
            return;
        };
        let reason = if self.classic && frame.format() == Format::Fd {
            &mut dropped.not_classic
        } else if !self.is_up {
            &mut dropped.line_away
        } else if self.entries.len() >= MAX_WAITING_FRAMES {
            &mut dropped.queue_full
        } else {
            self.push(
                text.as_bytes(),
                self.pace.sending_time(frame, text.as_bytes().len()),
                QueuedTextKind::Frame,
            );
            return;
        };
        *reason += 1;
    }

    /// Returns the bytes that may be written now. If entries remain, also returns the time at which more may be
    /// written.
    pub fn ready_bytes(&mut self, now: Duration) -> (&[u8], Option<Duration>) {
        while let Some(entry) = self.entries.get(self.released) {
            if self.busy_until > now + MAX_WRITE_AHEAD {
                break;
            }
            self.busy_until = self.busy_until.max(now) + entry.cost;
            self.released += 1;
            self.released_bytes += entry.bytes;
        }
        let again =
            (self.released < self.entries.len()).then(|| self.busy_until.saturating_sub(MAX_WRITE_AHEAD));
        let (text, _) = self.text.as_slices();
        (text.get(..self.released_bytes.min(text.len())).unwrap_or_default(), again)
    }

    /// Removes the first `bytes` bytes after they were written to the line.
    pub fn remove_written(&mut self, bytes: usize) {
        let bytes = bytes.min(self.released_bytes);
        self.text.drain(..bytes);
        self.released_bytes -= bytes;
        self.written += bytes;
        while let Some(entry) = self.entries.front().filter(|entry| entry.bytes <= self.written) {
            self.written -= entry.bytes;
            match entry.kind {
                QueuedTextKind::Frame => {
                    self.account.sent += 1;
                    self.since_open += 1;
                    self.is_setting_unproven = false;
                }
                QueuedTextKind::Command(stage) => {
                    match stage {
                        OpeningStage::Away | OpeningStage::Closed => self.is_setting_unproven = false,
                        OpeningStage::Setting => self.is_setting_unproven = true,
                        OpeningStage::Open => self.since_open = 0,
                    }
                    self.stage = stage;
                }
            }
            self.entries.pop_front();
            self.released -= 1;
        }
    }

    /// Drops the queued frames, except one that is being written, and queues the bytes `closing`.
    pub fn queue_closing_bytes(&mut self, closing: &[u8]) {
        let begun = usize::from(self.written > 0);
        let dropped = self.entries.iter().skip(begun).filter(|entry| entry.is_frame()).count();
        self.account.dropped.ended += dropped as u64;
        let rest = self.entries.front().filter(|_| begun > 0).map_or(0, |entry| entry.bytes - self.written);
        self.text.truncate(rest);
        self.entries.truncate(begun);
        self.released = begun;
        self.released_bytes = rest;
        self.busy_until = Duration::ZERO;
        if self.is_up {
            self.push(closing, Duration::ZERO, QueuedTextKind::Command(OpeningStage::Closed));
        }
    }

    /// Drops the frame that is being written, because the line is closed before its end.
    pub fn drop_unfinished_frame(&mut self) {
        self.account.dropped.ended += self.clear_and_count();
        self.is_up = false;
    }

    /// Returns true if nothing is queued.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    fn push_opening_step(&mut self, step: &OpeningStep) {
        // Writing ahead of the computed pace must not shorten the gap between commands, so the gap is extended.
        self.push(&step.bytes, step.gap + MAX_WRITE_AHEAD, QueuedTextKind::Command(step.stage));
    }

    fn push(&mut self, text: &[u8], cost: Duration, kind: QueuedTextKind) {
        self.text.extend(text);
        self.entries.push_back(QueuedText { bytes: text.len(), cost, kind });
    }

    /// Empties the queue. Returns the number of frames that were in it.
    fn clear_and_count(&mut self) -> u64 {
        let frames = self.entries.iter().filter(|entry| entry.is_frame()).count();
        let Self { classic, one_rate, pace, account, .. } = *self;
        *self = Self { account, one_rate, ..Self::new(classic, pace) };
        frames as u64
    }
}

/// Returns a copy of an FD frame without the flag that switches to the data bit rate.
fn without_rate_switch(frame: &Frame) -> Option<Frame> {
    let flags = frame.flags() & !BIT_RATE_SWITCH;
    Frame::with_data(frame.raw_id(), frame.format(), flags, frame.data()).ok()
}

/// Returns the command that closes an adapter.
#[must_use]
pub fn closing_command() -> Vec<u8> {
    let close = protocol::slcan::SlcanCommand::Close.encode();
    debug_assert!(close.as_bytes().ends_with(&[CR]));
    close.as_bytes().to_vec()
}

#[cfg(test)]
mod tests;
