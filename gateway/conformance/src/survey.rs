//! A survey of a bus, before anything is sent: its cells, gateways and damaged frames.

use std::collections::{BTreeMap, BTreeSet};

use model::decode::{Decoded, Decoder, ForeignReason};
use protocol::can::{Format, Frame};
use protocol::id::{CellId, Id};
use protocol::message::{Message, NetworkPage};
use protocol::packet::{self, Packet};
use protocol::time::Span;

use crate::bus::{StopReason, TestBus};

/// The listening time: more than two intervals of heartbeats.
pub const LISTEN_TIME: Span = Span::from_millis(600);

/// The cells, gateways and damaged frames that a survey found.
#[derive(Clone, Debug, Default)]
pub struct Survey {
    /// The senders of each node id.
    pub cells: BTreeMap<CellId, NodeSenders>,
    /// The first frame that only a gateway sends, if one came.
    pub gateway: Option<String>,
    /// Frames under the identifiers of a node id that are not packets.
    damaged: BTreeMap<CellId, DamagedFrames>,
}

/// Frames of one node id that are not packets.
#[derive(Clone, Debug)]
struct DamagedFrames {
    count: usize,
    /// The identifier of the first such frame, and the first frames with that identifier.
    id: Id,
    frames: Vec<Frame>,
    /// The reason why the first frame is not a packet; `None` while further segments may come.
    fault: Option<String>,
}

/// The senders that use a node id.
#[derive(Clone, Debug, Default)]
pub struct NodeSenders {
    /// The serial numbers in the heartbeats of this node id.
    pub serials: BTreeSet<u32>,
    /// The format of the frames; `None` before the first packet.
    pub format: Option<Format>,
}

impl Survey {
    /// Listens on the bus for [`LISTEN_TIME`], and returns the cells and gateways that send.
    ///
    /// # Errors
    /// Returns [`StopReason`] if the bus fails, or if the test is interrupted.
    pub fn listen(bus: &mut dyn TestBus, name: &str) -> Result<Self, StopReason> {
        let until = bus.now() + LISTEN_TIME;
        let mut decoder = Decoder::new(None);
        let mut survey = Self::default();
        while bus.now() < until {
            let Some(seen) = bus.receive(until)? else { continue };
            let Ok(id) = packet::data_frame_id(&seen.frame) else { continue };
            let message = match decoder.decode(seen.at, name, &seen.frame) {
                Decoded::Message(message) => message,
                // Frames before the first packet may belong to other devices.
                Decoded::Damaged { fault, .. } | Decoded::Foreign(ForeignReason::Data(fault)) => {
                    survey.note_damaged(id, &seen.frame, Some(fault.to_string()));
                    continue;
                }
                Decoded::Meaningless { error, .. } => {
                    survey.note_damaged(id, &seen.frame, Some(error.to_string()));
                    continue;
                }
                Decoded::Segment { .. } => {
                    survey.note_damaged(id, &seen.frame, None);
                    continue;
                }
                Decoded::Foreign(_) | Decoded::Wire(..) => continue,
            };
            let Some(cell) = id.sender() else {
                survey.gateway.get_or_insert_with(|| seen.frame.to_string());
                continue;
            };
            let present = survey.cells.entry(cell).or_default();
            present.format = Some(seen.frame.format());
            if let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = message {
                present.serials.insert(beat.serial);
            }
        }
        Ok(survey)
    }

    /// Counts a frame that is not a packet, or a segment that waits for others.
    fn note_damaged(&mut self, id: Id, frame: &Frame, fault: Option<String>) {
        const MAX_KEPT_FRAMES: usize = 4;
        let Some(cell) = id.sender() else { return };
        let new = || DamagedFrames { count: 0, id, frames: Vec::new(), fault: None };
        let damaged = self.damaged.entry(cell).or_insert_with(new);
        damaged.count += 1;
        damaged.fault = damaged.fault.take().or(fault);
        if damaged.id == id && damaged.frames.len() < MAX_KEPT_FRAMES {
            damaged.frames.push(*frame);
        }
    }

