//! A recording split anywhere: complete benches in virtual time, with cells that hang and answer too late, and packets
//! that are lost on their way to the recording. The frames latched at a split, and the frames from there up to another
//! split, are replayed to cells that were just started: they must answer as recorded.
#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use analysis::explain::{JointsWatcher, RequestedJoints};
use bench::replay::comparator::{Comparator, ReplyTally};
use bench::replay::replay_plan::{FrameRole, FrameSelection, PlayerStep, ReplayPlan, SenderFilter};
use bench::replay::survey::{Survey, TimeRange};
use cell_node::flash::FlashState;
use cell_node::identity::Identity;
use cell_node::node::Node;
use model::decode::{Decoded, Decoder};
use model::latched::{LatchedFrame, LatchedPackets};
use model::table::{BusTable, Replies};
use protocol::can::{Format, Frame};
use protocol::candump::{Direction, Record, Timestamp};
use protocol::id::{CellId, Node as Address};
use protocol::message::{Message, Request, SensorPage, StimulusStart};
use protocol::packet::Epoch;
use protocol::parameters::Parameter;
use protocol::skin::Skin;
use protocol::time::{Micros, Span};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::bench::{Act, Bench, touch};
use skinbus_tests::fault::{Fault, Harm, Party};
use skinbus_tests::skins;
use trace::capture;

const CELLS: u8 = 8;
const SEEDS: u64 = 40;
const BUS: &str = "vcan0";
/// More epochs than half of all epoch numbers.
const EPOCHS: u64 = 190;

/// The faults during the recording.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum RecordingFault {
    None,
    /// Cells hang for a while, torques come late, and some packets of cells are not in the recording.
    Late,
}

/// Records a bench in which cells are pressed and released all the time.
fn recorded(seed: u64, format: Format, trouble: RecordingFault) -> (Skin, Vec<LatchedFrame>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    let mut bench = Bench::new(&skins::arm(CELLS, format), seed);
    bench.settle();
    bench.act(Act::SendFromGateway(Message::Resume));
    bench.act(Act::SendFromGateway(Message::Report));
    bench.run(Span::from_millis(20));
    bench.begin();
    for epoch in 0..EPOCHS {
        let place = rng.random_range(0..usize::from(CELLS));
        let newtons = [0.0, 0.0, 0.05, 1.5, 4.0, 90.0][rng.random_range(0..6)];
        let ahead = Epoch(u8::try_from((epoch + rng.random_range(0..6)) % 256).unwrap());
        let from = if rng.random_ratio(1, 3) { StimulusStart::Next } else { StimulusStart::Epoch(ahead) };
        // Some of the last cells are pressed permanently.
        if place < 5 || epoch % 60 == 7 {
            bench.press_from(place, newtons, from);
        }
        if trouble == RecordingFault::Late {
            match rng.random_range(0..40) {
                0 => bench.act(Act::Hang(place)),
                1..8 => (0..usize::from(CELLS)).for_each(|place| bench.act(Act::Continue(place))),
                11 => bench.act(Act::SendFromGateway(if epoch % 2 == 0 {
                    Message::Halt
                } else {
                    Message::Resume
                })),
                12 => {
                    let page = SensorPage::Skin(touch(2.0));
                    bench.act(Act::Inject(Message::Stimulus {
                        to: Address::Everyone,
                        from: StimulusStart::Next,
                        page,
                    }));
                }
                13 => {
                    let (number, words) = (Parameter::Mode.number(), [1, 0, 0, 0, 0, 0]);
                    let to = Address::Cell(CellId::new(2).unwrap());
                    let request = Request::Write { number, words };
                    bench.act(Act::Inject(Message::Configure { to, tag: 9, request }));
                }
                14 => {
                    let request = Request::Read { number: Parameter::Mount.number() };
                    bench.act(Act::Inject(Message::Configure { to: Address::Everyone, tag: 7, request }));
                }
                _ => {}
            }
        }
        if trouble == RecordingFault::Late && epoch == 20 {
            bench.fault(
                Fault::new(Harm::Delay(Span::from_millis(40)), 0.05)
                    .of_kind(protocol::id::Kind::Torque)
                    .on_the_wire(),
            );
        }
        bench.run_epochs(1);
    }
    (0..usize::from(CELLS)).for_each(|place| bench.act(Act::Continue(place)));
    bench.finish();
    let is_recorded = |from: Party, rng: &mut Pcg64Mcg| {
        trouble == RecordingFault::None
            || from == Party::Gateway
            || from == Party::UnknownNode
            || !rng.random_ratio(1, 200)
    };
    let seen = bench.wire.iter().filter(|sent| is_recorded(sent.from, &mut rng)).map(|sent| LatchedFrame {
        at_nanos: (sent.at.0 + 1_000_000) * 1_000,
        from_gateway: sent.from == Party::Gateway,
        frame: sent.frame,
    });
    let seen = seen.collect();
    (bench.skin, seen)
}

