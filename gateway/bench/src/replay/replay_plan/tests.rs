use std::collections::BTreeMap;

use super::*;
use crate::replay::survey::TimeRange;
use protocol::can::{ERROR, EXTENDED, Format};
use protocol::candump::Timestamp;
use protocol::id::{CellId, Node};
use protocol::message::StimulusStart;
use protocol::message::{SensorPage, SkinSensors};
use protocol::port;

const MS: u64 = 1_000_000;

fn frame(message: &Message) -> Frame {
    message.encode().frames(Format::Fd).next().unwrap()
}

fn joints(epoch: u8) -> Frame {
    let joints = Joints { in_use: 6, ..Joints::default() };
    frame(&Message::Joints { epoch: Epoch(epoch), joints })
}

fn press(number: i64) -> Frame {
    let page = SensorPage::Skin(SkinSensors::default());
    frame(&Message::Stimulus {
        to: Node::Cell(CellId::new(number).unwrap()),
        from: StimulusStart::Next,
        page,
    })
}

fn torque(number: i64, epoch: u8) -> Frame {
    frame(&Message::Torque { from: CellId::new(number).unwrap(), epoch: Epoch(epoch), torque: [0; 6].into() })
}

/// A capture of two buses with 1 ms between frames.
fn capture() -> Vec<(u64, &'static str, Frame)> {
    let frames = [
        ("a", press(1)),
        ("a", joints(0)),
        ("b", joints(0)),
        ("a", torque(1, 0)),
        ("a", Frame::classic(5 | EXTENDED, &[1]).unwrap()),
        ("a", Frame::classic(5 | ERROR, &[0; 8]).unwrap()),
        ("a", joints(1)),
        ("b", torque(2, 0)),
    ];
    (5_000_u64..).zip(frames).map(|(at, (bus, frame))| (at * MS, bus, frame)).collect()
}

/// Decodes a single frame.
fn decoded(frame: &Frame) -> Decoded {
    model::decode::Decoder::new(None).decode(Micros(0), "a", frame)
}

/// All steps of `passes` passes.
fn plan_summary(
    part: TimeRange,
    selection: impl FnOnce(&mut FrameSelection),
    passes: u32,
) -> (Vec<DueFrame>, PlanSummary) {
    share_of(&capture(), part, selection, passes)
}

