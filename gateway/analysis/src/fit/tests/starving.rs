//! The frames that starve, compared with a saturated bus in virtual time.

use bus_model::{BusFrame, NodeBus, TransmitQueue};
use model::generate::{ReplyMode, SkinRequest};
use protocol::can::{BIT_RATE_SWITCH, Format, Frame};
use protocol::wire_time::{BitRates, FrameBits};

use super::super::starving::{FrameKind, StarvingFrames, first_starving};
use super::{fit, skin, text};

const PERIOD_NS: u64 = 16_000_000;
const HEARTBEAT_NS: u64 = 250_000_000;
/// Duration of a simulation: 640 epochs, 41 heartbeats of each cell.
const END_NS: u64 = 640 * PERIOD_NS;
/// More unsent frames than this of one identifier are a backlog that grows.
const MAX_UNSENT: usize = 4;

/// Data whose frames have nearly the maximum of stuff bits, and usual data.
const LONGEST: [u8; 16] =
    [0x83, 0xE0, 0xF8, 0x3E, 0x0F, 0x83, 0xE0, 0xF8, 0x3E, 0x0F, 0x83, 0xE0, 0xF8, 0x3E, 0x0F, 0x83];
const USUAL: [u8; 16] =
    [0x12, 0xA7, 0x35, 0x9C, 0x61, 0xD4, 0x2B, 0x88, 0x4E, 0xF3, 0x57, 0x19, 0xCA, 0x66, 0x3D, 0xB1];

/// The frames of one identifier.
#[derive(Debug)]
struct Sender {
    id: u32,
    node: u16,
    frames: Vec<Frame>,
    period_ns: u64,
    /// Time of the first request.
    first_ns: u64,
}

impl Sender {
    fn load(&self, rates: BitRates) -> f64 {
        let took = |frame: &Frame| FrameBits::from_frame(frame).unwrap().nanoseconds(rates);
        self.frames.iter().map(took).sum::<u64>() as f64 / self.period_ns as f64
    }
}

/// Returns the joints, the torques and the heartbeats of a bus, in order of priority.
fn senders(cells: u16, format: Format, data: [u8; 16]) -> Vec<Sender> {
    let sender = |id: u32, node: u16, period_ns, first_ns| {
        let frames = match format {
            Format::Fd => vec![Frame::fd(id, BIT_RATE_SWITCH, &data).unwrap()],
            Format::Classic => data.chunks(8).map(|segment| Frame::classic(id, segment).unwrap()).collect(),
        };
        Sender { id, node, frames, period_ns, first_ns }
    };
    let torque = |node| sender(0x200 | u32::from(node), node, PERIOD_NS, 700_000);
    let heartbeat =
        |node| sender(0x400 | u32::from(node), node, HEARTBEAT_NS, HEARTBEAT_NS * u64::from(node) / 255);
    let joints = [sender(0x001, 0, PERIOD_NS, 0)];
    joints.into_iter().chain((1..=cells).map(torque)).chain((1..=cells).map(heartbeat)).collect()
}

/// Returns the identifiers whose frames wait in growing numbers, if every node requests all of its frames.
fn simulated(senders: &[Sender], rates: BitRates) -> Vec<u32> {
    let queue: TransmitQueue = "priority:65536".parse().unwrap();
    let mut bus = NodeBus::new(rates, queue, None);
    let mut requests = Vec::new();
    for (index, sender) in senders.iter().enumerate() {
        let times = (0..).map(|it| sender.first_ns + it * sender.period_ns).take_while(|&at| at < END_NS);
        requests.extend(times.flat_map(|at| sender.frames.iter().map(move |frame| (at, index, frame))));
    }
    requests.sort_by_key(|(at, index, _)| (*at, *index));
    let mut unsent = vec![0; senders.len()];
    for (at, index, frame) in requests {
        bus.request(at, senders[index].node, BusFrame::from_frame(frame).unwrap(), index).unwrap();
        unsent[index] += 1;
    }
    bus.advance(END_NS);
    std::iter::from_fn(|| bus.poll()).for_each(|sent| unsent[sent.tag] -= 1);
    let starving = senders.iter().zip(unsent).filter(|(_, unsent)| *unsent > MAX_UNSENT);
    starving.map(|(sender, _)| sender.id).collect()
}

