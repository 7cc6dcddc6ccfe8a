//! Tests of restarts that cut off the cell's packets at any point, and of faulty cells.

use std::collections::VecDeque;

use protocol::can::{Format, Frame};
use protocol::id::CellId;
use protocol::message::{Answer, Heartbeat};
use protocol::packet::Epoch;

use super::*;
use crate::bus::{ObservedFrame, TestBus};

const OLD: Span = Span(120);
const NEW: Span = Span::from_millis(60);
/// Durations of the restart command: it ends before the restarted cell sends, or after that.
const COMMANDS: [Span; 2] = [Span::from_millis(40), Span::from_millis(100)];

/// A bus that plays back a script of the cell's frames.
struct Script {
    now: Micros,
    wire: VecDeque<ObservedFrame>,
    /// The frames that come after the command of each restart, with their delays.
    next: VecDeque<Vec<(Span, Frame)>>,
    /// The duration of the restart command.
    takes: Span,
    restarted: Micros,
}

impl TestBus for Script {
    fn now(&self) -> Micros {
        self.now
    }

    fn supports_format(&self, _: Format) -> bool {
        true
    }

    fn send(&mut self, _: &[Frame]) -> Result<(), StopReason> {
        Ok(())
    }

    fn receive(&mut self, until: Micros) -> Result<Option<ObservedFrame>, StopReason> {
        let seen = self.wire.pop_front_if(|seen| seen.at <= until);
        self.now = self.now.max(seen.map_or(until, |seen| seen.at));
        Ok(seen)
    }

    fn bench_lateness(&mut self) -> Span {
        Span(0)
    }

    fn ignore_signals(&mut self) {}

    fn can_restart(&self) -> bool {
        true
    }

    fn begin_restart(&mut self) -> Result<(), StopReason> {
        self.restarted = self.now + self.takes;
        let frames = self.next.pop_front().unwrap_or_default();
        self.wire.extend(frames.into_iter().map(|(after, frame)| seen(self.now + after, frame)));
        Ok(())
    }

    fn is_restarting(&mut self) -> Result<bool, StopReason> {
        Ok(self.now < self.restarted)
    }
}

fn seen(at: Micros, frame: Frame) -> ObservedFrame {
    ObservedFrame { at, frame, own: false }
}

fn beat(sent: u16, claiming: bool) -> Message {
    let state = State::default().with_flags(State::CLAIMING_NODE_ID, claiming).with_joint(0);
    let beat = Heartbeat { sent, serial: 100_012, state, ..Heartbeat::default() };
    Message::Network { from: Node::Cell(cell()), epoch: Epoch(0), page: NetworkPage::Heartbeat(beat) }
}

fn answer(tag: u8) -> Message {
    let answer = Answer::Value { number: 2, written: true, words: [tag.into(), 2, 3, 4, 5, 6] };
    Message::Configured { from: cell(), tag, answer }
}

fn cell() -> CellId {
    CellId::new(12).unwrap()
}

fn frames(messages: &[Message], format: Format) -> Vec<Frame> {
    messages.iter().flat_map(|message| message.encode().frames(format).collect::<Vec<_>>()).collect()
}

/// Returns `length` frames, from index `start` on, of a cell that started a while ago.
fn former_life(format: Format, start: usize, length: usize) -> Vec<Frame> {
    let all = (0..10)
        .map(|place| if place % 3 == 0 { beat(40 + place, false) } else { answer(place.to_le_bytes()[0]) });
    let all: Vec<_> = all.collect();
    frames(&all, format).into_iter().skip(start).take(length).collect()
}

/// Returns the frames that a correct cell sends right after its start.
fn new_life(format: Format) -> Vec<Frame> {
    frames(&[beat(0, true), beat(1, false), answer(1), beat(3, false)], format)
}

/// Returns the requirements that fail at a restart. The first `before` of the frames `former` come before the restart
/// command, the others and then `new` after it.
fn failed(format: Format, takes: Span, former: &[Frame], before: usize, new: &[Frame]) -> Vec<&'static str> {
    let (before, after) = former.split_at(before);
    let now = Micros(1_000_000);
    let spaced = |frames: &[Frame], from: Span| -> Vec<_> {
        (1..).zip(frames).map(|(place, frame)| (Span(from.0 + place * OLD.0), *frame)).collect()
    };
    let wire = spaced(before, Span(0)).into_iter().map(|(after, frame)| seen(now + after, frame)).collect();
    let mut next = spaced(after, Span(0));
    next.extend(spaced(new, NEW));
    let mut bus = Script { now, wire, next: VecDeque::from([next]), takes, restarted: now };
    let mut session = Session::new(&mut bus, "vcan0", cell(), format, Span::from_millis(60_000));
    session.about.serial = Some(100_012);
    session.receive_for(Span((before.len() as u64 + 1) * OLD.0)).unwrap();
    session.mark_packets_expected();
    let claimed = restart(&mut session).map(|claimed| settled(&mut session, claimed));
    assert!(matches!(claimed, Ok(Ok(_))), "{claimed:?}");
    session.receive_for(Span::from_millis(500)).unwrap();
    session.check_segment_times().unwrap();
    session.findings.failed_requirements()
}

#[test]
fn nothing_of_a_life_that_was_cut_off_counts() {
    let mut restarts = 0;
    for format in [Format::Classic, Format::Fd] {
        let new = new_life(format);
        // The test may also begin in the middle of a packet.
        for start in 0..8 {
            for length in 0..=14.min(former_life(format, start, 99).len()) {
                let former = former_life(format, start, length);
                for before in 0..=length {
                    for takes in COMMANDS {
                        let failed = failed(format, takes, &former, before, &new);
                        assert_eq!(failed, [""; 0], "{format:?}: {before} of {length} frames from {start}");
                        restarts += 1;
                    }
                }
            }
        }
    }
    assert!(restarts > 1_000, "{restarts}");
}

#[test]
fn a_contact_that_bounces_starts_the_cell_twice() {
    for format in [Format::Classic, Format::Fd] {
        let once = new_life(format);
        for length in frames(&[beat(0, true)], format).len()..once.len() {
            let bounced: Vec<_> = once.iter().take(length).copied().collect();
            assert_eq!(failed(format, COMMANDS[1], &bounced, 0, &once), [""; 0], "{format:?}: {length}");
        }
    }
}

#[test]
fn a_cell_that_is_wrong_about_its_packets_is_still_found() {
    let format = Format::Classic;
    let (former, new, takes) = (former_life(format, 0, 16), new_life(format), COMMANDS[0]);
    let without = |frames: &[Frame], place: usize| -> Vec<_> {
        frames.iter().enumerate().filter(|(at, _)| *at != place).map(|(_, frame)| *frame).collect()
    };
    // A segment is missing before or after the restart, but not in the first and last packet of its identifier before
    // it.
    for place in 4..8 {
        let failed = failed(format, takes, &without(&former, place), 0, &new);
        assert!(failed.contains(&"SEND-1"), "former, without {place}: {failed:?}");
    }
    for place in 2..8 {
        let failed = failed(format, takes, &former, 3, &without(&new, place));
        assert!(failed.contains(&"SEND-1"), "new, without {place}: {failed:?}");
    }
    // A wrong CRC.
    for place in 4..8 {
        let mut wrong = former.clone();
        let bytes: Vec<_> = wrong[place].data().iter().map(|byte| byte ^ 0x40).collect();
        wrong[place] = Frame::classic(wrong[place].id(), &bytes).unwrap();
        assert!(failed(format, takes, &wrong, 2, &new).contains(&"SEND-1"), "{place}");
    }
}