fn share_of(
    capture: &[(u64, &'static str, Frame)],
    part: TimeRange,
    selection: impl FnOnce(&mut FrameSelection),
    passes: u32,
) -> (Vec<DueFrame>, PlanSummary) {
    let mut survey = Survey::new(part);
    let record = |(nanos, interface, frame): &(u64, &'static str, Frame)| Record {
        time: Timestamp::with_nine_digits(*nanos),
        interface,
        frame: *frame,
        direction: None,
    };
    capture.iter().for_each(|it| survey.add_frame(&record(it)));
    survey.finish();
    let bus_links = vec![Some(0), Some(1)];
    let mut chosen = FrameSelection { only: SenderFilter::All, destinations: bus_links, reads: true };
    selection(&mut chosen);
    let names = ["a", "b"].map(|name| (name.to_owned(), BTreeMap::new()));
    let mut comparator = Comparator::new(names, 0, Some(0));
    let mut replay_plan = ReplayPlan::new(&survey, &chosen);
    let mut steps = Vec::new();
    for _ in 0..passes {
        for it in capture {
            if replay_plan.add_frame(&record(it), &mut comparator).is_break() {
                break;
            }
        }
        replay_plan.end_pass(&mut comparator);
        steps.extend(std::iter::from_fn(|| replay_plan.next_step()));
    }
    let due = |step| match step {
        PlayerStep::Frame(due) => due,
        PlayerStep::Restore(_) => panic!("no restore was requested"),
    };
    (steps.into_iter().map(due).collect(), replay_plan.into_summary())
}

fn shown(due: &[DueFrame]) -> Vec<(u64, usize, u32)> {
    due.iter().map(|due| (due.at / MS, due.bus_index, due.frame.id())).collect()
}

#[test]
fn all_is_sent_but_what_never_was_on_a_bus() {
    let (due, plan_summary) = plan_summary(TimeRange::default(), |_| {}, 1);
    let ids = [(0, 0, 0x701), (1, 0, 1), (2, 1, 1), (3, 0, 0x201), (4, 0, 5), (6, 0, 1), (7, 1, 0x202)];
    assert_eq!(shown(&due), ids);
    assert_eq!(plan_summary.skipped, BTreeMap::from([(reason::ERROR_FRAME, 1)]));
    // Joints are numbered per bus.
    let rounds = due.iter().filter_map(|due| match due.role {
        FrameRole::Joints(AwaitedJoints { round, .. }) => Some((due.bus_index, round)),
        FrameRole::Plain | FrameRole::SegmentOfJoints => None,
    });
    assert_eq!(rounds.collect::<Vec<_>>(), [(0, Some(0)), (1, Some(0)), (0, Some(1))]);
}

#[test]
fn inputs_and_replies_are_the_two_sides() {
    let (inputs, truncate_inputs) =
        plan_summary(TimeRange::default(), |selection| selection.only = SenderFilter::Inputs, 1);
    assert_eq!(shown(&inputs), [(0, 0, 0x701), (1, 0, 1), (2, 1, 1), (6, 0, 1)]);
    assert_eq!(truncate_inputs.skipped, BTreeMap::from([(reason::ERROR_FRAME, 1), (reason::NO_INPUT, 3)]));
    let (replies, share_of_replies) =
        plan_summary(TimeRange::default(), |selection| selection.only = SenderFilter::Replies, 1);
    assert_eq!(shown(&replies), [(0, 0, 0x201), (4, 1, 0x202)], "the first one begins");
    assert_eq!(share_of_replies.skipped, BTreeMap::from([(reason::ERROR_FRAME, 1), (reason::NO_REPLY, 5)]));
}

#[test]
fn foreign_frames_are_neither_inputs_nor_replies_whatever_their_identifiers_are() {
    // Foreign frames with identifiers of joints, of a torque and of a stimulus, among segments of this protocol.
    let data = |id: u32, byte| Frame::classic(id, &[byte; 8]).unwrap();
    let classic = |message: &Message| message.encode().frames(Format::Classic).collect::<Vec<_>>();
    let page = SensorPage::Skin(SkinSensors::default());
    let press =
        Message::Stimulus { to: Node::Cell(CellId::new(2).unwrap()), from: StimulusStart::Next, page };
    let halt = classic(&Message::Halt);
    let frames: Vec<_> = [data(0x001, 1), data(0x201, 2), halt[0], data(0x701, 3), halt[1], data(0x001, 4)]
        .into_iter()
        .chain(classic(&press))
        .collect();
    let capture: Vec<_> = (5_000_u64..).zip(frames).map(|(at, frame)| (at * MS, "a", frame)).collect();
    let of = |only| share_of(&capture, TimeRange::default(), |selection| selection.only = only, 1);
    let ids = |due: &[DueFrame]| due.iter().map(|due| due.frame.id()).collect::<Vec<_>>();
    let (inputs, plan_summary) = of(SenderFilter::Inputs);
    assert_eq!(ids(&inputs), [0, 0, 0x702, 0x702]);
    assert_eq!(plan_summary.skipped, BTreeMap::from([(reason::NO_INPUT, 4)]));
    assert_eq!(of(SenderFilter::Replies).0.len(), 0);
    let (all, _) = of(SenderFilter::All);
    assert_eq!(ids(&all), [0x001, 0x201, 0, 0x701, 0, 0x001, 0x702, 0x702], "in their order");
    assert!(all.iter().all(|due| due.role == FrameRole::Plain));
}

#[test]
fn wire_messages_are_never_sent() {
    let survey = Survey::new(TimeRange::default());
    for only in [SenderFilter::All, SenderFilter::Inputs, SenderFilter::Replies] {
        let selection = FrameSelection { only, destinations: vec![Some(0)], reads: true };
        let replay_plan = ReplayPlan::new(&survey, &selection);
        let frame = port::LinkId { wire: 9, back: false }.encode_frame(port::PortMessage::Join);
        assert_eq!(replay_plan.skip_reason(0, &frame, &decoded(&frame)), Some(reason::SIMULATED_WIRE));
        // A damaged frame does not show which protocol it belongs to, and counts as foreign.
        let other = Frame::classic(frame.raw_id(), &[0; 8]).unwrap();
        assert_ne!(replay_plan.skip_reason(0, &other, &decoded(&other)), Some(reason::SIMULATED_WIRE));
    }
}

#[test]
fn a_part_begins_and_ends_at_its_times_and_buses_are_mapped() {
    let part = TimeRange { from: Some(MS), to: Some(6 * MS) };
    let (due, plan_summary) = plan_summary(part, |selection| selection.destinations = vec![None, Some(0)], 1);
    assert_eq!(shown(&due), [(0, 0, 1)]);
    let skipped = [
        (reason::BEFORE_PART, 1),
        (reason::AFTER_PART, 2),
        (reason::BUS_NOT_SELECTED, 3),
        (reason::ERROR_FRAME, 1),
    ];
    assert_eq!(plan_summary.skipped, BTreeMap::from(skipped));
}

#[test]
fn passes_follow_each_other_as_joints_do() {
    let (due, _) = plan_summary(TimeRange::default(), |selection| selection.only = SenderFilter::Inputs, 3);
    let starts: Vec<_> = due.iter().step_by(4).map(|due| due.at / MS).collect();
    // A pass lasts 6 ms, which is also the time from the first joints to the second.
    assert_eq!(starts, [0, 12, 24]);
    let rounds = due.iter().filter_map(|due| match due.role {
        FrameRole::Joints(AwaitedJoints { round, .. }) if due.bus_index == 0 => round,
        FrameRole::Joints(_) | FrameRole::Plain | FrameRole::SegmentOfJoints => None,
    });
    assert_eq!(rounds.collect::<Vec<_>>(), [0, 1, 2, 3, 4, 5]);
}
