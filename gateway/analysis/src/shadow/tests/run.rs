//! Tests of a whole run: start-up and operation, bench-only frames, answering cells, and the fit.

use super::super::*;
use crate::fit::verdict::FitVerdict;
use bus_model::traffic::BenchFrames;
use model::generate::{SkinRequest, generate};
use protocol::can::{BIT_RATE_SWITCH, FD_FORMAT, Format};
use protocol::fixed::Q3_12;
use protocol::id::{CellId, Node};
use protocol::message::{
    Heartbeat, Joints, Message, NetworkPage, ReceivedCounts, RejectedCounts, Request, SensorPage,
    SkinSensors, State, StimulusStart,
};
use protocol::packet::{Epoch, WORDS};

const MS: u64 = 1_000_000;
/// The start time of runs.
const BEGIN: u64 = 1_700_000_000_000_000_000;

/// A constructed run, frame by frame, on buses of a format.
struct Run {
    format: Format,
    frames: Vec<(u64, Frame)>,
    now: u64,
    epoch: Epoch,
}

fn cell(node: i64) -> CellId {
    CellId::new(node).unwrap()
}

fn page(from: i64, page: NetworkPage) -> Message {
    Message::Network { from: Node::Cell(cell(from)), epoch: Epoch(0), page }
}

fn heartbeat(from: i64, state: State) -> Message {
    page(from, NetworkPage::Heartbeat(Heartbeat { serial: 7, state, ..Heartbeat::default() }))
}

fn sensors(from: i64, second: bool) -> Message {
    let page = if second {
        SensorPage::Acceleration([Q3_12::ZERO; 3])
    } else {
        SensorPage::Skin(SkinSensors::default())
    };
    Message::Sensors { from: cell(from), epoch: Epoch(0), page }
}

fn stimulus(to: i64) -> Message {
    let to = Node::Cell(cell(to));
    Message::Stimulus { to, from: StimulusStart::Next, page: SensorPage::Skin(SkinSensors::default()) }
}

impl Run {
    fn new(format: Format) -> Self {
        Self { format, frames: Vec::new(), now: BEGIN, epoch: Epoch(0) }
    }

    fn say(&mut self, message: &Message) {
        let frames = message.encode().frames(self.format);
        self.frames.extend(frames.map(|frame| (self.now, frame)));
    }

    /// Sends address claims and configuration of all cells at once: more than a bus can carry for a while.
    fn start(&mut self, cells: i64) {
        for node in 1..=cells {
            self.say(&heartbeat(node, State::CLAIMING_NODE_ID));
            for tag in 0..4 {
                let request = Request::Read { number: 1 };
                self.say(&Message::Configure { to: Node::Cell(cell(node)), tag, request });
            }
        }
        self.now += 400 * MS;
        self.say(&Message::Resume);
        self.say(&Message::Report);
        self.report(cells);
        self.now += 2 * MS;
    }

    /// Sends a report command and its answers.
    fn report(&mut self, cells: i64) {
        for node in 1..=cells {
            self.say(&page(node, NetworkPage::Received(ReceivedCounts::default())));
            self.say(&page(node, NetworkPage::Rejected(RejectedCounts::default())));
            self.say(&sensors(node, false));
            self.say(&sensors(node, true));
        }
    }

    /// Sends joints and their answers.
    fn epoch(&mut self, answering: i64) {
        let joints = Joints { in_use: 6, ..Joints::default() };
        self.say(&Message::Joints { epoch: self.epoch, joints });
        self.now += MS;
        for node in 1..=answering {
            let (from, torque) = (cell(node), [3; WORDS]);
            self.say(&Message::Torque { from, epoch: self.epoch, torque: torque.into() });
        }
        self.epoch = self.epoch.next();
        self.now += 15 * MS;
    }

    fn operate(&mut self, epochs: u32, answering: i64) {
        (0..epochs).for_each(|_| self.epoch(answering));
    }

    /// Sends the stimuli of every epoch, and the end of a bench.
    fn bench(&mut self, epochs: u32, cells: i64) {
        for _ in 0..epochs {
            (1..=cells).for_each(|node| self.say(&stimulus(node)));
            self.epoch(cells);
        }
        self.say(&Message::Report);
        self.report(cells);
        self.say(&Message::Sync);
        (1..=cells).for_each(|node| self.say(&heartbeat(node, State::CONFIGURED)));
    }

    fn shadow(&self, options: ShadowOptions) -> BusShadow {
        let mut shadow = Shadow::new(options).unwrap();
        self.frames.iter().for_each(|(at, frame)| shadow.receive("vcan0", *at, frame));
        shadow.finish();
        shadow.report().buses.remove(0)
    }
}

fn options() -> ShadowOptions {
    ShadowOptions::new("1M/5M".parse().unwrap())
}

