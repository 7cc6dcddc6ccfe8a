//! Tests of the model against results by hand, and against a simple second model that examines all requests for each
//! frame.

use super::*;
use proptest::prelude::*;
use protocol::can::{BIT_RATE_SWITCH, EXTENDED, Frame};

fn rates() -> BitRates {
    "1M/5M".parse().unwrap()
}

fn request(at: u64, id: u32, nominal: u32, tag: u64) -> Request {
    let priority = Priority::from_frame(&Frame::classic(id, &[]).unwrap());
    Request { at, priority, bits: FrameBits { nominal, data: 0 }, queue: None, tag }
}

/// Returns all attempts that a bus makes for these requests.
fn all(mut bus: BusModel, requests: &[Request]) -> Vec<Attempt> {
    requests.iter().for_each(|&request| bus.request(request));
    bus.finish();
    assert_eq!((bus.waiting(), bus.poll_timeout()), (0, None));
    std::iter::from_fn(|| bus.poll()).collect()
}

/// Returns the tag, start and end of each attempt, times in µs.
fn times(attempts: &[Attempt]) -> Vec<(u64, u64, u64)> {
    attempts.iter().map(|it| (it.tag, it.start / 1_000, it.end / 1_000)).collect()
}

#[test]
fn a_frame_is_not_interrupted_and_then_the_lowest_identifier_goes() {
    let requests = [
        request(0, 0x700, 100, 1),
        request(10_000, 0x300, 50, 2),
        request(20_000, 0x100, 50, 3),
        request(500_000, 0x400, 50, 4),
    ];
    let attempts = all(BusModel::new(rates()), &requests);
    assert_eq!(times(&attempts), [(1, 0, 100), (3, 100, 150), (2, 150, 200), (4, 500, 550)]);
}

#[test]
fn all_that_is_requested_for_at_one_instant_takes_part() {
    let idle = [request(5_000, 3, 50, 1), request(5_000, 1, 50, 2), request(5_000, 2, 50, 3)];
    assert_eq!(times(&all(BusModel::new(rates()), &idle)), [(2, 5, 55), (3, 55, 105), (1, 105, 155)]);
    // Requests at the instant at which the bus becomes free.
    let busy = [
        request(0, 9, 50, 1),
        request(10_000, 8, 50, 2),
        request(50_000, 7, 50, 3),
        request(50_001, 6, 50, 4),
    ];
    assert_eq!(
        times(&all(BusModel::new(rates()), &busy)),
        [(1, 0, 50), (3, 50, 100), (4, 100, 150), (2, 150, 200)]
    );
}

#[test]
fn the_frames_of_a_queue_keep_their_order_whatever_their_identifiers() {
    let queued = |at, id, tag| Request { queue: Some(3), ..request(at, id, 50, tag) };
    let requests = [
        request(0, 0, 50, 1),
        queued(1_000, 0x700, 2),
        queued(2_000, 0x001, 3),
        request(3_000, 0x100, 50, 4),
    ];
    let attempts = all(BusModel::new(rates()), &requests);
    assert_eq!(times(&attempts).iter().map(|it| it.0).collect::<Vec<_>>(), [1, 4, 2, 3]);
}

#[test]
fn data_bits_take_the_data_bit_rate() {
    let frame = Frame::fd(0x201, BIT_RATE_SWITCH, &[0x55; 16]).unwrap();
    let bits = FrameBits::from_frame(&frame).unwrap();
    let request = Request { at: 7, priority: Priority::from_frame(&frame), bits, queue: None, tag: 0 };
    let [attempt] = all(BusModel::new(rates()), &[request]).try_into().unwrap();
    assert_eq!(attempt.end - attempt.start, u64::from(bits.nominal) * 1_000 + u64::from(bits.data) * 200);
    assert_eq!((attempt.at, attempt.start), (7, 7));
}

#[test]
fn who_asks_for_an_earlier_time_than_the_one_before_gets_that_ones() {
    let attempts = all(BusModel::new(rates()), &[request(9_000, 2, 50, 1), request(4_000, 1, 50, 2)]);
    assert_eq!(times(&attempts), [(2, 9, 59), (1, 59, 109)]);
    assert_eq!(attempts[0].at, 9_000);
}

#[test]
fn the_most_that_waited_is_known() {
    let mut bus = BusModel::new(rates());
    (0..5).for_each(|tag| bus.request(request(0, 1, 50, tag)));
    bus.run_until(120_000);
    assert_eq!((bus.waiting(), bus.max_waiting()), (3, 5));
    bus.finish();
    assert_eq!((bus.waiting(), bus.max_waiting()), (0, 5));
}