/// Compares the identifiers that starve in a simulation with the named ones. Returns the numbers of those that starve
/// in the simulation and in the worst case.
fn compare(cells: u16, rates: &str, data: [u8; 16]) -> (usize, usize) {
    let is_classic = rates.starts_with("classic ");
    let format = if is_classic { Format::Classic } else { Format::Fd };
    let bit_rates: BitRates = rates.trim_start_matches("classic ").parse().unwrap();
    let senders = senders(cells, format, data);
    let simulated = simulated(&senders, bit_rates);
    let named = first_starving(senders.iter().map(|it| it.load(bit_rates)));
    let named: Vec<_> = senders.iter().skip(named.unwrap_or(senders.len())).map(|it| it.id).collect();
    // The first one gets some of its time, and may get nearly all of it.
    let is_alike = simulated == named || named.get(1..) == Some(simulated.as_slice());
    assert!(is_alike, "{cells} at {rates}: {simulated:X?} starve, named are {named:X?}");
    // The worst case has frames that are at least as long.
    let request = SkinRequest { cells: cells.into(), ..SkinRequest::default() };
    let worst = fit(&skin(&text(&request)), rates).starving;
    let worst_ids = worst.iter().flat_map(|it| {
        let kind = if it.frames == FrameKind::Torques { 0x200 } else { 0x400 };
        (u32::from(it.from_node.unwrap())..=u32::from(cells)).map(move |node| kind | node)
    });
    let worst_ids: Vec<_> = worst_ids.collect();
    assert!(worst_ids.ends_with(&named), "{cells} at {rates}: {worst:?}, but {named:X?} starve");
    (simulated.len(), worst_ids.len())
}

#[test]
fn the_identifiers_that_starve_in_virtual_time_are_the_named_ones() {
    for (cells, rates, data) in [
        (253, "1M/5M", LONGEST),
        (230, "1M/5M", LONGEST),
        (110, "500k/2M", LONGEST),
        (120, "500k/2M", USUAL),
        (62, "classic 1M", LONGEST),
        (70, "classic 1M", USUAL),
    ] {
        let (starving, worst) = compare(cells, rates, data);
        println!("{cells} cells at {rates}: {starving} starve, {worst} in the worst case");
        assert!(starving > 0 && starving < 2 * usize::from(cells), "{cells} at {rates}: {starving}");
    }
    for (cells, rates) in [(85, "1M/5M"), (253, "1M/8M"), (50, "classic 1M")] {
        assert_eq!(compare(cells, rates, LONGEST), (0, 0), "{cells} at {rates}");
    }
}

#[test]
fn the_frames_without_a_bound_are_named_with_their_cells() {
    let starving = |request: &SkinRequest, rates: &str| fit(&skin(&text(request)), rates).starving;
    let all =
        |frames, cells, from_node| StarvingFrames { frames, cells: Some(cells), from_node: Some(from_node) };
    // 227 frames of 70.4 us, with the joints, are 15 981 of 16 000 us.
    let arm = SkinRequest::default();
    let expected = [all(FrameKind::Torques, 27, 227), all(FrameKind::Heartbeats, 253, 1)];
    assert_eq!(starving(&arm, "1M/5M"), expected);
    // 216 * 70.4 are 15 206 us; 176 of 215 heartbeats, each 0.064 frames a period, fill the rest.
    let fewer = SkinRequest { cells: 215, ..arm };
    assert_eq!(starving(&fewer, "1M/5M"), [all(FrameKind::Heartbeats, 39, 177)]);
    let sums = SkinRequest { reply: ReplyMode::Sum, ..arm };
    assert_eq!(starving(&sums, "1M/5M")[0], all(FrameKind::Sums, 27, 227));
    assert_eq!(starving(&arm, "1M/8M"), []);
    let slow = StarvingFrames { frames: FrameKind::Joints, cells: None, from_node: None };
    let one = SkinRequest { cells: 1, ..arm };
    let expected = [slow, all(FrameKind::Torques, 1, 1), all(FrameKind::Heartbeats, 1, 1)];
    assert_eq!(starving(&one, "classic 10k"), expected);
}
