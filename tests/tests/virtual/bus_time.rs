//! A million frames on a bus with transmit queues, equal to those of a second program to the ns.

#![allow(clippy::unwrap_used, clippy::indexing_slicing, reason = "a test may stop")]

use std::fmt::Write;

use bus_model::{BitErrors, BusFrame, NodeBus, QueueFull, QueueOrder};
use protocol::can::{BIT_RATE_SWITCH, ERROR_STATE, EXTENDED, Frame};
use protocol::wire_time::BitRates;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use skinbus_tests::bus_time::{
    BusResult, FrameRequest, NodeQueues, SentOnBus, WireFrame, check_record, transmit,
};

/// Number of frames in a run.
const FRAMES: usize = 12_500;
/// Depths of transmit queues, each in ten runs of either order.
const DEPTHS: [usize; 4] = [1, 3, 32, 65_536];

/// Returns a frame of any kind. One of four identifiers is one of a few that occur often.
fn any_frame(dice: &mut Pcg64Mcg) -> Frame {
    let id = match dice.random_range(0..4) {
        0 => dice.random_range(0x100..0x104),
        1 => EXTENDED | dice.random_range(0x100..0x102) << 18 | dice.random_range(0..2),
        2 => EXTENDED | dice.random_range(0..0x2000_0000),
        _ => dice.random_range(0..0x800),
    };
    let mut data: [u8; 64] = dice.random();
    if dice.random() {
        // Long runs of equal bits.
        data = data.map(|byte| [0x00, 0xFF, 0x83, 0xF8][usize::from(byte % 4)]);
    }
    let flags = dice.random_range(0..2) * ERROR_STATE;
    let long = dice.random_range(0..=64);
    match dice.random_range(0..6) {
        0 => Frame::remote(id, dice.random_range(0..=8)),
        1 | 2 => Frame::classic(id, &data[..long % 9]),
        3 => Frame::fd(id, flags, &data[..long % 20]),
        4 => Frame::fd(id, flags | BIT_RATE_SWITCH, &data[..long]),
        _ => Frame::fd(id, flags | BIT_RATE_SWITCH, &data[..16]),
    }
    .unwrap()
}

/// Returns requests in stretches: an idle bus, a saturated one, and many requests at one instant. On average, the bus
/// can send all of them.
fn requests(dice: &mut Pcg64Mcg, count: usize, rates: BitRates) -> Vec<FrameRequest> {
    let (nodes, mut at) = (dice.random_range(1..60), 0);
    let bit_ns = 1_000_000_000 / u64::from(rates.nominal_rate());
    let mut requests = Vec::with_capacity(count);
    while requests.len() < count {
        let length = dice.random_range(1..80);
        let longest_gap = [2_000, 200, 200, 20, 0][dice.random_range(0..5)] * bit_ns;
        for _ in 0..length.min(count - requests.len()) {
            at += dice.random_range(0..=longest_gap);
            requests.push(FrameRequest { at, node: dice.random_range(0..nodes), frame: any_frame(dice) });
        }
    }
    requests
}

/// Returns the results of the bus that the server uses, with its bit errors.
fn results_of_server(bus: &mut NodeBus<usize>, requests: &[FrameRequest]) -> BusResult {
    let mut result = BusResult::default();
    for (index, request) in requests.iter().enumerate() {
        let on_bus = BusFrame::from_frame(&request.frame).expect("no request is an error frame");
        match bus.request(request.at, request.node, on_bus, index) {
            Ok(at) => assert_eq!(at, request.at),
            Err(QueueFull) => result.refused.push(index),
        }
    }
    bus.finish();
    result.sent = std::iter::from_fn(|| bus.poll())
        .map(|it| SentOnBus { request: it.tag, start: it.start, end: it.end, is_damaged: it.is_damaged })
        .collect();
    result
}

