//! Checks that the cell drops unusable packets, counts them by reason, and does nothing else.

use protocol::can::{BIT_RATE_SWITCH, EXTENDED, Format, Frame};
use protocol::id::{Command, Id, Kind, Node};
use protocol::message::{RejectedCounts, State};
use protocol::packet::{Epoch, Length, Packet, Words, crc16};
use protocol::parameters::MAX_JOINTS;

use crate::arm;
use crate::bus::StopReason;
use crate::session::Session;

/// The counter of network page 2 that must count an unusable packet.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum RejectCounter {
    Length,
    Crc,
    /// Counted only if the cell's controller delivers the frame.
    MaybeForeign,
    Meaning,
    Incomplete,
    None,
}

impl RejectCounter {
    const fn expected_change_text(self) -> &'static str {
        match self {
            Self::Length => "only in the counter 'length'",
            Self::Crc => "only in the counter 'crc'",
            Self::MaybeForeign => "only in the counter 'foreign'",
            Self::Meaning => "only in the counter 'meaning'",
            Self::Incomplete => "only in the counter 'incomplete'",
            Self::None => "in no counter",
        }
    }
}

/// The number of attempts, so that a regular heartbeat is not taken for an answer.
const MAX_CHECK_ATTEMPTS: usize = 3;

pub(super) fn run(session: &mut Session<'_>) -> Result<(), StopReason> {
    session.prepare_cell(&arm::example_parameters(2))?;
    let mut before = session.counters()?;
    for (what, frames, reason) in rejected_packet_cases(session) {
        let mut beats = usize::MAX;
        for _ in 0..MAX_CHECK_ATTEMPTS {
            let exchange = session.exchange_frames(&frames)?;
            session.check("COUNT-1", exchange.is_silent(), || {
                format!("the cell must drop {what}, but it answered")
            });
            let has_effect = exchange.state().has(State::HALTED) || exchange.state().has(State::DUPLICATE);
            session.check("COUNT-1", !has_effect, || {
                format!("{what} must have no effect, but the state after it is {:04X}", exchange.state().0)
            });
            if has_effect {
                session.send_messages(&[protocol::message::Message::Resume])?;
            }
            let after = session.counters()?;
            let is_so =
                is_rejection_counted(before.refused, after.refused, reason) && before.heard == after.heard;
            session.check("COUNT-1", is_so, || {
                format!(
                    "{what} must be counted {}, but the counters are {after}; before: {before}",
                    reason.expected_change_text()
                )
            });
            before = after;
            // A regular heartbeat may have come beside the one to the sync, but not in each attempt.
            beats = beats.min(exchange.beats);
            if beats <= 1 {
                break;
            }
        }
        session.check("COUNT-1", beats <= 1, || {
            format!("the cell must drop {what}, but it answered with a heartbeat")
        });
    }
    Ok(())
}

fn is_rejection_counted(before: RejectedCounts, after: RejectedCounts, reason: RejectCounter) -> bool {
    let mut expected = before;
    let field = match reason {
        RejectCounter::Length => &mut expected.length,
        RejectCounter::Crc => &mut expected.crc,
        RejectCounter::MaybeForeign => &mut expected.foreign,
        RejectCounter::Meaning => &mut expected.meaning,
        RejectCounter::Incomplete => &mut expected.incomplete,
        RejectCounter::None => return before == after,
    };
    *field = field.wrapping_add(1);
    after == expected || reason == RejectCounter::MaybeForeign && after == before
}

/// Returns packets that would have an effect if the cell accepted them.
fn effective_packets(session: &Session<'_>) -> Vec<(&'static str, Packet)> {
    let own = Node::Cell(session.cell);
    let packet =
        |id, words: [i16; 6], epoch, count| Packet { id, words: words.into(), epoch: Epoch(epoch), count };
    let claim = [1, 0, 0, 0, 0, (State::CLAIMING_NODE_ID.0 | 1 << 12).cast_signed()];
    vec![
        ("a halt", packet(Id::command(Command::Halt), [0; 6], 0, 0)),
        ("a sync", packet(Id::command(Command::Sync), [0; 6], 0, 0)),
        ("a joints message", packet(Id::command(Command::Joints), [1, 2, 3, 4, 5, 6], 250, 6)),
        ("a report", packet(Id::command(Command::Report), [0; 6], 0, 0)),
        ("a claim of the cell's node id", packet(Id::new(Kind::Network, own), claim, 0, 0)),
        ("a read request", packet(Id::new(Kind::Configure, own), [0; 6], 8, 0)),
        ("a read request to all cells", packet(Id::new(Kind::Configure, Node::Everyone), [0; 6], 8, 0)),
        ("a stimulus", packet(Id::new(Kind::Stimulus, own), [999, 0, 0, 0, 0, 0], 0, 0x80)),
        (
            "a stimulus to all cells",
            packet(Id::new(Kind::Stimulus, Node::Everyone), [999, 0, 0, 0, 0, 0], 0, 0x80),
        ),
    ]
}

