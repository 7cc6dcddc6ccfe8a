//! Frames from the bus to a line: encodes them as text, and queues them until the line and the bus behind the adapter
//! have had time to carry the frames before.

use std::collections::VecDeque;
use std::time::Duration;

use protocol::can::{BIT_RATE_SWITCH, Format, Frame};
use protocol::slcan::{CR, encode};
use protocol::wire_time::{BitRates, FrameBits};

use super::account::ToLineCounts;
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

    fn cost(self, frame: &Frame, bytes: usize) -> Duration {
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
    /// The counts of the frames.
    pub account: ToLineCounts,
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
    pub fn line_opened(&mut self, opening: &[OpeningStep]) {
        self.line_lost();
        self.is_up = true;
        opening.iter().for_each(|step| self.push_step(step));
    }

    /// Queues the commands `opening` to open the adapter again. They are written after a frame that is being written,
    /// and before all others.
    pub fn reopen(&mut self, opening: &[OpeningStep]) {
        let begun = usize::from(self.written > 0);
        let rest = self.entries.front().filter(|_| begun > 0).map_or(0, |entry| entry.bytes - self.written);
        let text = self.text.split_off(rest);
        let entries = self.entries.split_off(begun);
        (self.released, self.released_bytes) = (begun, rest);
        self.stage = OpeningStage::Away;
        opening.iter().for_each(|step| self.push_step(step));
        self.text.extend(text);
        self.entries.extend(entries);
    }

    /// Returns the stage that the opening of the adapter has reached.
    #[must_use]
    pub const fn stage(&self) -> OpeningStage {
        self.stage
    }

    /// Records that the adapter refused `lines` lines. As many sent frames are counted as refused instead of sent.
    pub fn count_refused(&mut self, lines: u64) {
        let frames = lines.min(self.since_open);
        self.since_open -= frames;
        self.account.sent -= frames;
        self.account.dropped.refused += frames;
    }

    /// Records that the line was lost, and drops the queued frames.
    pub fn line_lost(&mut self) {
        let waiting = self.clear();
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
            self.push(text.as_bytes(), self.pace.cost(frame, text.as_bytes().len()), QueuedTextKind::Frame);
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
                }
                QueuedTextKind::Command(stage) => {
                    if stage == OpeningStage::Open {
                        self.since_open = 0;
                    }
                    self.stage = stage;
                }
            }
            self.entries.pop_front();
            self.released -= 1;
        }
    }

    /// Drops the queued frames, except one that is being written, and queues the bytes `closing`.
    pub fn queue_closing(&mut self, closing: &[u8]) {
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
    pub fn drop_unfinished(&mut self) {
        self.account.dropped.ended += self.clear();
        self.is_up = false;
    }

    /// Returns true if nothing is queued.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    fn push_step(&mut self, step: &OpeningStep) {
        // Writing ahead of the computed pace must not shorten the gap between commands, so the gap is extended.
        self.push(&step.bytes, step.gap + MAX_WRITE_AHEAD, QueuedTextKind::Command(step.stage));
    }

    fn push(&mut self, text: &[u8], cost: Duration, kind: QueuedTextKind) {
        self.text.extend(text);
        self.entries.push_back(QueuedText { bytes: text.len(), cost, kind });
    }

    /// Empties the queue. Returns the number of frames that were in it.
    fn clear(&mut self) -> u64 {
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
mod tests {
    use super::*;
    use proptest::prelude::*;
    use protocol::can::ERROR;

    const NOW: Duration = Duration::from_secs(1);

    fn frame(number: u8) -> Frame {
        Frame::classic(0x123, &[number]).unwrap()
    }

    /// Returns an opening that may be written at once.
    fn opening(text: &[u8]) -> Vec<OpeningStep> {
        vec![OpeningStep { bytes: text.to_vec(), gap: Duration::ZERO, stage: OpeningStage::Open }]
    }

    /// Writes as much as may be written at the time `now`. Returns the written bytes.
    fn drain(outgoing: &mut BusToLineQueue, now: Duration) -> Vec<u8> {
        let mut all = Vec::new();
        loop {
            let (bytes, _) = outgoing.ready_bytes(now);
            if bytes.is_empty() {
                return all;
            }
            let count = bytes.len();
            all.extend_from_slice(bytes);
            outgoing.remove_written(count);
        }
    }

    #[test]
    fn frames_follow_the_opening_in_order() {
        let mut outgoing = BusToLineQueue::new(false, LinePace::default());
        outgoing.push_frame(&frame(0));
        outgoing.line_opened(&opening(b"\rC\rO\r"));
        outgoing.push_frame(&frame(1));
        outgoing.push_frame(&Frame::fd(1, 1, &[2]).unwrap());
        outgoing.push_frame(&Frame::classic(ERROR | 4, &[0; 8]).unwrap());
        assert_eq!(drain(&mut outgoing, NOW), b"\rC\rO\rt123101\rb001102\r");
        let ToLineCounts { received, sent, dropped, .. } = outgoing.account;
        assert_eq!((received, sent, dropped.line_away, dropped.error_frame), (4, 2, 1, 1));
        assert_eq!(dropped.total(), 2);
    }

    #[test]
    fn the_commands_of_an_opening_leave_one_by_one() {
        let options: LineOptions = "/dev/x,rates=1M/5M".parse().unwrap();
        let mut outgoing = BusToLineQueue::from_options(&options);
        outgoing.line_opened(&options.opening_steps());
        outgoing.push_frame(&frame(1));
        let (mut now, mut written) = (NOW, Vec::new());
        loop {
            let text = drain(&mut outgoing, now);
            if !text.is_empty() {
                written.push((text, now - NOW, outgoing.stage()));
            }
            let Some(again) = outgoing.ready_bytes(now).1 else { break };
            now = again;
        }
        let millis = |at: u64| Duration::from_millis(at);
        let expected = [
            (b"\r".to_vec(), millis(0), OpeningStage::Away),
            (b"C\r".to_vec(), millis(10), OpeningStage::Closed),
            (b"S8\r".to_vec(), millis(40), OpeningStage::Setting),
            (b"Y5\r".to_vec(), millis(50), OpeningStage::Setting),
            (b"O\r".to_vec(), millis(60), OpeningStage::Open),
            (b"t123101\r".to_vec(), millis(70), OpeningStage::Open),
        ];
        let at = |(text, at, stage): (Vec<u8>, Duration, OpeningStage)| (text, at.as_millis() / 10, stage);
        assert_eq!(written.into_iter().map(at).collect::<Vec<_>>(), expected.map(at));
    }

    #[test]
    fn frames_switch_to_no_bit_rate_that_equals_the_nominal_one() {
        let frames = [Frame::fd(0x123, 1, &[2]).unwrap(), Frame::fd(0x123, 0, &[2]).unwrap(), frame(3)];
        for (rates, expected) in [
            ("", "b123102\rd123102\rt123103\r"),
            (",rates=1M/2M", "b123102\rd123102\rt123103\r"),
            (",rates=1M/1M", "d123102\rd123102\rt123103\r"),
            (",rates=250k", "d123102\rd123102\rt123103\r"),
        ] {
            let mut outgoing = BusToLineQueue::from_options(&format!("/dev/x{rates}").parse().unwrap());
            for _ in 0..2 {
                outgoing.line_opened(&[]);
                frames.iter().for_each(|frame| outgoing.push_frame(frame));
                assert_eq!(drain(&mut outgoing, NOW), expected.as_bytes(), "{rates}");
            }
        }
    }

    #[test]
    fn a_frame_that_the_adapter_refused_was_not_sent() {
        let mut outgoing = BusToLineQueue::new(false, LinePace::default());
        outgoing.line_opened(&opening(b"O\r"));
        (0..5).for_each(|number| outgoing.push_frame(&frame(number)));
        drain(&mut outgoing, NOW);
        outgoing.count_refused(2);
        assert_eq!((outgoing.account.sent, outgoing.account.dropped.refused), (3, 2));
        // A frame that is being written is completed before the adapter is opened again. The queued frames follow.
        (5..7).for_each(|number| outgoing.push_frame(&frame(number)));
        outgoing.ready_bytes(NOW);
        outgoing.remove_written(3);
        outgoing.reopen(&opening(b"C\rO\r"));
        assert_eq!(outgoing.stage(), OpeningStage::Away);
        assert_eq!(drain(&mut outgoing, NOW + MAX_WRITE_AHEAD), b"3105\rC\rO\rt123106\r");
        assert_eq!(outgoing.stage(), OpeningStage::Open);
        // If more lines are refused than frames were sent since the opening, the others were commands.
        outgoing.count_refused(9);
        let ToLineCounts { received, sent, dropped, .. } = outgoing.account;
        assert_eq!((received, sent, dropped.refused, dropped.total()), (7, 4, 3, 3));
    }

    #[test]
    fn a_classic_line_gets_no_fd_frames() {
        let mut outgoing = BusToLineQueue::new(true, LinePace::default());
        outgoing.line_opened(&[]);
        outgoing.push_frame(&Frame::fd(1, 1, &[2]).unwrap());
        outgoing.push_frame(&frame(1));
        assert_eq!(drain(&mut outgoing, NOW), b"t123101\r");
        assert_eq!(outgoing.account.dropped.not_classic, 1);
    }

    #[test]
    fn what_is_cut_off_is_not_sent_and_what_comes_back_begins_afresh() {
        let mut outgoing = BusToLineQueue::new(false, LinePace::default());
        outgoing.line_opened(&opening(b"O\r"));
        for number in 0..3 {
            outgoing.push_frame(&frame(number));
        }
        outgoing.ready_bytes(NOW);
        outgoing.remove_written(2 + 8 + 3);
        assert_eq!(outgoing.account.sent, 1);
        outgoing.line_lost();
        assert_eq!(outgoing.account.dropped.line_away, 2);
        outgoing.line_opened(&opening(b"\rO\r"));
        outgoing.push_frame(&frame(9));
        assert_eq!(drain(&mut outgoing, NOW), b"\rO\rt123109\r");
    }

    #[test]
    fn the_end_finishes_the_line_that_was_begun_and_closes() {
        let mut outgoing = BusToLineQueue::new(false, LinePace::default());
        outgoing.line_opened(&[]);
        outgoing.push_frame(&frame(1));
        outgoing.push_frame(&frame(2));
        outgoing.ready_bytes(NOW);
        outgoing.remove_written(3);
        outgoing.queue_closing(&closing_command());
        assert_eq!(drain(&mut outgoing, NOW), b"3101\rC\r");
        assert_eq!((outgoing.account.sent, outgoing.account.dropped.ended), (1, 1));
        // A frame of which only a part was written is not counted as sent.
        let mut stuck = BusToLineQueue::new(false, LinePace::default());
        stuck.line_opened(&[]);
        stuck.push_frame(&frame(1));
        stuck.ready_bytes(NOW);
        stuck.remove_written(3);
        stuck.queue_closing(&closing_command());
        stuck.drop_unfinished();
        assert_eq!((stuck.account.sent, stuck.account.dropped.ended, stuck.is_empty()), (0, 1, true));
        // A line that is not open gets no command to close its adapter.
        let mut away = BusToLineQueue::new(false, LinePace::default());
        away.queue_closing(&closing_command());
        assert!(away.is_empty());
    }

    #[test]
    fn a_bus_at_125k_gets_no_more_than_it_carries() {
        let pace = LinePace { bit_rates: Some("125k".parse().unwrap()), baud: None };
        let mut outgoing = BusToLineQueue::new(true, pace);
        outgoing.line_opened(&[]);
        // The frame has 34 + 8 + 13 bits, and stuff bits in addition.
        let cost = Duration::from_nanos(
            FrameBits::from_frame(&frame(0xAA)).unwrap().nanoseconds("125k".parse().unwrap()),
        );
        let (mut now, mut sent) = (NOW, 0);
        while now < NOW + Duration::from_secs(1) {
            outgoing.push_frame(&frame(0xAA));
            sent += drain(&mut outgoing, now).len() / 8;
            now += Duration::from_micros(100);
        }
        let carried =
            usize::try_from((Duration::from_secs(1) + MAX_WRITE_AHEAD).as_nanos() / cost.as_nanos()).unwrap();
        assert!((carried..=carried + 1).contains(&sent), "{sent} of {carried}");
        let ToLineCounts { received, sent, dropped, .. } = outgoing.account;
        assert_eq!(received, sent + dropped.queue_full + outgoing.entries.len() as u64);
        assert!(dropped.queue_full > 5_000);
        let (_, again) = outgoing.ready_bytes(now);
        assert!(again.unwrap() <= now + cost, "it says when to come again");
    }

    #[test]
    fn a_wire_at_9600_baud_is_the_slower_one() {
        let pace = LinePace { bit_rates: Some("1M".parse().unwrap()), baud: Some(9_600) };
        assert_eq!(pace.cost(&frame(1), 8), Duration::from_nanos(8_333_333));
        assert_eq!(LinePace { baud: None, ..pace }.cost(&frame(1), 8), Duration::from_nanos(58_000));
    }

    proptest! {
        #[test]
        fn every_frame_is_sent_or_dropped_for_a_reason(
            steps in proptest::collection::vec((0_u8..10, 0_usize..100), 0..100), slow: bool
        ) {
            let pace = LinePace { bit_rates: slow.then(|| "10k".parse().unwrap()), baud: None };
            let mut outgoing = BusToLineQueue::new(false, pace);
            let mut now = NOW;
            for (kind, amount) in steps {
                match kind {
                    0 => outgoing.line_opened(&opening(b"\rC\rO\r")),
                    1 => outgoing.line_lost(),
                    2 => now += Duration::from_millis(amount as u64),
                    3 | 4 => {
                        let bytes = outgoing.ready_bytes(now).0.len().min(amount);
                        outgoing.remove_written(bytes);
                    }
                    _ => (0..amount).for_each(|_| outgoing.push_frame(&frame(1))),
                }
                let waiting = outgoing.entries.iter().filter(|entry| entry.is_frame()).count() as u64;
                let ToLineCounts { received, sent, dropped, .. } = outgoing.account;
                prop_assert_eq!(received, sent + dropped.total() + waiting);
                let text: usize = outgoing.entries.iter().map(|entry| entry.bytes).sum();
                prop_assert_eq!(text, outgoing.text.len() + outgoing.written);
                prop_assert!(waiting <= MAX_WAITING_FRAMES as u64);
            }
            outgoing.queue_closing(b"C\r");
            let rest = drain(&mut outgoing, now);
            prop_assert!(rest.is_empty() || rest.ends_with(b"C\r"));
            let ToLineCounts { received, sent, dropped, .. } = outgoing.account;
            prop_assert_eq!(received, sent + dropped.total());
        }
    }
}