/// Returns the first index from `at` on at which the recorder may begin another file, and the frames latched there.
fn split(seen: &[LatchedFrame], at: usize) -> (usize, Vec<capture::LatchedFrame>) {
    let mut latched_frames = LatchedPackets::default();
    for (place, frame) in seen.iter().enumerate() {
        if place >= at && !latched_frames.is_within_a_packet(frame.at_nanos) {
            return (place, latched(&latched_frames));
        }
        latched_frames.receive(*frame);
    }
    (seen.len(), latched(&latched_frames))
}

fn latched(latched_frames: &LatchedPackets) -> Vec<capture::LatchedFrame> {
    let frames = latched_frames.frames().into_iter();
    let kept = |seen: LatchedFrame| capture::LatchedFrame {
        bus: BUS.to_owned(),
        own: seen.from_gateway,
        frame: seen.frame,
        nanos: seen.at_nanos,
    };
    frames.map(kept).collect()
}

fn record(seen: &LatchedFrame) -> Record<'static> {
    let direction = Some(if seen.from_gateway { Direction::Sent } else { Direction::Received });
    let time = Timestamp::with_nine_digits(seen.at_nanos);
    Record { time, interface: BUS, frame: seen.frame, direction }
}

/// Cells that were just started.
struct Cells(Vec<Node>);

impl Cells {
    fn of(skin: &Skin) -> Self {
        let format = skin.buses[0].format;
        let started = |cell: &protocol::skin::Cell| {
            let identity = Identity { cell: Some(cell.node), serial: cell.serial };
            let mut node =
                Node::new(identity, format, &FlashState::Valid(skin.parameters(cell)), true, Micros(0));
            for _ in 0..2 {
                node.handle_timeout(node.poll_timeout());
                while node.poll_transmit().is_some() {}
            }
            node
        };
        Self(skin.cells.iter().map(started).collect())
    }

    /// Gives a frame to all cells in time, and their answers to the comparator.
    fn take(&mut self, frame: &Frame, comparator: &mut Comparator) {
        for node in &mut self.0 {
            node.handle_frame(Micros(300_000), Span(0), frame);
            if node.poll_store().is_some() {
                node.handle_stored(true);
            }
            while let Some(packet) = node.poll_transmit() {
                comparator.observe_message(0, &Message::decode(packet).unwrap());
            }
        }
    }

    fn tell(&mut self, message: &Message, format: Format, comparator: &mut Comparator) {
        message.encode().frames(format).for_each(|frame| self.take(&frame, comparator));
    }
}

/// Replays a part in lockstep, and returns the comparator.
fn replayed(skin: &Skin, before: &[capture::LatchedFrame], part: &[LatchedFrame]) -> Comparator {
    let format = skin.buses[0].format;
    let mut survey = Survey::new(TimeRange::default());
    survey.add_latched_frames(before);
    part.iter().for_each(|seen| survey.add_frame(&record(seen)));
    survey.finish();
    let bus = &survey.buses[0];
    let mut comparator = Comparator::new([(BUS.to_owned(), bus.cells.clone())], part[0].at_nanos, Some(0));
    comparator.expect_next_pass();
    bus.latched.iter().for_each(|message| comparator.expect_message(0, message, false));
    let selection = FrameSelection { only: SenderFilter::Inputs, destinations: vec![Some(0)], reads: true };
    let mut replay_plan = ReplayPlan::new(&survey, &selection);
    let mut cells = Cells::of(skin);
    cells.tell(&Message::Report, format, &mut comparator);
    if !bus.state.is_start_state() {
        let PlayerStep::Restore(states) = replay_plan.restore_step() else { unreachable!() };
        for message in &states[0].1 {
            if let Message::Joints { epoch, .. } = message {
                comparator.announce_joints(0, None, *epoch);
            }
            cells.tell(message, format, &mut comparator);
        }
    }
    comparator.set_muted(false);
    for seen in part {
        let _ = replay_plan.add_frame(&record(seen), &mut comparator);
    }
    replay_plan.end_pass(&mut comparator);
    comparator.expect_end();
    while let Some(step) = replay_plan.next_step() {
        let PlayerStep::Frame(due) = step else { unreachable!() };
        if let FrameRole::Joints(open) = due.role {
            comparator.announce_joints(0, open.round, open.epoch);
        }
        cells.take(&due.frame, &mut comparator);
    }
    comparator.finish(true);
    comparator
}