#[test]
fn with_what_only_a_bench_sends_it_is_as_without_unless_it_is_requested_for() {
    for format in [Format::Fd, Format::Classic] {
        let (mut plain, mut bench) = (Run::new(format), Run::new(format));
        for run in [&mut plain, &mut bench] {
            run.start(10);
            run.operate(70, 10);
        }
        plain.operate(70, 10);
        bench.bench(70, 10);
        let (plain, with) = (plain.shadow(options()), bench.shadow(options()));
        // A run without stimuli has reports in its start-up.
        let per_packet = if format == Format::Fd { 1 } else { 2 };
        assert_eq!(plain.counts.bench, BenchFrames { reports: 41 * per_packet, ..BenchFrames::default() });
        assert_eq!(
            with.counts.bench,
            BenchFrames {
                stimuli: 700 * per_packet,
                syncs: 11 * per_packet,
                reports: 82 * per_packet,
                wires: 0
            }
        );
        assert_eq!(format!("{:?}", with.load), format!("{:?}", plain.load));
        assert_eq!((&with.this_run, with.stretches), (&plain.this_run, plain.stretches));
        assert_eq!(with.delay_us, plain.delay_us);
        assert_eq!(with.answering, plain.answering);
        let all = bench.shadow(ShadowOptions { bench_traffic: true, ..options() });
        assert!(!all.counts.bench_omitted && with.counts.bench_omitted);
        assert_eq!(all.counts.bench, with.counts.bench, "they are counted all the same");
        assert_eq!(all.counts.sent, with.counts.sent + all.counts.bench.total());
        assert!(all.load.mean.unwrap() > 1.4 * with.load.mean.unwrap(), "{:?} {:?}", all.load, with.load);
    }
}

#[test]
fn start_up_stands_apart_and_what_follows_is_as_in_a_capture_that_begins_in_the_middle() {
    for format in [Format::Fd, Format::Classic] {
        let mut whole = Run::new(format);
        whole.start(100);
        let joints = whole.frames.len();
        whole.operate(130, 20);
        let shadow = whole.shadow(options());
        let start_up = shadow.start_up.unwrap();
        assert!(start_up.load.worst_16_ms.value > 2.0, "{start_up:?}");
        assert!((start_up.duration_s - 0.402).abs() < 1e-9 && start_up.frames > 500, "{start_up:?}");
        // 21 packets in 16 ms.
        let run = shadow.this_run.as_ref().unwrap();
        assert!(run.load < 0.36 && shadow.load.worst_16_ms.value < 0.36, "{:?}", shadow.load);
        assert_eq!(run.verdict, FitVerdict::Fits);
        assert_eq!(shadow.stretches.count, 0);
        let answering = shadow.answering.unwrap();
        assert_eq!((answering.epochs, answering.most, answering.cells), (130, 20, 100));
        // Captures from the middle on: with an answer before the first joints, with joints at once, with joints soon.
        for from in [joints + 5, joints, joints + 21] {
            let middle = Run { frames: whole.frames[from..].to_vec(), ..Run::new(format) };
            let shadow = middle.shadow(options());
            assert!(shadow.start_up.is_none(), "{from}: {shadow:?}");
            assert_eq!(shadow.frames, shadow.counts.sent);
        }
    }
}

#[test]
fn a_second_part_of_a_recording_has_no_start_up_even_if_joints_come_late() {
    let mut run = Run::new(Format::Fd);
    run.say(&heartbeat(1, State::CONFIGURED));
    run.now += 300 * MS;
    run.operate(10, 3);
    assert_eq!(run.shadow(options()).start_up.unwrap().frames, 1);
    let mut first = Run::new(Format::Fd);
    first.epoch(0);
    let mut shadow = Shadow::new(options()).unwrap();
    shadow.receive_latched("vcan0", BEGIN - 9 * MS, &first.frames[0].1);
    run.frames.iter().for_each(|(at, frame)| shadow.receive("vcan0", *at, frame));
    shadow.finish();
    assert!(shadow.report().buses[0].start_up.is_none());
}

#[test]
fn a_second_run_in_one_capture_starts_up_again_and_time_without_joints_is_not_operation() {
    let mut run = Run::new(Format::Fd);
    run.start(50);
    run.operate(100, 10);
    run.now += 60_000 * MS;
    run.start(50);
    run.operate(100, 10);
    let shadow = run.shadow(options());
    let start_up = shadow.start_up.unwrap();
    // The second after the last joints still counts as operation.
    assert!((start_up.duration_s - (0.402 * 2.0 + 59.016)).abs() < 1e-6, "{start_up:?}");
    let operation = 100.0 * 0.016 + 99.0 * 0.016 + 0.001 + 1.0 - 0.016;
    assert!((shadow.operation_s - operation).abs() < 0.002, "{}", shadow.operation_s);
    assert!(start_up.load.worst_16_ms.value > 1.0 && shadow.load.worst_16_ms.value < 0.2);
}

