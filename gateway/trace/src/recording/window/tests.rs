use proptest::prelude::*;
use protocol::can::Frame;
use protocol::candump::{Record as CanFrame, Timestamp};

use super::*;
use crate::ros2::standard::JointState;

const MS: u64 = 1_000_000;
const START: u64 = 1_000_000_000 * MS;

/// A message in the file: topic, log time, publish time, and sequence number within its topic.
type WrittenMessage = (String, u64, u64, u32);

struct Bench {
    file: FileWriter<Vec<u8>>,
    window: ReorderWindow,
    frames: Channel,
    joints: Channel,
}

impl Bench {
    fn new() -> Self {
        let mut file = FileWriter::new(Vec::new()).unwrap();
        let frames = file.channel::<CanFrame<'_>>("/can/vcan0", &[]).unwrap();
        let joints = file.channel::<JointState<'_>>("/arm/joint_states", &[]).unwrap();
        let mut window = ReorderWindow::default();
        window.begin(START);
        Self { file, window, frames, joints }
    }

    fn frame(&mut self, nanos: u64) {
        let time = Timestamp::with_nine_digits(nanos);
        let record = CanFrame { time, interface: "vcan0", frame: Frame::EMPTY, direction: None };
        self.window.write(&mut self.frames, nanos, &record);
    }

    fn joints(&mut self, nanos: u64) {
        let state = JointState { nanos, names: &[], position: &[], velocity: &[], effort: &[] };
        self.window.write(&mut self.joints, nanos, &state);
    }

    fn at(&mut self, now: u64) -> MessageCount {
        let mut written = self.window.set_time(now, &mut self.file).unwrap();
        written.add(self.window.write_due(&mut self.file).unwrap());
        written
    }

    /// Returns all messages of the file, and the number of those that arrived after later ones had been written.
    fn end(mut self) -> (Vec<WrittenMessage>, u64) {
        self.window.write_all(&mut self.file).unwrap();
        assert_eq!(self.window.waiting_count(), MessageCount::default());
        self.file.finish().unwrap();
        let bytes = self.file.into_inner();
        let seen = mcap::MessageStream::new(&bytes).unwrap().map(|message| {
            let message = message.unwrap();
            (message.channel.topic.clone(), message.log_time, message.publish_time, message.sequence)
        });
        (seen.collect(), self.window.late_messages())
    }
}

#[test]
fn messages_of_several_topics_are_put_in_order_of_their_times() {
    let mut bench = Bench::new();
    for ms in [1, 3, 9] {
        bench.joints(START + ms * MS);
    }
    for ms in [2, 3, 8] {
        bench.frame(START + ms * MS);
    }
    assert_eq!(bench.at(START + 45 * MS), MessageCount { frames: 2, others: 2 }, "8 and 9 ms wait");
    let (seen, late) = bench.end();
    let times: Vec<_> =
        seen.iter().map(|(topic, logged, ..)| (&topic[1..2], (logged - START) / MS)).collect();
    assert_eq!(times, [("a", 1), ("c", 2), ("a", 3), ("c", 3), ("c", 8), ("a", 9)]);
    assert_eq!(late, 0);
    assert!(seen.iter().all(|(_, logged, published, _)| logged == published));
}

#[test]
fn what_comes_too_late_is_written_behind_and_counted() {
    let mut bench = Bench::new();
    bench.frame(START);
    bench.at(START + 60 * MS);
    bench.joints(START - 7 * MS);
    bench.frame(START + 30 * MS);
    let (seen, late) = bench.end();
    let times: Vec<_> = seen.iter().map(|(_, logged, published, _)| (*logged, *published)).collect();
    let expected = [(START, START), (START, START - 7 * MS), (START + 30 * MS, START + 30 * MS)];
    assert_eq!((times.as_slice(), late), (expected.as_slice(), 1));
}

#[test]
fn the_order_of_one_topic_is_never_changed() {
    let mut bench = Bench::new();
    for ms in [5, 4, 6] {
        bench.frame(START + ms * MS);
    }
    let (seen, late) = bench.end();
    let seen: Vec<_> = seen.iter().map(|it| ((it.1 - START) / MS, (it.2 - START) / MS, it.3)).collect();
    assert_eq!((seen.as_slice(), late), ([(5, 5, 0), (5, 4, 1), (6, 6, 2)].as_slice(), 0));
}

