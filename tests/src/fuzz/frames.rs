//! Fuzz targets for the traffic of a bus: packets, segments, serial lines, the readers of traffic.

use std::fmt::Write as _;

use analysis::shadow::{Shadow, ShadowOptions};
use analysis::stats::CaptureStats;
use arbitrary::{Result, Unstructured};
use model::decode::json;
use model::decode::settle::OrderedDecoder;
use protocol::can::{Format, rounded_fd_len};
use protocol::candump::{Record, Timestamp};
use protocol::id::Id;
use protocol::message::Message;
use protocol::packet::{Length, Lengths, Packet, Reassembler, Reassembly};
use protocol::schema::BusUnits;
use protocol::slcan::{self, Decoder, SlcanLine};
use protocol::time::Micros;
use protocol::wire_time::BitRates;

use vcan_setup::hosts::incoming::{self, HostsToBusQueue};
use vcan_setup::hosts::message;

use super::{frame, packet as any_packet};

/// Decodes a packet: encoding it must give the same bytes, and encoding its message the same packet.
pub(super) fn packet(data: &[u8]) {
    let Some((id, bytes)) = data.split_first_chunk() else { return };
    let id = Id::from_bits(u16::from_le_bytes(*id) & 0x7FF);
    if let Ok(packet) = Packet::decode(id, bytes) {
        assert_eq!(packet.encode().as_slice(), bytes);
    }
    let Ok(packet) = any_packet(&mut Unstructured::new(data)) else { return };
    assert_eq!(Packet::decode(packet.id, &packet.encode()), Ok(packet));
    for frame in packet.frames(Format::Fd) {
        assert_eq!(Packet::from_fd(&frame), Ok(packet));
    }
    if let Ok(message) = Message::decode(&packet) {
        // Bits without a meaning are not kept.
        let again = message.encode();
        assert_eq!(Message::decode(&again), Ok(message));
        assert_eq!((again.id, message.id()), (packet.id, packet.id));
    }
}

/// Reassembles segments: a complete packet must be one that was sent, and no segment may wait for ever.
pub(super) fn reassembly(data: &[u8]) {
    let _ = reassemble(&mut Unstructured::new(data));
}

fn reassemble(from: &mut Unstructured<'_>) -> Result<()> {
    let id = Id::from_bits(from.arbitrary::<u16>()? & 0x7FF);
    let lengths = Lengths::for_id(id);
    let (mut segment, mut now) = (Reassembler::NONE, Micros(0));
    let mut sent = Vec::new();
    while !from.is_empty() {
        now.0 += u64::from(from.arbitrary::<u16>()?);
        if from.ratio(1, 4)? {
            let length = from.int_in_range(0..=8)?;
            let bytes = from.bytes(length)?.to_vec();
            // A CRC of 16 bits may be right by chance.
            if let Ok(Reassembly::Complete(packet)) = segment.push(now, id, lengths, &bytes) {
                assert_eq!(Packet::decode(id, &packet.encode()), Ok(packet));
            }
        } else {
            let packet = Packet { id, ..any_packet(from)? };
            if !lengths.iter().any(|length| length == packet.words.length()) {
                continue;
            }
            let frames: Vec<_> = packet.frames(Format::Classic).collect();
            let lost = from.int_in_range(0..=3 * frames.len())?;
            sent.push(packet);
            for (index, frame) in frames.iter().enumerate().filter(|(index, _)| *index != lost) {
                let taken = segment.push(now, id, lengths, frame.data());
                if let Ok(Reassembly::Complete(complete)) = taken {
                    assert!(sent.contains(&complete) || Packet::decode(id, &complete.encode()).is_ok());
                    assert!(index + 1 == frames.len() || complete != packet);
                }
            }
        }
        assert!(segment.waiting_segment_count() < Length::MAX_SEGMENTS);
    }
    Ok(())
}

/// Decodes serial lines: the frame of a line must be written as a line with the same frame, and all bytes must be
/// counted.
pub(super) fn slcan(data: &[u8]) {
    let mut decoder = Decoder::new();
    for &byte in data {
        match decoder.push(byte) {
            Some(SlcanLine::Frame(frame)) => again(&frame),
            Some(SlcanLine::Command(command)) => {
                let mut other = Decoder::new();
                let lines: Vec<_> =
                    command.encode().as_bytes().iter().filter_map(|&byte| other.push(byte)).collect();
                assert_eq!(lines, [SlcanLine::Command(command)]);
            }
            Some(SlcanLine::Refused(_)) => assert!(decoder.rejected_lines().total() > 0),
            _ => {}
        }
    }
    if let Ok(frame) = frame(&mut Unstructured::new(data)) {
        again(&frame);
    }
}

