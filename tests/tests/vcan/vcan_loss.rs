//! Deliberate losses, by receive buffers that are far too small, which must be counted exactly.
//!
//! One rule is tested on a real kernel's vcan and on the embedded bus; the embedded bus needs no preparation.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::BTreeMap;
use std::time::Duration;

use process::vcan::{Candump, backlog_drops, frames_of, own_network, small_skin, tool};
use process::{PRESSED, TIMEOUT, TestDir, is_stopped, until};
use protocol::bus::{Bus, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{EXTENDED, Frame};
use protocol::candump::{CandumpLine, parse};
use recorded::Recorded;
use rustix::process::Signal;

/// A buffer for about 16 frames; the kernel allows at least 32.
const SMALL: usize = 16 * 1024;
/// The frames of a round; the buffer has room for a hundredth of them.
const FRAMES: u32 = 5_000;
/// The identifier that the receiver requests; other frames are sent beside it.
const EXPECTED: u32 = 0x200;
const UNWANTED: u32 = 0x300;

/// A receiver that sleeps, and a sender.
struct Pair {
    kind: BusKind,
    sender: Bus,
    sleeper: Bus,
    inbox: Inbox,
    /// The number of frames so far that passed the receiver's filter.
    sent: u32,
    /// The number of frames that it received.
    heard: u32,
}

impl Pair {
    fn open(kind: BusKind, place: &TestDir, filters: &[Filter]) -> Self {
        let options = |filters: &[Filter], receive_buffer| BusOptions {
            filters: filters.to_vec(),
            receive_buffer,
            directory: Some(place.buses()),
            send_timeout: TIMEOUT,
            ..BusOptions::default()
        };
        let open = |options: &BusOptions| Bus::open("vcan0", KindChoice::Only(kind), options).unwrap();
        let (sender, sleeper) = (open(&options(&[], 0)), open(&options(filters, SMALL)));
        assert!(
            (SMALL..=2 * SMALL).contains(&sleeper.receive_buffer_bytes()),
            "{}",
            sleeper.receive_buffer_bytes()
        );
        Self { kind, sender, sleeper, inbox: Inbox::new(), sent: 0, heard: 0 }
    }

    /// Returns the next frame for the receiver: its number, in frames of either format and several lengths.
    fn next(&mut self) -> Frame {
        let number = self.sent.to_le_bytes();
        self.sent += 1;
        match self.sent % 3 {
            0 => Frame::classic(EXPECTED, &number),
            1 => Frame::fd(EXPECTED, 1, &number),
            _ => Frame::fd(EXPECTED, 0, &[&number[..], &[0xA5; 60]].concat()),
        }
        .unwrap()
    }

    /// Sends while the receiver sleeps: two of three frames are for it.
    fn overflow(&mut self) {
        let mut burst = Vec::new();
        for number in 0..FRAMES {
            burst.push(match number % 3 {
                0 => Frame::fd(UNWANTED, 1, &[0; 16]).unwrap(),
                _ => self.next(),
            });
            if burst.len() == 50 {
                self.sender.send(&burst).unwrap();
                burst.clear();
            }
        }
        self.sender.send(&burst).unwrap();
    }

    /// Reads all available frames. The oldest are kept and the newest are dropped, and with each frame the number of
    /// frames missing before it is known.
    fn read(&mut self) {
        while self.sleeper.wait(Some(Duration::from_millis(20))).unwrap() {
            self.sleeper.receive(&mut self.inbox).unwrap();
            let dropped = self.inbox.dropped_count();
            let mut last = None;
            for received in self.inbox.frames() {
                assert_eq!(received.frame.id(), EXPECTED);
                let number = u32::from_le_bytes(*received.frame.data().first_chunk().unwrap());
                assert!(number >= self.heard && number - self.heard <= dropped, "{number} is out of order");
                self.heard += 1;
                last = Some(number);
            }
            // The embedded bus may have reported drops after the last frame as well.
            let known = self.heard + dropped;
            match (last, self.kind) {
                (Some(last), BusKind::SocketCan) => assert_eq!(last + 1, known),
                (Some(last), BusKind::Embedded) => assert!(last < known, "{last}, and {known} are known"),
                (None, _) => {}
            }
        }
    }

    /// Sends further frames until one arrives, with the whole count.
    fn settle(&mut self) {
        self.read();
        until("a frame that is not dropped", || {
            let heard = self.heard;
            let last = self.next();
            self.sender.send(&[last]).unwrap();
            self.read();
            // On the embedded bus, frames that wait on the way arrive in between.
            (self.heard > heard && self.heard + self.inbox.dropped_count() == self.sent).then_some(())
        });
    }
}

/// Checks that the bus reports exactly the frames as dropped that were sent and not received.
fn what_is_lost_is_counted(kind: BusKind, place: &TestDir) {
    let exact = Filter { id: EXPECTED, mask: Filter::EXACT_MASK };
    // A frame that matches several filters arrives once and is dropped once; a frame that matches none is not a loss.
    let several = [exact, Filter { id: EXPECTED, mask: 0x700 }, Filter { id: EXTENDED, mask: EXTENDED }];
    for filters in [&[exact][..], &several, &[Filter { id: UNWANTED, mask: 0x7FF }.inverted()]] {
        let backlog = || if kind == BusKind::SocketCan { backlog_drops() } else { 0 };
        let before = backlog();
        let mut pair = Pair::open(kind, place, filters);
        let mut dropped = 0;
        for round in 0..3 {
            let (sent, heard) = (pair.sent, pair.heard);
            pair.overflow();
            pair.settle();
            let (sent, heard) = (pair.sent - sent, pair.heard - heard);
            let lost = pair.inbox.dropped_count() - dropped;
            assert_eq!(sent - heard, lost, "round {round}, {filters:?}");
            assert!(heard > 10 && lost > FRAMES / 3, "round {round}: {heard} heard, {lost} lost");
            dropped = pair.inbox.dropped_count();
        }
        // No frame was lost on the way to the socket, which a socket could not know.
        assert_eq!(backlog(), before);

        // When it reads in time again, nothing is missing.
        for _ in 0..10 {
            let frames: Vec<_> = (0..10).map(|_| pair.next()).collect();
            pair.sender.send(&frames).unwrap();
            until("all of them", || {
                pair.read();
                (pair.heard + pair.inbox.dropped_count() == pair.sent).then_some(())
            });
        }
        assert_eq!((pair.inbox.dropped_count(), pair.heard + dropped), (dropped, pair.sent));
    }
}

#[test]
#[ignore = "needs vcan"]
fn what_is_lost_is_counted_on_vcan() {
    own_network();
    what_is_lost_is_counted(BusKind::SocketCan, &TestDir::new());
}

#[test]
fn what_is_lost_is_counted_on_the_embedded_bus() {
    let place = TestDir::new();
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    what_is_lost_is_counted(BusKind::Embedded, &place);
}

/// Returns the number of frames by identifier.
fn counts(frames: &[Frame]) -> BTreeMap<u32, usize> {
    let mut counts = BTreeMap::new();
    for frame in frames {
        *counts.entry(frame.raw_id()).or_default() += 1;
    }
    counts
}

#[test]
#[ignore = "needs vcan"]
fn a_gateway_that_hangs_knows_how_many_frames_it_missed() {
    const FOREIGN: u32 = 600;
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(8));
    place.scenario(PRESSED);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    let backlog = backlog_drops();
    let bench = place.running_bench(600.0, &format!("--record run.mcap SKINBUS_RECEIVE_BUFFER={SMALL}"));
    place.test_client().waits_for_epoch(10);
    bench.signal(Signal::STOP);
    until("a gateway that is stopped", || is_stopped(bench.pid()).then_some(()));
    // For more than a second; cells keep sending meanwhile.
    tool(&format!("cangen vcan0 -g 2 -n {FOREIGN} -e -I 1234567 -L 8 -D i"));
    bench.signal(Signal::CONT);
    // The next frame brings the whole count.
    place.test_client().waits_for_joints(20);
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    // The log itself records its missing frames.
    let log = place.read("run.log");
    let (missing, lines): (Vec<_>, Vec<_>) = log.lines().partition(|line| line.starts_with("DROPCOUNT: "));
    place.write("frames.log", &(lines.join("\n") + "\n"));
    let (ours, mut theirs) = (frames_of(&place.path("frames.log")), candump.frames());
    // Frames that cells sent after the gateway stopped listening do not count as losses.
    let last = ours.last().unwrap();
    theirs.truncate(1 + theirs.iter().rposition(|frame| frame == last).unwrap());

    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.of_bus("/receive_buffer"), 2 * SMALL as u64);
    let dropped = summary.of_bus("/dropped_by_bus");
    assert_eq!((theirs.len() - ours.len()) as u64, dropped, "{}", ended.stderr);
    let said = |line: &str| match parse(line) {
        Ok(CandumpLine::Dropped { frames }) => frames,
        other => panic!("{line}: {other:?}"),
    };
    assert_eq!(missing.iter().map(|line| said(line)).sum::<u64>(), dropped, "{missing:?}");
    assert!(missing.iter().all(|line| line.contains("on 'vcan0' socket")), "{missing:?}");
    // So does the recording, with the same text.
    let recorded = Recorded::read(&place.path("run.mcap"));
    let notes: Vec<_> = recorded.on("/can/notes").map(|note| &note.value).collect();
    assert_eq!(notes.iter().map(|note| note["text"].as_str().unwrap()).collect::<Vec<_>>(), missing);
    assert_eq!(notes.iter().map(|note| note["frames"].as_u64().unwrap()).sum::<u64>(), dropped);
    assert_eq!(recorded.lines("/can/vcan0"), lines);
    let (ours, theirs) = (counts(&ours), counts(&theirs));
    assert!(ours.iter().all(|(id, count)| theirs[id] >= *count), "{ours:?} {theirs:?}");
    let foreign = FOREIGN as usize - ours[&(0x0123_4567 | EXTENDED)];
    assert!(foreign > 400 && (foreign as u64) < dropped, "{foreign} of {dropped} were foreign");
    // Of the others, those of cells are missing in the cells' accounts, and nothing else is.
    let by_cells = |counts: &BTreeMap<u32, usize>| -> usize {
        counts.iter().filter(|(id, _)| (0x200..0x500).contains(*id)).map(|(_, count)| count).sum()
    };
    let unanswered = (by_cells(&theirs) - by_cells(&ours)) as u64;
    assert!(unanswered > 8, "{unanswered} missed of the cells");
    assert_eq!((summary.of_bus("/uplink/dropped"), summary.of_bus("/uplink/surplus")), (unanswered, 0));
    assert_eq!((summary.number("/recording/lost"), backlog_drops()), (0, backlog));
}
