//! Fuzz targets for a cell, the tracker of a cell, and wired cells, with any order of events.

use arbitrary::{Result, Unstructured};
use cell_node::flash::{self, FlashState};
use cell_node::identity::Identity;
use cell_node::node::Node;
use model::tracker::CellTracker;
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Command, Id};
use protocol::message::Message;
use protocol::packet::Packet;
use protocol::parameters::Parameters;
use protocol::port::{LinkId, PORTS};
use protocol::time::{Micros, Span};

use super::{frame, packet};
use crate::network::Wiring;

/// The number of packets that a cell must not exceed after one event.
const MANY: usize = 200;

/// Gives a cell any frames, port messages, times and flash failures. Every packet that it sends must be valid and have
/// its node id, and its timeouts must lie in the future.
pub(super) fn cell(data: &[u8]) {
    let _ = run_cell(&mut Unstructured::new(data));
}

fn run_cell(from: &mut Unstructured<'_>) -> Result<()> {
    let format = if from.arbitrary()? { Format::Fd } else { Format::Classic };
    let own = CellId::new(12).unwrap();
    let identity = Identity { cell: from.arbitrary::<bool>()?.then_some(own), serial: from.arbitrary()? };
    let flash = match from.int_in_range(0..=2)? {
        0 => FlashState::Empty,
        1 => FlashState::Damaged,
        _ => FlashState::Valid(Parameters::default()),
    };
    let mut node = Node::new(identity, format, &flash, from.arbitrary()?, Micros(0));
    if from.arbitrary()? {
        node.set_wired_ports(from.arbitrary()?);
    }
    let mut now = Micros(0);
    while !from.is_empty() {
        match from.int_in_range(0..=5)? {
            0 => now.0 += u64::from(from.arbitrary::<u16>()?),
            // A cell without a node id has no timeout.
            1 => now = now.max(node.poll_timeout().min(now + Span::from_millis(1_000))),
            2 => {
                let message = LinkId { wire: 0, back: false };
                let data = from.bytes(8)?;
                let frame = Frame::classic(message.raw_id(), data).unwrap();
                if let Some(message) = message.decode_frame(&frame) {
                    let port = from.int_in_range(0..=PORTS)?;
                    node.handle_port(now, Span(0), port, message);
                }
            }
            3 => {
                let age = Span(from.int_in_range(0..=20_000)?);
                node.handle_frame(now, age, &frame(from)?);
            }
            _ => {
                let packet = Packet { id: heard(from, own)?, ..packet(from)? };
                for frame in packet.frames(format) {
                    node.handle_frame(now, Span(0), &frame);
                }
            }
        }
        node.handle_timeout(now);
        drain(&mut node, from)?;
        assert!(node.poll_timeout() > now, "{:?} at {now:?}", node.poll_timeout());
    }
    Ok(())
}

/// Returns an identifier, mostly one that the cell receives.
fn heard(from: &mut Unstructured<'_>, own: CellId) -> Result<Id> {
    let commands = [Command::Joints, Command::Halt, Command::Sync, Command::Resume, Command::Report];
    let ids: Vec<Id> = commands.into_iter().map(Id::command).chain(Id::ids_received_by_cell(own)).collect();
    Ok(*from.choose(&ids)?)
}

fn drain(node: &mut Node, from: &mut Unstructured<'_>) -> Result<()> {
    let (mut packets, mut messages) = (0, 0);
    loop {
        if let Some(kept) = node.poll_store() {
            let serial = node.identity().serial;
            assert_eq!(flash::decode(node.identity(), &flash::encode(serial, &kept)), Ok(kept));
            node.handle_stored(from.ratio(7, 8)?);
        }
        if let Some((port, message)) = node.poll_port_transmit() {
            messages += 1;
            assert!(port <= PORTS && messages < MANY, "{port} {message:?}");
            let link = LinkId { wire: 0, back: true };
            assert_eq!(link.decode_frame(&link.encode_frame(message)), Some(message));
            continue;
        }
        let Some(packet) = node.poll_transmit() else { return Ok(()) };
        packets += 1;
        assert!(packets < MANY, "{packet:?}");
        let message = Message::decode(packet).unwrap();
        assert_eq!(message.encode(), *packet);
        assert!(!matches!(
            message,
            Message::Joints { .. } | Message::Stimulus { .. } | Message::Configure { .. }
        ));
    }
}