/// Writes the record of a bus as the server does: transmissions that have ended by a request stand before it.
fn record(
    rates: BitRates,
    queue: &str,
    errors: f64,
    requests: &[FrameRequest],
    result: &BusResult,
) -> String {
    let mut text = format!("# skinbus timed bus 1 rates {rates} queue {queue} errors {errors} seed 1\n");
    let mut sent = result.sent.iter().peekable();
    let mut write_sent = |text: &mut String, until: u64| {
        while let Some(it) = sent.next_if(|it| it.end <= until) {
            let kind = if it.is_damaged { 'D' } else { 'S' };
            writeln!(text, "{kind} {} {} {}", it.request, it.start, it.end).unwrap();
        }
    };
    for (number, FrameRequest { at, node, frame }) in requests.iter().enumerate() {
        write_sent(&mut text, *at);
        match result.refused.binary_search(&number) {
            Ok(_) => writeln!(text, "X {at} {node} {frame}").unwrap(),
            Err(_) => writeln!(text, "Q {number} {at} {node} {frame}").unwrap(),
        }
    }
    write_sent(&mut text, requests.last().unwrap().at + 1_000_000);
    text
}

/// Compares both programs in runs with different rates, depths and bit errors; returns the number of frames.
fn compare(order: QueueOrder) -> usize {
    let mut dice = Pcg64Mcg::seed_from_u64(26 + u64::from(order == QueueOrder::Fifo));
    let (mut frames, mut refused, mut damaged, mut idle, mut back_to_back) = (0, 0, 0, 0, 0);
    for run in 0..10 * DEPTHS.len() {
        let depth = DEPTHS[run % DEPTHS.len()];
        let rates = ["1M/5M", "500k/2M", "300k/7M", "1M/8M", "1M"][run % 5];
        let rate = [0.0, 1e-4, 2e-3][run % 3];
        let (is_fifo, name) = match order {
            QueueOrder::Fifo => (true, format!("fifo:{depth}")),
            QueueOrder::Priority => (false, format!("priority:{depth}")),
        };
        let rates: BitRates = rates.parse().unwrap();
        let errors = BitErrors::new(rate, dice.random()).unwrap();
        let mut bus = NodeBus::new(rates, name.parse().unwrap(), Some(errors));
        let requests = requests(&mut dice, FRAMES, rates);
        let result = results_of_server(&mut bus, &requests);
        let damaged_bits = result.sent.iter().map(|it| {
            let frame = || WireFrame::new(&requests[it.request].frame);
            let bit = || frame().damaged_bit(rates, it.end - it.start).expect("some bit was damaged");
            it.is_damaged.then(bit)
        });
        let damaged_bits: Vec<_> = damaged_bits.collect();
        let expected = transmit(rates, NodeQueues { is_fifo, depth }, &requests, &damaged_bits);
        let unlike = result.sent.iter().zip(&expected.sent).find(|(sent, expected)| sent != expected);
        assert_eq!(unlike, None, "run {run}, {name} at {rates}");
        assert!(result == expected, "run {run}, {name} at {rates}: numbers of frames or refusals");
        if run < 2 * DEPTHS.len() {
            let figures = check_record(&record(rates, &name, rate, &requests, &result));
            assert_eq!(figures.requested, requests.len() - result.refused.len());
        }
        frames += requests.len();
        refused += result.refused.len();
        damaged += damaged_bits.iter().flatten().count();
        let ends = result.sent.windows(2);
        let gaps = ends.filter(|pair| pair[0].end < pair[1].start).count();
        idle += gaps;
        back_to_back += result.sent.len() - 1 - gaps;
    }
    assert!(refused > frames / 20 && refused < frames / 2, "{refused}");
    assert!(damaged > frames / 20 && idle > frames / 20 && back_to_back > frames / 4);
    frames
}

#[test]
fn half_a_million_frames_by_priority_are_sent_as_a_second_program_says() {
    assert_eq!(compare(QueueOrder::Priority), 500_000);
}

#[test]
fn half_a_million_frames_in_the_order_of_their_requests_are_sent_as_a_second_program_says() {
    assert_eq!(compare(QueueOrder::Fifo), 500_000);
}
