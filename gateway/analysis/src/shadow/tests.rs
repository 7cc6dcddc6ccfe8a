//! Tests of traffic whose times can be computed by hand.

mod run;

use super::*;
use protocol::can::{BIT_RATE_SWITCH, ERROR, EXTENDED, FD_FORMAT, Format};
use protocol::id::CellId;
use protocol::message::{Joints, Message};
use protocol::packet::{Epoch, WORDS};

const MS: u64 = 1_000_000;

fn options() -> ShadowOptions {
    ShadowOptions { each_frame: true, ..ShadowOptions::new("1M/5M".parse().unwrap()) }
}

fn shadow() -> Shadow {
    Shadow::new(options()).unwrap()
}

fn ended(mut shadow: Shadow) -> (Vec<FrameTiming>, ShadowReport) {
    shadow.finish();
    let frames: Vec<_> = std::iter::from_fn(|| shadow.poll()).collect();
    (frames, shadow.report())
}

fn classic(id: u32, bytes: &[u8]) -> Frame {
    Frame::classic(id, bytes).unwrap()
}

/// Returns the duration of a frame at 1M/5M, in ns.
fn took(frame: &Frame) -> u64 {
    FrameBits::from_frame(frame).unwrap().nanoseconds(options().rates)
}

fn joints(epoch: u8) -> Message {
    Message::Joints { epoch: Epoch(epoch), joints: Joints { in_use: 6, ..Joints::default() } }
}

fn torque(cell: i64, epoch: u8) -> Message {
    let from = CellId::new(cell).unwrap();
    Message::Torque { from, epoch: Epoch(epoch), torque: [3; WORDS].into() }
}

fn say(shadow: &mut Shadow, format: Format, nanos: u64, message: &Message) {
    message.encode().frames(format).for_each(|frame| shadow.receive("vcan0", nanos, &frame));
}

#[test]
fn frames_come_back_in_the_files_order_with_the_times_of_the_wire() {
    let mut shadow = shadow();
    let (slow, urgent) = (classic(0x700, &[1; 8]), classic(0x100, &[2; 8]));
    shadow.receive("can0", 5, &slow);
    shadow.receive("can0", 10, &slow);
    shadow.receive("can1", 10, &slow);
    shadow.receive("can0", 11, &urgent);
    let (frames, report) = ended(shadow);
    let sent: Vec<_> = frames.iter().map(|frame| frame.sent.unwrap()).collect();
    let (a, b) = (took(&slow), took(&urgent));
    assert_eq!(sent, [(5, 5 + a), (5 + a + b, 5 + 2 * a + b), (10, 10 + a), (5 + a, 5 + a + b)]);
    assert_eq!(
        frames.iter().map(|frame| (frame.nanos, frame.id)).collect::<Vec<_>>(),
        [(5, 0x700), (10, 0x700), (10, 0x700), (11, 0x100)]
    );
    assert_eq!(frames[1].bits, FrameBits::from_frame(&slow));
    let [can0, can1] = report.buses.as_slice() else { panic!("{report:?}") };
    assert_eq!((can0.counts.sent, can1.counts.sent, report.frames), (3, 1, 4));
    assert_eq!((can0.queue.value, can0.queue_of_one.value, can0.queue_of_one_id), (3.0, 2.0, 0x700));
    assert!((can0.delay_us.max - (2 * a + b - 5) as f64 / 1e3).abs() < 1e-9);
    // With three significant digits.
    assert!((can0.delay_us.p50 / ((a + b - 6) as f64 / 1e3) - 1.0).abs() < 2e-3, "{:?}", can0.delay_us);
    assert!(can0.kinds.is_empty() && can0.replies.is_none(), "no packets of this protocol");
}

#[test]
fn each_bus_has_its_own_bit_rates() {
    let of_bus = vec![("can1".to_owned(), "500k".parse().unwrap())];
    let mut shadow = Shadow::new(ShadowOptions { rates_by_bus: of_bus, ..options() }).unwrap();
    let frame = classic(1, &[]);
    ["can0", "can1"].into_iter().for_each(|bus| shadow.receive(bus, 0, &frame));
    let (frames, _) = ended(shadow);
    let ends: Vec<_> = frames.iter().map(|frame| frame.sent.unwrap().1).collect();
    assert_eq!(ends, [took(&frame), 2 * took(&frame)]);
}

#[test]
fn a_recording_out_of_order_is_sorted_and_told_in_the_files_order() {
    let times = [9, 3, 6, 1, 12].map(|time| time * MS);
    let mut shadow = shadow();
    times.into_iter().for_each(|time| shadow.receive("can0", time, &classic(1, &[])));
    let (frames, report) = ended(shadow);
    assert_eq!(frames.iter().map(|frame| frame.sent.unwrap().0).collect::<Vec<_>>(), times);
    assert_eq!((report.buses[0].counts.out_of_order, report.buses[0].counts.too_late_to_sort), (3, 0));
    assert!((report.buses[0].duration_s - 0.011).abs() < 1e-12);
}

