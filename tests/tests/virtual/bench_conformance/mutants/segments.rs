//! Cells that reassemble segments wrongly.

use protocol::message::{Message, NetworkPage};
use protocol::packet::Packet;

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::beat;

/// Faults with segments, on a classic bus.
pub(crate) const SEGMENTS: &[FaultCase] = &[
    ("segments are taken in either order", "COUNT-3", |it| {
        it.hear = |memory, _, frame| {
            if frame.id() >> 8 != 5 {
                return vec![frame];
            }
            let before = memory.frame.replace(frame).filter(|before| before.id() == frame.id());
            let Some(before) = before else { return vec![frame] };
            let bytes: Vec<u8> = frame.data().iter().chain(before.data()).copied().collect();
            let id = protocol::id::Id::from_bits(u16::try_from(frame.id()).unwrap());
            if Packet::decode(id, &bytes).is_ok() { vec![frame, before] } else { vec![frame] }
        };
    }),
    ("one buffer for the segments of all identifiers", "COUNT-3", |it| {
        it.hear = |memory, _, frame| {
            let before = memory.frame.replace(frame);
            // A segment under another identifier discards the waiting one.
            match before {
                Some(before) if before.id() != frame.id() && memory.count == u64::from(frame.id()) + 1 => {
                    memory.count = u64::from(before.id()) + 1;
                    Vec::new()
                }
                Some(before) => {
                    memory.count = if before.id() == frame.id() { 0 } else { u64::from(before.id()) + 1 };
                    vec![frame]
                }
                None => vec![frame],
            }
        };
    }),
    ("segments wait for ever", "COUNT-3", |it| {
        it.hear = |memory, _, frame| {
            // The first segment again, just before the second one.
            let is_request = frame.id() == 0x500 + u32::from(NODE);
            if !is_request {
                return vec![frame];
            }
            let late = memory.now.elapsed_since(memory.at) > protocol::time::Span::from_millis(100);
            memory.at = memory.now;
            let before = memory.frame.replace(frame);
            match before {
                Some(before) if late => {
                    let bytes: Vec<u8> = before.data().iter().chain(frame.data()).copied().collect();
                    let id = protocol::id::Id::from_bits(u16::try_from(frame.id()).unwrap());
                    if Packet::decode(id, &bytes).is_ok() { vec![before, frame] } else { vec![frame] }
                }
                _ => vec![frame],
            }
        };
    }),
    ("a lost segment costs the next packet too", "COUNT-3", |it| {
        it.hear = |memory, message, frame| {
            if frame.id() != 0x500 + u32::from(NODE) {
                return vec![frame];
            }
            memory.count += 1;
            let _ = message;
            // Segments are combined in pairs, whatever they are.
            let before = memory.frame.take();
            let Some(before) = before else {
                memory.frame = Some(frame);
                return Vec::new();
            };
            vec![before, frame]
        };
    }),
    ("incomplete packets are counted for each segment", "COUNT-3", |it| {
        it.say = |_, mut message| {
            if let Message::Network { page: NetworkPage::Rejected(page), .. } = &mut message {
                page.incomplete = page.incomplete.wrapping_mul(2);
            }
            vec![(0, message)]
        };
    }),
    ("sent counts segments", "BEAT-4", |it| {
        it.say = |memory, mut message| {
            memory.count += 1;
            if let Some(beat) = beat(&mut message) {
                beat.sent = beat.sent.wrapping_add(u16::try_from(memory.count % 60_000).unwrap());
            }
            vec![(0, message)]
        };
    }),
    ("segments are sent in the wrong order", "SEND-1", |it| {
        it.put = |_, packet, format| {
            let mut frames: Vec<_> = packet.frames(format).collect();
            if packet.id.kind == protocol::id::Kind::Sensors {
                frames.reverse();
            }
            frames
        };
    }),
];