/// Checks that the gateway's tracker of a cell counts every received packet exactly once, with any order of events.
pub(super) fn tracker(data: &[u8]) {
    let _ = track(&mut Unstructured::new(data));
}

fn track(from: &mut Unstructured<'_>) -> Result<()> {
    let mut cell = CellTracker::default();
    let (mut now, mut came) = (Micros(0), 0_u64);
    let mut before = cell.account.uplink();
    while !from.is_empty() {
        match from.int_in_range(0..=7)? {
            0 => {
                now.0 += u64::from(from.arbitrary::<u32>()?);
                let silent = cell.handle_timeout(now);
                assert!(!silent || cell.is_dead());
            }
            1 => cell.account.handle_connection_loss(),
            2 => {
                cell.account.count_rejected();
                came += 1;
            }
            3 => cell.account.exclude_unreceived_sums(),
            _ => {
                let Ok(message) = Message::decode(&packet(from)?) else { continue };
                let joints = from.arbitrary::<Option<u16>>()?.map(u64::from);
                cell.record_packet(now, &message, joints);
                came += 1;
                assert!(!cell.is_dead() && cell.last_packet() == Some(now));
            }
        }
        let uplink = cell.account.uplink();
        assert!(uplink.delivered + uplink.unsettled <= came, "{uplink:?} of {came}");
        assert!(uplink.delivered >= before.delivered, "{uplink:?} after {before:?}");
        // A start is retracted if its heartbeats turn out to be another sender's.
        let taken_back = before.restarts.saturating_sub(uplink.restarts);
        assert!(uplink.outsiders >= before.outsiders + u64::from(taken_back), "{uplink:?} after {before:?}");
        before = uplink;
    }
    cell.account.finish();
    Ok(())
}

/// Wires cells at random and adds faults. No sum may contain a cell twice (the wiring checks each one), and after all
/// faults every cell must have a route again.
pub(super) fn tree(data: &[u8]) {
    let _ = grow(&mut Unstructured::new(data));
}

fn grow(from: &mut Unstructured<'_>) -> Result<()> {
    let mut wiring = Wiring::random(from.arbitrary::<u8>()?.into());
    let cells = wiring.cells.len();
    for cell in 0..cells {
        wiring.start(cell);
        wiring.run(Span(u64::from(from.arbitrary::<u8>()?) * 100));
    }
    wiring.run(Span::from_millis(2_000));
    wiring.switch(from.int_in_range(0..=6)?, false);
    // A press is sent to a node id, which the cells have only now.
    (0..cells).for_each(|cell| wiring.press(cell, true));
    wiring.begin();
    for _ in 0..12 {
        if from.is_empty() {
            break;
        }
        let cell = from.int_in_range(0..=cells - 1)?;
        match from.int_in_range(0..=5)? {
            0 => wiring.kill(cell),
            1 => wiring.hang(cell),
            2 => wiring.go_on(cell),
            3 if !wiring.runs(cell) => wiring.start(cell),
            4 => wiring.set_link_down(cell, from.int_in_range(0..=PORTS - 1)?, from.arbitrary()?),
            _ => wiring.switch(from.int_in_range(0..=6)?, false),
        }
        wiring.run(Span(u64::from(from.arbitrary::<u8>()?) * 1_000));
    }
    for cell in 0..cells {
        (0..PORTS).for_each(|port| wiring.set_link_down(cell, port, false));
        wiring.go_on(cell);
        if !wiring.runs(cell) {
            wiring.start(cell);
        }
    }
    wiring.run(Span::from_millis(6_000));
    for cell in wiring.reachable() {
        assert!(wiring.route(cell).is_some(), "cell {cell}: {}", wiring.routes());
    }
    Ok(())
}