#[test]
fn damaged_frames_come_again_until_they_are_whole() {
    let requests: Vec<_> = (0..5_000).map(|tag| request(tag * 200_000, 0x100, 100, tag)).collect();
    let run = |seed| all(BusModel::new(rates()).with_errors(BitErrors::new(1e-3, seed).unwrap()), &requests);
    let attempts = run(11);
    assert_eq!(attempts, run(11));
    assert_ne!(attempts, run(12));
    let damaged: Vec<_> = attempts.iter().filter(|it| it.is_damaged).collect();
    // One in eleven is expected: 460, with a standard deviation of 20.
    assert!((300..700).contains(&damaged.len()), "{}", damaged.len());
    for attempt in damaged {
        // At least one bit and the error frame; at most all bits but the intermission, and the error frame.
        let bits = (attempt.end - attempt.start) / 1_000;
        let error_frame = u64::from(ERROR_FRAME_BITS);
        assert!((1 + error_frame..=97 + error_frame).contains(&bits), "{bits}");
        let next = attempts.iter().find(|it| it.start == attempt.end).unwrap();
        assert_eq!(next.tag, attempt.tag, "no other frame waits");
    }
    let mut whole: Vec<_> = attempts.iter().filter(|it| !it.is_damaged).map(|it| it.tag).collect();
    whole.sort_unstable();
    assert_eq!(whole, (0..5_000).collect::<Vec<_>>());
}

#[test]
fn a_damaged_frame_lets_a_more_urgent_one_go_first() {
    // At this rate some seed damages the first attempt of the frame.
    let requests = [request(0, 0x700, 100, 1), request(1, 0x100, 10, 2)];
    let seed = (0..1_000).find(|&seed| {
        let bus = BusModel::new(rates()).with_errors(BitErrors::new(0.01, seed).unwrap());
        let attempts = all(bus, &requests);
        attempts[0].is_damaged && !attempts[1].is_damaged && attempts.len() == 3
    });
    let bus = BusModel::new(rates()).with_errors(BitErrors::new(0.01, seed.unwrap()).unwrap());
    assert_eq!(all(bus, &requests).iter().map(|it| it.tag).collect::<Vec<_>>(), [1, 2, 1]);
}

/// A simple second model: for each frame, it examines all requests that are not sent yet.
fn plain(requests: &[Request]) -> Vec<Attempt> {
    let mut left: Vec<_> = requests.iter().enumerate().collect();
    let (mut free, mut attempts) = (0, Vec::new());
    while !left.is_empty() {
        let is_first = |number: usize, request: &Request| {
            request.queue.is_none()
                || left.iter().all(|(other, it)| it.queue != request.queue || *other >= number)
        };
        let now = free.max(left.iter().map(|(_, it)| it.at).min().unwrap());
        let contenders = left.iter().filter(|(number, it)| it.at <= now && is_first(*number, it));
        let (number, request) = *contenders.min_by_key(|(number, it)| (it.priority, *number)).unwrap();
        free = now + request.bits.nanoseconds(rates());
        attempts.push(Attempt { tag: request.tag, at: request.at, start: now, end: free, is_damaged: false });
        left.retain(|(other, _)| *other != number);
    }
    attempts
}

fn any_requests() -> impl Strategy<Value = Vec<Request>> {
    let id =
        prop_oneof![0..8_u32, (0..4_u32, 0..4_u32).prop_map(|(upper, lower)| EXTENDED | upper << 18 | lower)];
    let queue = prop_oneof![Just(None), (0..3_u16).prop_map(Some)];
    // Steps of the frames' own lengths, so that ends and requests often coincide.
    let one = (0..4_u64, id, 1..4_u32, queue);
    proptest::collection::vec(one, 0..60).prop_map(|steps| {
        let mut at = 0;
        let requests = steps.into_iter().enumerate().map(|(tag, (step, id, length, queue))| {
            at += step * 50_000;
            Request { queue, ..request(at, id, 50 * length, tag as u64) }
        });
        requests.collect()
    })
}

proptest! {
    #[test]
    fn attempts_are_those_of_the_plain_model(requests in any_requests()) {
        prop_assert_eq!(all(BusModel::new(rates()), &requests), plain(&requests));
    }

    #[test]
    fn how_time_passes_makes_no_difference(requests in any_requests(), steps in proptest::collection::vec(1..90_000_u64, 1..40)) {
        let errors = || BitErrors::new(2e-3, 5).unwrap();
        let expected = all(BusModel::new(rates()).with_errors(errors()), &requests);
        let mut bus = BusModel::new(rates()).with_errors(errors());
        let (mut now, mut steps, mut attempts) = (0, steps.into_iter().cycle(), Vec::new());
        for request in requests {
            while now < request.at {
                now = request.at.min(now + steps.next().unwrap());
                bus.run_until(now);
                attempts.extend(std::iter::from_fn(|| bus.poll()));
            }
            bus.request(request);
        }
        while let Some(at) = bus.poll_timeout() {
            bus.run_until(at.min(now + 7_000).max(now));
            now += 7_000;
            attempts.extend(std::iter::from_fn(|| bus.poll()));
        }
        prop_assert_eq!(attempts, expected);
    }
}