#[test]
fn what_is_too_far_out_of_order_counts_at_a_later_time() {
    let mut shadow = shadow();
    [0, 5_000, 100].into_iter().for_each(|time| shadow.receive("can0", time * MS, &classic(1, &[])));
    let (frames, report) = ended(shadow);
    let starts: Vec<_> = frames.iter().map(|frame| frame.sent.unwrap().0 / MS).collect();
    // Frame 0 had been sent before, so 100 ms could still be sorted in; but not before released frames.
    assert_eq!(starts, [0, 5_000, 100]);
    assert_eq!(report.buses[0].counts.too_late_to_sort, 0);
    let mut shadow = Shadow::new(options()).unwrap();
    [1_000, 3_000, 5_000, 100]
        .into_iter()
        .for_each(|time| shadow.receive("can0", time * MS, &classic(1, &[])));
    let (frames, report) = ended(shadow);
    assert_eq!(frames[3].sent.unwrap().0 / MS, 3_000);
    assert_eq!(report.buses[0].counts.too_late_to_sort, 1);
}

#[test]
fn what_is_on_no_real_bus_takes_no_time() {
    let bus_timing = protocol::port::LinkId { wire: 3, back: false };
    let wire = bus_timing.encode_frame(protocol::port::PortMessage::Join);
    let mut shadow = shadow();
    shadow.receive("vcan0", 0, &wire);
    shadow.receive("vcan0", 0, &classic(ERROR | 4, &[0; 8]));
    // A frame of another protocol with the bit of a wire set, as in J1939.
    let other = classic(EXTENDED | 0x18FE_F100, &[7; 8]);
    shadow.receive("vcan0", 0, &other);
    let (frames, report) = ended(shadow);
    let sent: Vec<_> = frames.iter().map(|frame| (frame.bits.is_some(), frame.sent)).collect();
    assert_eq!(sent, [(false, None), (false, None), (true, Some((0, took(&other))))]);
    let bus = &report.buses[0];
    assert_eq!((bus.frames, bus.counts.bench.wires, bus.counts.error_frames, bus.counts.sent), (3, 1, 1, 1));
}

#[test]
fn an_answer_is_late_when_the_next_joints_were_to_go_out_before_its_end() {
    for format in [Format::Fd, Format::Classic] {
        let mut shadow = shadow();
        for epoch in 0..4 {
            let begin = u64::from(epoch) * 2 * MS;
            say(&mut shadow, format, begin, &joints(epoch));
            // 20 answers fit within 2 ms as FD frames, but not as pairs of classic frames.
            (1..=20).for_each(|cell| say(&mut shadow, format, begin + 1_000, &torque(cell, epoch)));
        }
        // One answer was late in the recording: it answers the joints before the last ones.
        say(&mut shadow, format, 8 * MS + 2, &torque(30, 2));
        let (_, report) = ended(shadow);
        let bus = &report.buses[0];
        let replies = bus.replies.unwrap();
        assert_eq!((replies.count, replies.late_before), (81, 1));
        match format {
            Format::Fd => assert_eq!(replies.late, 0),
            // 7 of 20 are in time in the first epoch, and then fewer; after the last joints no answer counts as late.
            Format::Classic => assert!((30..60).contains(&replies.late), "{replies:?}"),
        }
        let kinds: Vec<_> = bus.kinds.iter().map(|kind| kind.kind).collect();
        assert_eq!(kinds, ["command", "torque"]);
    }
}

#[test]
fn load_is_what_is_requested_for_even_if_it_does_not_fit() {
    let mut shadow = shadow();
    let frame = classic(0x2AA, &[0x55; 8]);
    // Every 100 us for 1.1 s: frames of more than 110 us.
    (0..=11_000).for_each(|step| shadow.receive("can0", step * 100_000, &frame));
    let (frames, report) = ended(shadow);
    let bus = &report.buses[0];
    let load = took(&frame) as f64 / 100_000.0;
    assert!(load > 1.1 && (bus.load.mean.unwrap() - load).abs() < 2e-4, "{:?}", bus.load);
    assert!(
        (bus.load.worst_16_ms.value - load).abs() < 1e-9 && (bus.load.worst_1_s.value - load).abs() < 1e-9
    );
    assert!((bus.load.busy.unwrap() - 1.0).abs() < 1e-9);
    assert_eq!(bus.stretches.count, 1);
    assert!((bus.stretches.longest_s.value - 11_001.0 * took(&frame) as f64 / 1e9).abs() < 1e-9);
    assert!(frames.is_sorted_by_key(|frame| frame.sent.unwrap().0));
}

