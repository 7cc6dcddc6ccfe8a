//! Cells that accept or count unusable frames wrongly.

use protocol::can::{EXTENDED, Format, Frame};
use protocol::message::{Message, NetworkPage, State};
use protocol::packet::Packet;

use super::{FaultCase, NODE};
use crate::bench_conformance::wrong::{beat, fd, with};

/// Faults with unusable frames.
pub(crate) const COUNTERS: &[FaultCase] = &[
    ("a wrong CRC is not counted", "COUNT-1", |it| {
        it.say = |memory, mut message| {
            let crc = match &mut message {
                Message::Network { page: NetworkPage::Rejected(page), .. } => core::mem::take(&mut page.crc),
                _ => 0,
            };
            memory.count = memory.count.max(crc.into());
            vec![(0, message)]
        };
    }),
    ("a wrong length is counted twice", "COUNT-1", |it| {
        it.say = |_, mut message| {
            if let Message::Network { page: NetworkPage::Rejected(page), .. } = &mut message {
                page.length = page.length.wrapping_mul(2);
            }
            vec![(0, message)]
        };
    }),
    ("the CRC is not looked at", "COUNT-1", |it| it.hear = |_, _, frame| vec![corrected(frame, 0)]),
    ("the low byte of the CRC is not looked at", "COUNT-1", |it| {
        it.hear = |_, _, frame| vec![corrected(frame, 0xFF00)]
    }),
    ("the high byte of the CRC is not looked at", "COUNT-1", |it| {
        it.hear = |_, _, frame| vec![corrected(frame, 0x00FF)]
    }),
    ("the identifier is not in the CRC", "COUNT-1", |it| {
        it.hear = |_, _, frame| {
            let other = u16::try_from(frame.id() & 0x7FF).unwrap() ^ 1;
            let bytes = frame.data();
            let is_others = Packet::decode(protocol::id::Id::from_bits(other), bytes).is_ok();
            vec![if is_others { corrected(frame, 0) } else { frame }]
        };
    }),
    ("longer frames are taken", "COUNT-1", |it| {
        it.hear = |_, _, frame| {
            let is_long = frame.format() == Format::Fd && frame.data().len() > 16 && frame.id() != 1;
            if !is_long {
                return vec![frame];
            }
            vec![corrected(Frame::fd(frame.raw_id(), 0, &frame.data()[..16]).unwrap(), 0)]
        };
    }),
    ("29 bits of an identifier are taken for 11", "COUNT-1", |it| {
        it.hear = |_, _, frame| {
            let is_it = frame.is_extended() && frame.id() < 0x800 && frame.format() == Format::Fd;
            vec![if is_it { Frame::fd(frame.raw_id() & !EXTENDED, 0, frame.data()).unwrap() } else { frame }]
        };
    }),
    ("the upper 11 of 29 bits are taken", "COUNT-1", |it| {
        it.hear = |_, _, frame| {
            let is_it = frame.is_extended() && frame.id() >= 0x800 && frame.format() == Format::Fd;
            vec![if is_it { Frame::fd(frame.id() >> 18, 0, frame.data()).unwrap() } else { frame }]
        };
    }),
    ("a remote frame of a halt halts", "COUNT-1", |it| {
        it.hear = |_, _, frame| {
            if frame.is_remote() && frame.id() == 0 { vec![fd(&Message::Halt)] } else { vec![frame] }
        };
    }),
    ("a page that does not exist sets DUPLICATE", "COUNT-1", |it| {
        it.hear = |memory, message, frame| {
            if frame.id() == 0x400 + u32::from(NODE)
                && message.is_none()
                && frame.data().len() == 16
                && frame.data()[13] == 9
            {
                memory.count = 1;
            }
            vec![frame]
        };
        it.say = |memory, mut message| {
            if beat(&mut message).is_some() && core::mem::take(&mut memory.count) == 1 {
                return vec![(0, with(message, State::DUPLICATE, true))];
            }
            vec![(0, message)]
        };
    }),
    ("packets for other cells are counted", "COUNT-1", |it| {
        it.hear = |memory, _, frame| {
            if frame.id() & 0xFF != u32::from(NODE) && frame.id() > 0x200 && frame.id() & 0xFF != 0xFF {
                memory.count += 1;
            }
            vec![frame]
        };
        it.say = |memory, mut message| {
            if let Message::Network { page: NetworkPage::Rejected(page), .. } = &mut message {
                page.meaning = page.meaning.wrapping_add(u16::try_from(memory.count).unwrap());
            }
            vec![(0, message)]
        };
    }),
    ("torques have no bit-rate switch and are classic at times", "SEND-1", |it| {
        it.put = |memory, packet, format| {
            memory.count += 1;
            let format = if memory.count.is_multiple_of(50) { format.other_format() } else { format };
            packet.frames(format).collect()
        };
    }),
    ("a CRC is wrong at times", "SEND-1", |it| {
        it.put = |memory, packet, format| {
            memory.count += 1;
            let mut bytes = packet.encode();
            if memory.count.is_multiple_of(90) {
                *bytes.last_mut().unwrap() ^= 1;
            }
            let _ = format;
            vec![Frame::fd(packet.id.to_bits().into(), 1, &bytes).unwrap()]
        };
    }),
    ("an unused word is sent as it is", "SEND-1", |it| {
        it.put = |_, packet, format| {
            let mut packet = *packet;
            if packet.id.kind == protocol::id::Kind::Sensors && packet.count == 1 {
                packet.words = packet.words.with_word(5, 7);
            }
            packet.frames(format).collect()
        };
    }),
];

/// Corrects the CRC of a frame, if it is right in these bits.
fn corrected(frame: Frame, bits: u16) -> Frame {
    let is_packet = frame.format() == Format::Fd && [16, 20, 24, 32].contains(&frame.data().len());
    if !is_packet || frame.is_extended() {
        return frame;
    }
    let (body, crc) = frame.data().split_at(frame.data().len() - 2);
    let id = u16::try_from(frame.id()).unwrap();
    let head: Vec<u8> = id.to_le_bytes().into_iter().chain(body.iter().copied()).collect();
    let right = protocol::packet::crc16(&head);
    let got = u16::from_le_bytes([crc[0], crc[1]]);
    if (right ^ got) & bits != 0 {
        return frame;
    }
    let bytes: Vec<u8> = body.iter().copied().chain(right.to_le_bytes()).collect();
    Frame::fd(frame.raw_id(), 1, &bytes).unwrap()
}
