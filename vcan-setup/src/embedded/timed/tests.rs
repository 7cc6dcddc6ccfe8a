//! Tests of the timed bus with times by hand.

use super::*;
use protocol::can::Format;
use protocol::id::{CellId, Node};
use protocol::message::{Message, SensorPage, SkinSensors, StimulusStart};
use protocol::packet::{Epoch, Length, Words};
use protocol::wire_time::FrameBits;

/// A bus at 1M/5M, with a bit-error rate.
fn timed(errors: f64, queue: &str) -> TimedBus {
    TimedBus::new(TimedBusOptions {
        rates: "1M/5M".parse().unwrap(),
        queue: queue.parse().unwrap(),
        bit_error_rate: errors,
        seed: 1,
        counts_bench_traffic: false,
        record: None,
    })
    .unwrap()
}

fn torque(cell: i64) -> Frame {
    let torque = Words::zeros(Length::Six);
    let message = Message::Torque { from: CellId::new(cell).unwrap(), epoch: Epoch(1), torque };
    message.encode().frames(Format::Fd).next().unwrap()
}

fn stimulus(format: Format) -> Vec<Frame> {
    let page = SensorPage::Skin(SkinSensors::default());
    let message = Message::Stimulus { to: Node::Everyone, from: StimulusStart::Next, page };
    message.encode().frames(format).collect()
}

fn parcel(frame: &Frame) -> FrameDatagram {
    FrameDatagram::from_client_datagram(&frame.to_bytes()[..frame.byte_len()], true).unwrap()
}

fn nanos(frame: &Frame) -> u64 {
    FrameBits::from_frame(frame).unwrap().nanoseconds("1M/5M".parse().unwrap())
}

/// Ends a round. Returns the identifier and the stamp of each delivery.
fn round(timed: &mut TimedBus, now: u64) -> Vec<(u32, u64)> {
    let mut effects = RoundEffects::default();
    timed.end_round(now, &mut effects);
    effects.deliveries.iter().map(|it| (it.parcel.raw_id(), it.stamp)).collect()
}

#[test]
fn frames_are_delivered_at_their_ends_in_the_order_of_arbitration() {
    let mut timed = timed(0.0, "priority");
    let [high, low] = [torque(3), torque(200)];
    // Read in another order than sent: the low one had begun.
    timed.collect(1_500, ClientId(2), parcel(&high));
    timed.collect(1_000, ClientId(1), parcel(&low));
    timed.collect(1_600, ClientId(4), parcel(&torque(4)));
    assert_eq!(round(&mut timed, 2_000), []);
    let ends = [1_000 + nanos(&low), 1_000 + nanos(&low) + nanos(&high)];
    assert_eq!(timed.wake_time(), Some(ends[0] + GATHER_NS), "others wait");
    assert_eq!(round(&mut timed, ends[0]), [(low.raw_id(), ends[0])]);
    assert_eq!(round(&mut timed, ends[1] - 2), []);
    assert_eq!(round(&mut timed, ends[1]), [(high.raw_id(), ends[1])]);
    let last = ends[1] + nanos(&torque(4));
    assert_eq!(timed.wake_time(), Some(last), "nothing else waits");
    assert_eq!(round(&mut timed, last + 70_000), [(torque(4).raw_id(), last)]);
    assert_eq!(timed.wake_time(), None);
    let report = timed.report();
    assert_eq!((report.requested, report.sent, report.waiting, report.max_waiting), (3, 3, 0, 3));
    assert!((report.busy_s - (last - 1_000) as f64 * 1e-9).abs() < 1e-12);
}

#[test]
fn a_request_that_comes_too_late_for_an_arbitration_takes_part_in_the_next() {
    let mut timed = timed(0.0, "priority");
    timed.collect(1_000, ClientId(1), parcel(&torque(9)));
    timed.collect(1_000, ClientId(2), parcel(&torque(8)));
    assert_eq!(round(&mut timed, 500_000).len(), 2);
    timed.collect(2_000, ClientId(3), parcel(&torque(1)));
    assert_eq!(round(&mut timed, 600_000), [(torque(1).raw_id(), 500_001 + nanos(&torque(1)))]);
}