#[test]
fn a_run_without_joints_has_no_operation_and_is_not_rated() {
    let mut run = Run::new(Format::Fd);
    run.start(20);
    let shadow = run.shadow(options());
    assert!(shadow.this_run.is_none() && shadow.start_up.is_some());
    assert_eq!(shadow.answering.unwrap().epochs, 0);
}

#[test]
fn while_cells_are_halted_nobody_is_expected_to_answer() {
    let mut run = Run::new(Format::Fd);
    run.operate(20, 4);
    run.say(&Message::Halt);
    run.operate(30, 0);
    let halted = run.shadow(options()).answering.unwrap();
    assert_eq!((halted.epochs, halted.epochs_halted, halted.mean, halted.most), (20, 30, Some(4.0), 4));
    run.say(&Message::Resume);
    run.operate(20, 2);
    let resumed = run.shadow(options()).answering.unwrap();
    assert_eq!((resumed.epochs, resumed.epochs_halted, resumed.mean), (40, 30, Some(3.0)));
}

#[test]
fn beside_the_run_stands_the_worst_case_of_the_skin_at_the_same_rates() {
    let text = generate(&SkinRequest { cells: 253, ..SkinRequest::default() }).unwrap();
    let skin = Skin::parse("skin.toml", &text).unwrap();
    let mut run = Run::new(Format::Fd);
    run.start(253);
    run.operate(130, 120);
    let shadow = run.shadow(ShadowOptions { skin: Some(skin), ..options() });
    assert_eq!(
        shadow.worst_case.unwrap().to_string(),
        "worst case: 118.9 % of 1M/5M: does not fit: bandwidth (all 253 cells answer)"
    );
    let run_says = shadow.this_run.unwrap().to_string();
    assert!(
        run_says.ends_with(" % of 1M/5M: in time, but 254 nodes (at most 120 of 253 cells answered)"),
        "{run_says}"
    );
    let heard = run.shadow(options());
    assert_eq!(heard.worst_case, None);
    assert!(heard.this_run.unwrap().to_string().contains("at most 120 of 253 observed cells answered"));
}

#[test]
fn an_answer_that_was_ready_too_late_for_any_bus_does_not_count_for_the_verdict() {
    let verdict = |after: u64| {
        let mut run = Run::new(Format::Fd);
        run.operate(20, 4);
        // One cell answers later than the others, just before the next joints or slightly earlier.
        run.epoch(0);
        let (next, epoch) = (run.now, Epoch(run.epoch.0 - 1));
        run.now = next - 16 * MS + after;
        let torque = [3; WORDS];
        for node in 1..=60 {
            run.say(&Message::Torque { from: cell(node), epoch, torque: torque.into() });
        }
        run.now = next;
        run.operate(20, 4);
        let shadow = run.shadow(options());
        let replies = shadow.replies.unwrap();
        (replies.late > 0, replies.late == replies.late_when_ready, shadow.this_run.unwrap().verdict)
    };
    assert_eq!(verdict(15_900_000), (true, true, FitVerdict::Fits));
    assert_eq!(verdict(13_000_000), (true, false, FitVerdict::Deadline));
}

#[test]
fn another_protocol_is_counted_in_full_whatever_it_looks_like() {
    // Identifiers of stimuli, sync and report: many random frames, and some valid packets.
    let mut run = Run::new(Format::Fd);
    for step in 0..3_000_u64 {
        let id = [0x701, 0x002, 0x004, 0x4FF][usize::try_from(step % 4).unwrap()];
        let data = [step.to_le_bytes(), step.wrapping_mul(77).to_le_bytes()].concat();
        run.frames
            .push((run.now, Frame::with_data(id, Format::Fd, BIT_RATE_SWITCH | FD_FORMAT, &data).unwrap()));
        run.now += MS / 2;
        if step % 500 == 499 {
            run.say(&stimulus(9));
            run.say(&Message::Sync);
        }
    }
    let shadow = run.shadow(options());
    assert_eq!(
        (shadow.counts.sent, shadow.counts.bench.total(), shadow.start_up.is_none()),
        (3_012, 0, true)
    );
    assert_eq!(shadow.this_run.unwrap().case_name(), "this capture");
    // Classic frames as in a car.
    let mut run = Run::new(Format::Classic);
    for step in 0..3_000_u32 {
        let frame =
            Frame::classic(0x700 + step % 40, &step.wrapping_mul(0x9E37_79B9).to_le_bytes().repeat(2));
        run.frames.push((run.now, frame.unwrap()));
        run.now += MS / 2;
    }
    let shadow = run.shadow(options());
    assert_eq!(
        (shadow.counts.sent, shadow.counts.bench.total(), shadow.start_up.is_none()),
        (3_000, 0, true)
    );
    assert!(
        shadow.this_run.unwrap().to_string().contains(" of classic 1M: fits (frames of another protocol)")
    );
}