#[test]
fn bit_errors_cost_time_and_are_the_same_for_the_same_seed() {
    let run = |bit_errors, seed| {
        let mut shadow = Shadow::new(ShadowOptions { bit_errors, seed, ..options() }).unwrap();
        let frame = Frame::with_data(0x201, Format::Fd, BIT_RATE_SWITCH | FD_FORMAT, &[9; 16]).unwrap();
        (0..2_000).for_each(|step| shadow.receive("can0", step * 200_000, &frame));
        ended(shadow)
    };
    let (clean, _) = run(0.0, 1);
    let (noisy, report) = run(1e-3, 1);
    assert_eq!(noisy, run(1e-3, 1).0);
    assert_ne!(noisy, run(1e-3, 2).0);
    // About one in six; the standard deviation for 2000 is 17.
    assert!((200..600).contains(&report.buses[0].counts.damaged), "{}", report.buses[0].counts.damaged);
    assert!(clean.iter().zip(&noisy).all(|(clean, noisy)| noisy.sent.unwrap().1 >= clean.sent.unwrap().1));
    assert!(Shadow::new(ShadowOptions { bit_errors: 0.5, ..options() }).is_err());
}

#[test]
fn of_one_time_or_none_there_is_no_verdict() {
    let of = |step: u64, has_times: bool| {
        let mut shadow = shadow();
        (0..9).for_each(|at| shadow.receive("can0", 5 * MS + at * step, &classic(0x123, &[1; 8])));
        if !has_times {
            shadow.without_times();
        }
        ended(shadow).1.buses.remove(0)
    };
    assert!(of(MS, true).this_run.is_some());
    for bus in [of(0, true), of(0, false), of(MS, false)] {
        assert_eq!((bus.this_run, bus.load.mean, bus.delay_us.count), (None, None, 0));
        assert_eq!((bus.load.worst_1_s.value, bus.queue.value, bus.frames), (0.0, 0.0, 9));
    }
}

#[test]
fn nothing_is_nothing() {
    let (frames, report) = ended(shadow());
    assert!(frames.is_empty() && report.buses.is_empty());
    let mut shadow = shadow();
    shadow.record_missing("can0", 7);
    let (_, report) = ended(shadow);
    assert_eq!((report.buses[0].counts.missing, report.buses[0].load.mean), (7, None));
}

#[test]
fn time_stamps_of_a_timed_bus_are_the_ends_of_its_frames() {
    let mut timed = Shadow::new(ShadowOptions {
        stamped_at_end: StampedAtEnd::Named(vec!["vcan0".to_owned()]),
        ..options()
    })
    .unwrap();
    for epoch in 0..40 {
        let at = u64::from(epoch) * 16 * MS + MS;
        let mut send = |mut end: u64, messages: &[Message]| {
            for frame in
                messages.iter().flat_map(|it| it.encode().frames(Format::Classic).collect::<Vec<_>>())
            {
                end += took(&frame);
                timed.receive("vcan0", end, &frame);
            }
        };
        send(at, &[joints(epoch)]);
        // The answer of the last cell follows the next joints.
        let late = (epoch > 0).then(|| torque(21, epoch - 1));
        let answers: Vec<_> = late.into_iter().chain((1..=20).map(|cell| torque(cell, epoch))).collect();
        send(at + MS, &answers);
    }
    let (frames_of_timed, report) = ended(timed);
    let bus = &report.buses[0];
    assert!(bus.is_timed);
    for frame in &frames_of_timed {
        let took = frame.bits.unwrap().nanoseconds(options().rates);
        assert_eq!(frame.sent, Some((frame.nanos - took, frame.nanos)));
    }
    assert_eq!(bus.counts.sent, u64::try_from(frames_of_timed.len()).unwrap());
    assert_eq!((bus.delay_us.count, bus.queue.value.to_bits(), bus.kinds.len()), (0, 0, 0));
    let replies = bus.replies.as_ref().unwrap();
    assert_eq!((replies.count, replies.late, replies.late_before, replies.late_when_ready), (839, 39, 0, 0));
    let busy: u64 = frames_of_timed.iter().map(|it| it.bits.unwrap().nanoseconds(options().rates)).sum();
    let span = frames_of_timed.last().unwrap().nanos - frames_of_timed[0].nanos;
    let share = bus.load.busy.unwrap();
    assert!((share - busy as f64 / span as f64).abs() < 1e-2, "{share} of {}", busy as f64 / span as f64);
}