fn rejected_packet_cases(session: &Session<'_>) -> Vec<(String, Vec<Frame>, RejectCounter)> {
    let mut cases = Vec::new();
    let (format, own) = (session.format, session.cell);
    for (name, packet) in effective_packets(session) {
        let id = u32::from(packet.id.to_bits());
        let bytes = packet.encode();
        let framed = |bytes: &[u8]| frames_from_bytes(format, id, bytes);
        let wrong = if format == Format::Fd { RejectCounter::Crc } else { RejectCounter::Incomplete };
        for (what, place, flip) in
            [("first", 0, 1), ("tenth", 9, 0x40), ("next to last", 14, 0x80), ("last", 15, 1)]
        {
            let mut bytes = bytes.clone();
            if let Some(byte) = bytes.get_mut(place) {
                *byte ^= flip;
            }
            cases.push((format!("{name} with a wrong bit in its {what} byte"), framed(&bytes), wrong));
        }
        // A CRC of the right bytes under another identifier, and the right CRC with its bytes swapped.
        let Id { kind, node } = packet.id;
        let others = if matches!(kind, Kind::Configure | Kind::Stimulus) {
            vec![node ^ 1, if node == 0xFF { own.get() } else { 0xFF }]
        } else {
            vec![node ^ 1]
        };
        for node in others {
            let other = Packet { id: Id { kind, node }, ..packet };
            cases.push((
                format!("{name} with the CRC of another identifier"),
                framed(&other.encode()),
                wrong,
            ));
        }
        let mut swapped = bytes.clone();
        swapped.swap(14, 15);
        if swapped != bytes {
            cases.push((format!("{name} with swapped CRC bytes"), framed(&swapped), wrong));
        }
        if format == Format::Fd {
            add_wrong_fd_lengths(&mut cases, name, &packet);
        } else {
            let lengths: &[usize] =
                if packet.id == Id::command(Command::Joints) { &[0, 5, 7] } else { &[0, 4, 7] };
            for length in lengths {
                let short = bytes.get(..*length).unwrap_or_default();
                let frame = Frame::classic(id, short).into_iter().collect();
                cases.push((
                    format!("a frame of {length} bytes with the identifier of {name}"),
                    frame,
                    RejectCounter::Length,
                ));
            }
        }
        add_foreign_frames(&mut cases, name, format, id, &bytes);
    }
    for byte in [0, 0xFF] {
        let wrong = if format == Format::Fd { RejectCounter::Crc } else { RejectCounter::Incomplete };
        cases.push((
            format!("a halt with 16 bytes of {byte:02X}"),
            frames_from_bytes(format, 0, &[byte; 16]),
            wrong,
        ));
    }
    add_bad_pages(session, &mut cases);
    cases
}

/// Returns frames with these bytes in the format of a bus.
fn frames_from_bytes(format: Format, id: u32, bytes: &[u8]) -> Vec<Frame> {
    match format {
        Format::Fd => Frame::fd(id, BIT_RATE_SWITCH, bytes).into_iter().collect(),
        Format::Classic => bytes.chunks(8).filter_map(|bytes| Frame::classic(id, bytes).ok()).collect(),
    }
}

/// Adds FD frames with lengths that this kind of packet cannot have, with a correct CRC if there is room for one.
fn add_wrong_fd_lengths(cases: &mut Vec<(String, Vec<Frame>, RejectCounter)>, name: &str, packet: &Packet) {
    let id = u32::from(packet.id.to_bits());
    let has_long = packet.id == Id::command(Command::Joints);
    for length in [0, 1, 8, 12, 20, 24, 32, 48, 64] {
        if has_long && [20, 24, 32].contains(&length) {
            continue;
        }
        let mut bytes: Vec<u8> =
            packet.encode().iter().copied().chain(core::iter::repeat(0)).take(length).collect();
        if let Some(body) = length.checked_sub(2) {
            let head: Vec<u8> = packet
                .id
                .to_bits()
                .to_le_bytes()
                .into_iter()
                .chain(bytes.iter().copied().take(body))
                .collect();
            let crc = crc16(&head).to_le_bytes();
            bytes.truncate(body);
            bytes.extend(crc);
        }
        let frame = Frame::fd(id, BIT_RATE_SWITCH, &bytes).into_iter().collect();
        cases.push((format!("{name} in a frame of {length} bytes"), frame, RejectCounter::Length));
    }
    let classic = Frame::classic(id, packet.encode().get(..8).unwrap_or_default());
    cases.push((format!("{name} in a classic frame"), classic.into_iter().collect(), RejectCounter::Length));
}