#[test]
fn what_only_a_bench_sends_passes_beside_the_bus() {
    for format in [Format::Fd, Format::Classic] {
        let mut timed = timed(0.0, "priority");
        // A frame of the protocol comes first: only then are packets known to be of the bench.
        for cell in 1..4 {
            timed.collect(1_000, ClientId(1), parcel(&torque(cell)));
        }
        let stimulus = stimulus(format);
        for frame in &stimulus {
            timed.collect(3_000, ClientId(2), parcel(frame));
        }
        let delivered = round(&mut timed, 5_000);
        assert_eq!(delivered, vec![(stimulus[0].raw_id(), 3_000); stimulus.len()], "{format:?}");
        assert_eq!((timed.report().beside, timed.report().requested), (stimulus.len() as u64, 3));
        timed.options.counts_bench_traffic = true;
        timed.collect(6_000, ClientId(2), parcel(&stimulus[0]));
        assert_eq!(round(&mut timed, 7_000), []);
    }
}

#[test]
fn a_full_queue_refuses_and_names_its_client() {
    let mut timed = timed(0.0, "fifo:1");
    for at in [10, 20] {
        timed.collect(at, ClientId(5), parcel(&torque(7)));
    }
    let mut effects = RoundEffects::default();
    timed.end_round(30, &mut effects);
    let [Refusal { from, raw_id }] = effects.refusals[..] else { panic!("{effects:?}") };
    assert_eq!((from, raw_id), (ClientId(5), torque(7).raw_id()));
    let report = timed.report();
    let id = format!("{:X}", torque(7).raw_id());
    assert_eq!(report.refused_by_id, BTreeMap::from([(id.clone(), 1)]));
    assert_eq!(report.waiting_by_id, BTreeMap::from([(id, 1)]));
}

#[test]
fn frames_of_a_client_that_has_gone_are_sent_from_nobody() {
    let mut timed = timed(0.0, "priority");
    timed.collect(0, ClientId(1), parcel(&torque(1)));
    round(&mut timed, 10);
    timed.collect(11, ClientId(1), parcel(&torque(2)));
    timed.forget_client(ClientId(1));
    let mut effects = RoundEffects::default();
    timed.end_round(1_000_000, &mut effects);
    assert_eq!(effects.deliveries.iter().map(|it| it.from).collect::<Vec<_>>(), [None, None]);
}

#[test]
fn the_same_requests_make_the_same_record() {
    let folder = tempfile::TempDir::new().unwrap();
    let record = |name: &str, rounds: u64| {
        let path = folder.path().join(name);
        let mut timed = TimedBus::new(TimedBusOptions {
            record: Some(BusRecord::create(&path).unwrap()),
            ..timed(0.005, "fifo:4").options
        })
        .unwrap();
        for at in 0..2_000_u64 {
            let client = ClientId(usize::try_from(1 + at % 7).unwrap());
            timed.collect(at * 40_000, client, parcel(&torque(1 + at.cast_signed() % 254)));
            if at % rounds == 0 {
                round(&mut timed, at * 40_000);
            }
        }
        round(&mut timed, 2_000 * 40_000);
        let report = timed.report();
        assert_eq!(report.record_failure, None);
        assert!(report.damaged > 100 && report.refused > 100, "{report:?}");
        (report, std::fs::read_to_string(path).unwrap())
    };
    let (report, text) = record("a", 1);
    assert_eq!((report.clone(), text.clone()), record("b", 5));
    let first: Vec<_> = text.lines().take(2).collect();
    assert_eq!(first[0], "# skinbus timed bus 1 rates 1M/5M queue fifo:4 errors 0.005 seed 1");
    assert!(first[1].starts_with("Q 0 0 1 201##"), "{first:?}");
    for (word, count) in
        [('Q', report.requested), ('S', report.sent), ('D', report.damaged), ('X', report.refused)]
    {
        assert_eq!(text.lines().filter(|line| line.starts_with(word)).count() as u64, count, "{word}");
    }
    assert!(BusRecord::create(&folder.path().join("a")).is_err(), "an existing file is kept");
}