/// Returns the number of torques in a part.
fn torques(part: &[LatchedFrame]) -> u64 {
    let mut decoder = Decoder::new(None);
    let is_torque = |seen: &&LatchedFrame| {
        let decoded = decoder.decode(Micros(seen.at_nanos / 1_000), BUS, &seen.frame);
        matches!(decoded, Decoded::Message(Message::Torque { .. }))
    };
    part.iter().filter(is_torque).count() as u64
}

#[test]
fn a_recording_that_is_split_anywhere_replays_from_there() {
    let (mut equal, mut explained) = (0, 0);
    for seed in 0..SEEDS {
        let format = if seed % 3 == 2 { Format::Classic } else { Format::Fd };
        let (skin, seen) = recorded(seed, format, RecordingFault::Late);
        let whole = replayed(&skin, &[], &seen);
        assert!(
            whole.tally().has_only_equal_replies(),
            "seed {seed}: {:#?} {:#?}",
            whole.tally(),
            whole.first_difference()
        );
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        for _ in 0..12 {
            let (from, before) = split(&seen, rng.random_range(0..seen.len() - 50));
            let to = rng.random_range(from + 40..=seen.len());
            let part = &seen[from..to];
            let comparator = replayed(&skin, &before, part);
            let ReplyTally { lacking, .. } = *comparator.tally();
            assert!(
                comparator.tally().has_only_equal_replies(),
                "seed {seed}, {from} to {to} of {}: {:#?} {:#?}",
                seen.len(),
                comparator.tally(),
                comparator.first_difference()
            );
            // Each recorded torque is compared, or has a reason for not being compared.
            let apart = lacking.joints_earlier + lacking.joints_unrecorded + lacking.said_later;
            assert!(comparator.tally().equal + apart >= torques(part), "{:#?}", comparator.tally());
            equal += comparator.tally().equal;
            explained += apart + lacking.uncounted + lacking.untaken + lacking.unrecorded;
        }
    }
    assert!(
        equal > 20 * SEEDS * 12 && explained > 0 && explained < equal / 4,
        "{equal} equal, {explained} explained"
    );
}

#[test]
fn where_nothing_was_lost_or_late_nothing_is_explained() {
    for seed in 100..112 {
        let format = if seed % 2 == 0 { Format::Classic } else { Format::Fd };
        let (skin, seen) = recorded(seed, format, RecordingFault::None);
        for at in (0..seen.len() - 200).step_by(seen.len() / 15) {
            let (from, before) = split(&seen, at);
            // Up to the next joints: all requests before are answered.
            let is_joints = |seen: &&LatchedFrame| seen.frame.raw_id() == 1;
            let last = seen.iter().rposition(|seen| is_joints(&seen)).unwrap();
            let to = if at % 2 == 0 { seen.len() } else { (from + 400).min(last) };
            let comparator = replayed(&skin, &before, &seen[from..to]);
            let tally = comparator.tally();
            assert!(
                tally.has_only_equal_replies(),
                "seed {seed}, {from} to {to}: {tally:#?} {:#?}",
                comparator.first_difference()
            );
            let mut lacking = tally.lacking;
            assert!(
                lacking.ended <= u64::from(CELLS) && lacking.joints_earlier <= u64::from(CELLS),
                "{lacking:#?}"
            );
            (lacking.ended, lacking.joints_earlier) = (0, 0);
            assert_eq!(lacking, Default::default(), "seed {seed}, {from} to {to}");
        }
    }
}