#[test]
fn a_clock_that_is_set_back_begins_a_new_order() {
    let mut bench = Bench::new();
    bench.frame(START + MS);
    let back = START - 3_600_000 * MS;
    assert_eq!(bench.at(back), MessageCount { frames: 1, others: 0 }, "it does not wait an hour");
    bench.frame(back + MS);
    assert_eq!(bench.at(back + 50 * MS), MessageCount { frames: 1, others: 0 });
    let (seen, late) = bench.end();
    assert_eq!((seen[1].1, late), (back + MS, 0));
}

#[test]
fn a_time_in_the_future_is_waited_for_by_nobody() {
    let mut bench = Bench::new();
    bench.joints(START + 3_600_000 * MS);
    bench.frame(START + MS);
    assert_eq!(bench.at(START + 100 * MS).others, 1);
    bench.frame(START + 90 * MS);
    let (seen, late) = bench.end();
    assert_eq!((seen[1].1, seen[1].2, late), (START + 40 * MS, START + 3_600_000 * MS, 0));
}

#[test]
fn no_more_waits_than_may() {
    let mut bench = Bench::new();
    for at in 0..3 * MAX_MESSAGES as u64 {
        bench.frame(START + at);
        if bench.window.is_full() {
            bench.window.write_due(&mut bench.file).unwrap();
        }
        assert!(bench.window.waiting.len() < MAX_MESSAGES);
    }
    assert_eq!(bench.end().0.len(), 3 * MAX_MESSAGES);
}

#[test]
fn another_file_begins_with_the_same_buffers_and_an_order_of_its_own() {
    let mut bench = Bench::new();
    bench.frame(START + 10 * MS);
    bench.at(START + 60 * MS);
    bench.joints(START);
    assert_eq!((bench.at(START + 101 * MS).others, bench.window.late_messages()), (1, 1));
    bench.frame(START + 99 * MS);
    bench.window.begin(START + 100 * MS);
    assert_eq!(bench.window.waiting_count(), MessageCount::default(), "it was for the file before");
    let Bench { file, frames, joints, .. } = Bench::new();
    let mut bench = Bench { file, frames, joints, window: bench.window };
    bench.frame(START);
    assert_eq!(bench.at(START + 140 * MS).frames, 1);
    let (seen, late) = bench.end();
    assert_eq!((seen[0].1, late), (START, 1), "late in the file before, not in this one");
}

#[test]
fn buffers_that_grew_while_a_file_stood_still_are_given_back() {
    let mut bench = Bench::new();
    for at in 0..MAX_MESSAGES as u64 {
        bench.frame(START + at);
    }
    assert!(bench.window.waiting.capacity() >= MAX_MESSAGES && bench.window.bytes.capacity() > INITIAL_BYTES);
    bench.at(START + 100 * MS);
    let ReorderWindow { waiting, bytes, buffers, .. } = &bench.window;
    let waiting = waiting.capacity() * size_of::<WaitingMessage>();
    assert!([waiting, bytes.capacity(), buffers.1.capacity()].iter().all(|&bytes| bytes <= INITIAL_BYTES));
}

proptest! {
    #[test]
    fn all_is_written_once_in_order_of_log_time(
        steps in proptest::collection::vec((any::<bool>(), 0_u64..200, 0_u64..30), 0..200),
    ) {
        let mut bench = Bench::new();
        let mut now = START;
        for &(is_frame, age, pause) in &steps {
            now += pause * MS;
            if is_frame { bench.frame(now - age * MS) } else { bench.joints(now - age * MS) }
            bench.at(now);
        }
        let (seen, late) = bench.end();
        prop_assert_eq!(seen.len(), steps.len());
        prop_assert!(seen.is_sorted_by_key(|(_, logged, ..)| *logged));
        for topic in ["/can/vcan0", "/arm/joint_states"] {
            let numbers = seen.iter().filter(|it| it.0 == topic).map(|it| it.3);
            prop_assert!(numbers.zip(0..).all(|(number, place)| number == place));
        }
        let within = steps.iter().all(|&(_, age, _)| age < 40);
        prop_assert!(!within || late == 0);
    }
}