/// Receives messages of two hosts: all their frames must be accounted for, whatever the messages state.
pub(super) fn hosts(data: &[u8]) {
    let mut from = Unstructured::new(data);
    let (mut incoming, mut frames, mut bytes) = (HostsToBusQueue::default(), Vec::new(), Vec::new());
    let mut waiting = 0;
    while let Ok(length @ 1..) = from.int_in_range(0..=600_usize).map(|length| length.min(from.len())) {
        let Ok(message) = from.bytes(length) else { break };
        let host = if length % 2 == 0 { "b" } else { "c" };
        frames.clear();
        if let Ok(head) = message::decode(message, &mut frames) {
            message::encode(&head, &frames, &mut bytes);
            let mut again = Vec::new();
            assert_eq!(message::decode(&bytes, &mut again), Ok(head));
            assert_eq!(again, frames);
        }
        assert_eq!(
            incoming.receive_message(host, message).is_ok(),
            message::decode(message, &mut frames).is_ok()
        );
        waiting = waiting.max(incoming.waiting_frames().len());
        if from.arbitrary().unwrap_or(false) {
            incoming.remove_sent(from.int_in_range(0..=9).unwrap_or(0));
        } else {
            incoming.remove_refused(from.int_in_range(0..=9).unwrap_or(0));
        }
    }
    assert!(waiting <= incoming::MAX_WAITING_FRAMES);
    let left = incoming.waiting_frames().len();
    incoming.remove_sent(left);
    for (_, it, _) in incoming.accounts() {
        // A host may state numbers whose sum overflows.
        let parts: u128 = [it.before, it.dropped_there, it.lost, it.taken].map(u128::from).iter().sum();
        assert_eq!(u128::from(it.numbered), parts.min(u64::MAX.into()));
        assert!(it.taken >= it.sent + it.dropped_here + it.refused);
    }
}

fn again(frame: &protocol::can::Frame) {
    let Some(text) = slcan::encode(frame) else { return };
    let mut decoder = Decoder::new();
    let lines: Vec<_> = text.as_bytes().iter().filter_map(|&byte| decoder.push(byte)).collect();
    assert_eq!(lines.len(), 1, "{text:?}");
    let [SlcanLine::Frame(read)] = lines[..] else { panic!("{lines:?}") };
    let said = |it: &protocol::can::Frame| (it.id(), it.is_extended(), it.is_remote(), it.format());
    // A sender may set bits above those of an identifier, which a line cannot hold.
    assert_eq!(said(&read), said(frame));
    // A DLC stands for a length of FD: the bytes after the data are zeros.
    let (data, rest) = read.data().split_at_checked(frame.data().len()).unwrap();
    assert!(data == frame.data() && rest.iter().all(|&byte| byte == 0), "{read:?}");
    assert_eq!(read.data().len(), rounded_fd_len(frame.data().len()));
}

/// Generates frames, each with a time and a bus.
fn traffic(
    from: &mut Unstructured<'_>,
    mut take: impl FnMut(&'static str, u64, protocol::can::Frame),
) -> Result<()> {
    let mut now = 1_700_000_000_000_000_000_u64;
    while !from.is_empty() {
        let step = from.arbitrary::<u32>()?;
        // Occasionally backwards, or by a long time.
        now = if from.ratio(1, 16)? {
            now.wrapping_sub(u64::from(step) << 8)
        } else {
            now.wrapping_add(step.into())
        };
        let bus = *from.choose(&["vcan0", "vcan1", "can2"])?;
        take(bus, now, frame(from)?);
    }
    Ok(())
}

/// Decodes traffic: every frame must come out once, in order, as text and as JSON.
pub(super) fn decoder(data: &[u8]) {
    let mut settler = OrderedDecoder::new(None);
    let (mut sent, mut came) = (0_u64, 0_u64);
    let mut stats = CaptureStats::default();
    let mut out = |settler: &mut OrderedDecoder<(u64, u64, &'static str, protocol::can::Frame)>| {
        while let Some(((number, nanos, bus, frame), decoded)) = settler.pop() {
            assert_eq!(number, came, "in order");
            came += 1;
            let mut text = String::new();
            write!(text, "{decoded}").unwrap();
            let time = Timestamp::with_nine_digits(nanos);
            let record = Record { time, interface: bus, frame, direction: None };
            let mut line = Vec::new();
            json::write_json_line(&mut line, &record, &decoded, BusUnits::default()).unwrap();
            let _: serde_json::Value = serde_json::from_slice(&line).unwrap();
            stats.record(&record, &decoded);
        }
    };
    let _ = traffic(&mut Unstructured::new(data), |bus, nanos, frame| {
        settler.push(Micros(nanos / 1_000), bus, &frame, (sent, nanos, bus, frame));
        sent += 1;
        out(&mut settler);
    });
    settler.finish();
    out(&mut settler);
    assert_eq!(came, sent);
    assert_eq!(stats.report().frames, sent);
}

/// Runs the model of a bus on any traffic: it must end, and transmit each frame exactly once.
pub(super) fn shadow(data: &[u8]) {
    let options = ShadowOptions {
        each_frame: true,
        ..ShadowOptions::new(BitRates::new(1_000_000, 5_000_000).unwrap())
    };
    let mut shadow = Shadow::new(options).unwrap();
    let (mut sent, mut came) = (0_u64, 0_u64);
    let _ = traffic(&mut Unstructured::new(data), |bus, nanos, frame| {
        shadow.receive(bus, nanos, &frame);
        sent += 1;
        came += std::iter::from_fn(|| shadow.poll()).count() as u64;
    });
    shadow.finish();
    came += std::iter::from_fn(|| shadow.poll()).count() as u64;
    let report = shadow.report();
    assert!(came <= sent, "{came} of {sent}");
    let _ = serde_json::to_string(&report).unwrap();
}