/// Adds frames that resemble a packet, but have an identifier of 29 bits or are remote frames.
fn add_foreign_frames(
    cases: &mut Vec<(String, Vec<Frame>, RejectCounter)>,
    name: &str,
    format: Format,
    id: u32,
    bytes: &[u8],
) {
    // On a classic bus, only the first segment.
    let whole = frames_from_bytes(format, id | EXTENDED, bytes).into_iter().take(1).collect();
    cases.push((format!("{name} with a 29-bit identifier"), whole, RejectCounter::MaybeForeign));
    // The upper 11 of 29 bits; the frames of a wire have the uppermost bit set.
    if id < 0x400 {
        let upper = frames_from_bytes(format, id << 18 | EXTENDED, bytes).into_iter().take(1).collect();
        cases.push((
            format!("{name} with its identifier in the upper 11 bits of a 29-bit identifier"),
            upper,
            RejectCounter::MaybeForeign,
        ));
    }
    let remote = Frame::remote(id, 8).into_iter().collect();
    cases.push((
        format!("a remote frame with the identifier of {name}"),
        remote,
        RejectCounter::MaybeForeign,
    ));
}

/// Adds packets with pages and counts that do not exist, and with identifiers that are undefined or belong to other
/// nodes.
fn add_bad_pages(session: &Session<'_>, cases: &mut Vec<(String, Vec<Frame>, RejectCounter)>) {
    let own = Node::Cell(session.cell);
    let packet =
        |id, words: [i16; 6], epoch, count| Packet { id, words: words.into(), epoch: Epoch(epoch), count };
    let mut others = Vec::new();
    let mut add = |what: String, packet: Packet, reason| {
        cases.push((what, packet.frames(session.format).collect(), reason));
    };
    for page in [5, 9, 127, 128, 255] {
        let claim = [1, 0, 0, 0, 0, (State::CLAIMING_NODE_ID.0 | 1 << 12).cast_signed()];
        add(
            format!("a network packet (4nn) with the cell's node id and page {page}"),
            packet(Id::new(Kind::Network, own), claim, 0, page),
            RejectCounter::Meaning,
        );
    }
    for count in [2, 3, 0x7F, 0x82, 0xFF] {
        for to in [own, Node::Everyone] {
            let stimulus = packet(Id::new(Kind::Stimulus, to), [999, 0, 0, 0, 0, 0], 0, count);
            add(format!("a stimulus with count byte {count:02X} to {to}"), stimulus, RejectCounter::Meaning);
        }
    }
    for command in [5, 6, 0x55, 0xFF] {
        let id = Id { kind: Kind::Command, node: command };
        add(
            format!("a command with the unknown number {command}"),
            packet(id, [0; 6], 0, 0),
            RejectCounter::None,
        );
    }
    let own = session.cell.get();
    let near = [own.wrapping_add(1), own.wrapping_sub(1), own ^ 3, own ^ 0x80, 0xFE, 1];
    for node in near.into_iter().filter(|node| ![own, 0, 0xFF].contains(node)) {
        for kind in
            [Kind::Network, Kind::Configure, Kind::Stimulus, Kind::Torque, Kind::Sum, Kind::Configured]
        {
            let count = if kind == Kind::Stimulus { 0x80 } else { 1 };
            let id = Id { kind, node };
            let packet = packet(id, [1; 6], 0, count);
            let length = if session.format == Format::Fd { 12 } else { 5 };
            let bytes: Vec<_> = packet.encode().iter().copied().take(length).collect();
            add(format!("a {} packet of node {node}", kind.name()), packet, RejectCounter::None);
            others.push((
                format!(
                    "a frame of {length} bytes with the identifier of a {} packet of node {node}",
                    kind.name()
                ),
                frames_from_bytes(session.format, id.to_bits().into(), &bytes),
                RejectCounter::None,
            ));
        }
    }
    let everyone = Id { kind: Kind::Network, node: 0 };
    add("a gateway's heartbeat".to_owned(), packet(everyone, [0; 6], 0, 0), RejectCounter::None);
    let joints = Id::command(Command::Joints);
    for count in [0, 7, 14, 200] {
        let words = Words::new(Length::Six, [3; MAX_JOINTS]);
        let packet = Packet { id: joints, words, epoch: Epoch(251), count };
        add(format!("a joints message with count {count}"), packet, RejectCounter::Meaning);
    }
    cases.extend(others);
}