    /// Checks that the cell can be tested on this bus, and returns the format to use. Other cells are allowed if they
    /// are `tolerated`.
    ///
    /// # Errors
    /// Returns the reason, in one line, why the cell cannot be tested.
    pub fn check_cell(
        &self,
        cell: CellId,
        name: &str,
        asked: Option<Format>,
        tolerated: bool,
    ) -> Result<Format, String> {
        if let Some(frame) = &self.gateway {
            return Err(format!(
                "a gateway sends on {name} (frame {frame}): stop it, because the test needs the cell for \
                 itself"
            ));
        }
        let others: Vec<_> =
            self.cells.keys().filter(|other| **other != cell).map(ToString::to_string).collect();
        let Some(present) = self.cells.get(&cell) else {
            if let Some(damaged) = self.damaged.get(&cell) {
                return Err(format!("cell {cell} on {name} fails requirement SEND-1: {damaged}"));
            }
            let there = if others.is_empty() {
                "and no other cell sends there".to_owned()
            } else {
                format!("but these cells do: {}", others.join(", "))
            };
            return Err(format!(
                "cell {cell} sends nothing on {name}, {there}; switch the cell on, or give its actual node id"
            ));
        };
        if present.serials.len() > 1 {
            let serials: Vec<_> = present.serials.iter().map(ToString::to_string).collect();
            return Err(format!(
                "{} cells send as node {cell} on {name}, with the serial numbers {}: remove all but one",
                serials.len(),
                serials.join(" and ")
            ));
        }
        if !others.is_empty() && !tolerated {
            return Err(format!(
                "other cells are on {name}: {}; the test would send joints and halt messages to them too: \
                 disconnect them, or use --others-will-stop",
                others.join(", ")
            ));
        }
        match (present.format, asked) {
            (Some(sent), Some(asked)) if sent != asked => Err(format!(
                "cell {cell} sends {} frames on {name}, not {}: use --format {}",
                sent.name(),
                asked.name(),
                sent.name()
            )),
            (sent, asked) => Ok(asked.or(sent).unwrap_or(Format::Fd)),
        }
    }
}

impl DamagedFrames {
    /// Returns a description of the common implementation mistake that explains the frames, if there is one.
    fn likely_mistake(&self) -> Option<&'static str> {
        let bytes = |frames: &[&Frame]| -> Vec<u8> {
            frames.iter().flat_map(|frame| frame.data()).copied().collect()
        };
        let pairs: Vec<_> = self.frames.iter().zip(self.frames.iter().skip(1)).collect();
        let whole: Vec<_> = match self.frames.first()?.format() {
            Format::Fd => self.frames.iter().map(|frame| bytes(&[frame])).collect(),
            Format::Classic => {
                let mut swapped = pairs.iter().map(|(one, other)| bytes(&[other, one]));
                if swapped.any(|bytes| Packet::decode(self.id, &bytes).is_ok()) {
                    return Some("the cell sends the segments in the wrong order");
                }
                pairs.iter().map(|(one, other)| bytes(&[one, other])).collect()
            }
        };
        let (low_first, high_first) = (self.id.to_bits().to_le_bytes(), self.id.to_bits().to_be_bytes());
        whole.iter().find_map(|bytes| {
            let (body, crc) = bytes.split_last_chunk()?;
            let of = |id: &[u8]| packet::crc16(&[id, body].concat());
            let mistakes = [
                (of(&low_first).swap_bytes(), "the cell sends the CRC with the high byte first"),
                (of(&[]), "the cell computes the CRC without the identifier"),
                (of(&high_first), "the cell computes the CRC with the high byte of the identifier first"),
            ];
            let is_so = |(crc_of_it, _): &(u16, _)| *crc_of_it == u16::from_le_bytes(*crc);
            mistakes.into_iter().find(is_so).map(|(_, mistake)| mistake)
        })
    }
}

impl core::fmt::Display for DamagedFrames {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        let frames: Vec<_> = self.frames.iter().map(ToString::to_string).collect();
        let fault = self.fault.as_deref().unwrap_or("the other segments of the packet are missing");
        write!(
            f,
            "none of {} frames is a valid packet, for example {}: {fault}",
            self.count,
            frames.join(" ")
        )?;
        if let Some(mistake) = self.likely_mistake() {
            write!(f, "; {mistake}")?;
        }
        f.write_str("; docs/reference/protocol.md describes the layout, with examples")
    }
}