#[test]
fn a_word_that_is_another_one_is_found_in_every_part() {
    let (skin, mut seen) = recorded(7, Format::Fd, RecordingFault::Late);
    let mut found = 0;
    for at in (200..seen.len() - 200).step_by(97) {
        let is_torque = |seen: &LatchedFrame| {
            let packet = protocol::packet::Packet::from_fd(&seen.frame).ok()?;
            let Ok(Message::Torque { torque, .. }) = Message::decode(&packet) else { return None };
            (torque.first_six()[0] != 0).then_some(packet)
        };
        let Some((place, mut packet)) =
            seen.iter().enumerate().skip(at + 60).find_map(|(place, seen)| Some((place, is_torque(seen)?)))
        else {
            continue;
        };
        let (from, before) = split(&seen, at);
        packet.words = packet.words.with_word(0, packet.words.first_six()[0] + 1);
        let kept = seen[place].frame;
        seen[place].frame = packet.frames(Format::Fd).next().unwrap();
        let comparator = replayed(&skin, &before, &seen[from..]);
        seen[place].frame = kept;
        // Unless its joints came before the part.
        let tally = comparator.tally();
        assert!(tally.different <= 1 && tally.missing + tally.extra == 0, "{tally:#?}");
        found += tally.different;
    }
    assert!(found >= 8, "{found}");
}

#[test]
fn explain_and_the_accounts_know_of_a_part_what_they_know_of_the_whole() {
    for seed in 200..210 {
        let (skin, seen) = recorded(seed, Format::Fd, RecordingFault::None);
        let frames_of = |from: usize, before: &[capture::LatchedFrame], requested: RequestedJoints| {
            let (mut watch, mut decoder) = (JointsWatcher::new(&skin, requested), Decoder::new(None));
            for kept in before {
                if let Decoded::Message(message) =
                    decoder.decode(Micros(kept.nanos / 1_000), BUS, &kept.frame)
                {
                    watch.receive_latched(kept.nanos, BUS, &message);
                }
            }
            for seen in &seen[from..] {
                let decoded = decoder.decode(Micros(seen.at_nanos / 1_000), BUS, &seen.frame);
                let message = if let Decoded::Message(message) = &decoded { Some(message) } else { None };
                watch.receive(seen.at_nanos, BUS, message);
            }
            watch.into_joints().unwrap().remove(0).unwrap()
        };
        let (from, before) = split(&seen, seen.len() / 2 + usize::try_from(seed).unwrap());
        let requested = |epoch| RequestedJoints { epoch: Epoch(epoch), from_ns: 0, occurrence: 1 };
        for epoch in [160, 172, 185] {
            let (whole, part) =
                (frames_of(0, &[], requested(epoch)), frames_of(from, &before, requested(epoch)));
            assert_eq!(whole.at_ns, part.at_ns);
            for (whole, part) in whole.cells.iter().zip(&part.cells) {
                let contact_state =
                    |cell: &analysis::explain::ObservedCellState| cell.contact_state.map(|(skin, _)| skin);
                assert_eq!(
                    (contact_state(whole), whole.test_mode),
                    (contact_state(part), part.test_mode),
                    "epoch {epoch}"
                );
            }
        }
        let mut table = BusTable::new(&skin, 0);
        let take = |table: &mut BusTable, own, nanos, frame: &Frame| {
            table.handle_frame(Micros(nanos / 1_000), own, frame, &mut |_| None);
        };
        before.iter().for_each(|kept| take(&mut table, kept.own, kept.nanos, &kept.frame));
        table.reset_counts();
        seen[from..].iter().for_each(|seen| take(&mut table, seen.from_gateway, seen.at_nanos, &seen.frame));
        table.finish();
        let all = Replies::total(table.cells().iter().map(|cell| cell.replies));
        let lost: u64 = table.cells().iter().map(|cell| cell.uplink().lost).sum();
        assert_eq!((all.missing, all.late, lost), (0, 0, 0), "seed {seed}: {all:#?}");
        assert!(all.due > 50 && all.in_time == all.due, "{all:#?}");
    }
}
