//! Reassembly of the cell's frames into packets, and the checks that apply to every packet.

use protocol::can::{BIT_RATE_SWITCH, Format};
use protocol::id::Id;
use protocol::message::{Heartbeat, Message, State};
use protocol::packet::{self, Lengths, Packet, PacketError, Reassembler, Reassembly};
use protocol::time::{Micros, Span};

use super::{ANSWER_TIMEOUT, CellPacket, SILENCE_TIMEOUT, Session};
use crate::bus::{ObservedFrame, StopReason};

impl Session<'_> {
    /// Processes the next frame, and returns it, or `None` if no frame arrives until then.
    pub(super) fn process_next_frame(&mut self, until: Micros) -> Result<Option<ObservedFrame>, StopReason> {
        let Some(seen) = self.bus.receive(until)? else {
            self.check_waiting_segments(self.bus.now());
            self.check_time_limits()?;
            return Ok(None);
        };
        self.check_waiting_segments(seen.at);
        if seen.own {
            self.log.frames.push(seen);
            let joints = (self.known.hash != Some(0)).then_some(self.known.joints);
            self.life.accounts.count_own_frame(&seen, self.cell, self.format, joints);
            return Ok(Some(seen));
        }
        self.check_time_limits()?;
        let Ok(id) = packet::data_frame_id(&seen.frame) else { return Ok(Some(seen)) };
        if id.sender().is_none() && !self.clock.finishing {
            return Err(StopReason::Gateway(seen.frame.to_string()));
        }
        if id.node == self.cell.get() {
            self.log.frames.push(seen);
            self.clock.last = seen.at;
            self.receive_cell_frame(seen, id);
        }
        Ok(Some(seen))
    }

    fn check_time_limits(&self) -> Result<(), StopReason> {
        let now = self.bus.now();
        if now >= self.clock.end {
            return Err(StopReason::Time);
        }
        let is_silent = now.elapsed_since(self.clock.last) > SILENCE_TIMEOUT && !self.known.may_be_silent;
        if is_silent { Err(StopReason::Silent) } else { Ok(()) }
    }

    /// Checks that no segment has waited too long for the others of its packet.
    fn check_waiting_segments(&mut self, now: Micros) {
        if self.held.is_some() {
            // It may be a part of the life that was cut off.
            return;
        }
        for place in 0..self.life.segments.len() {
            let Some((segments, Some(last))) = self.life.segments.get_mut(place) else { continue };
            if segments.is_waiting() && now.elapsed_since(last.at) > ANSWER_TIMEOUT {
                *segments = Reassembler::NONE;
                let frame = last.frame;
                if !self.life.note_packet_kind(place) {
                    continue;
                }
                self.check("SEND-1", false, || {
                    format!(
                        "frame {frame} is only a part of a packet: no other segment arrived within {} ms",
                        ANSWER_TIMEOUT.0 / 1_000
                    )
                });
            }
        }
    }

    /// Processes a frame under an identifier of the cell.
    pub(super) fn handle_cell_frame(&mut self, seen: ObservedFrame, id: Id) {
        let frame = &seen.frame;
        if frame.format() != self.format {
            self.check("SEND-1", false, || {
                format!(
                    "the cell must not send {} frames on this bus, but it sent one",
                    frame.format().name()
                )
            });
            return;
        }
        let packet = match self.format {
            Format::Fd => {
                let switches = frame.flags() & BIT_RATE_SWITCH != 0;
                self.check("SEND-1", switches, || {
                    format!("an FD frame must have the bit-rate switch (BRS), but {frame} does not have it")
                });
                Packet::from_fd(frame)
            }
            Format::Classic => {
                let Some((segments, last)) = self.life.segments.get_mut(id.kind as usize) else { return };
                let apart = last.replace(seen).map_or(Span(0), |last| seen.at.elapsed_since(last.at));
                self.clock.torn += usize::from(segments.is_waiting() && apart > Reassembler::max_gap(id));
                // Late segments are counted, but still belong together.
                match segments.push(Micros(0), id, Lengths::for_id(id), frame.data()) {
                    Ok(Reassembly::Waiting) => return,
                    Ok(Reassembly::Complete(packet)) => {
                        self.life.note_packet_kind(id.kind as usize);
                        Ok(packet)
                    }
                    // The previous segment is the end of a packet that began before the test.
                    Ok(Reassembly::Incomplete) if !self.life.note_packet_kind(id.kind as usize) => return,
                    Ok(Reassembly::Incomplete) => Err(PacketError::Incomplete),
                    Ok(Reassembly::Ambiguous) => Err(PacketError::Ambiguous),
                    Err(error) => Err(error),
                }
            }
        };
        let message = packet.map_err(|error| error.to_string()).and_then(|packet| {
            let message = Message::decode(&packet).map_err(|error| error.to_string())?;
            let is_clean = message.encode() == packet;
            if is_clean { Ok(message) } else { Err("an unused word or bit is not 0".to_owned()) }
        });
        match message {
            Ok(message) => {
                self.findings.count_passed("SEND-1");
                let heard = CellPacket { at: seen.at, message };
                self.packets.push(heard);
                self.check_packet(&heard);
            }
            Err(error) => {
                self.check("SEND-1", false, || format!("frame {frame} is not a valid packet: {error}"));
            }
        }
    }

    /// Checks the rules for every packet, and that a heartbeat has the number of packets sent before it.
    fn check_packet(&mut self, heard: &CellPacket) {
        self.life.accounts.count_cell_packet(&heard.message);
        if let Some((&Heartbeat { serial, sent, state, .. }, _)) = heard.heartbeat_and_epoch() {
            // The cell has been switched off and on.
            let begins = state.has(State::CLAIMING_NODE_ID) && !self.life.claiming;
            self.life.claiming = state.has(State::CLAIMING_NODE_ID);
            if begins {
                self.life.sent = None;
            }
            if let Some((last, packets)) = self.life.sent {
                let expected = last.wrapping_add(packets);
                self.check("BEAT-4", sent == expected, || {
                    format!(
                        "the counter 'sent' in a heartbeat must be {expected}, the number of packets \
                         received, but it is {sent}"
                    )
                });
            }
            self.life.sent = Some((sent, 0));
            let version = state.version();
            self.check("STATE-3", version == 1, || {
                format!("a heartbeat must have protocol version 1, but it has {version}")
            });
            if let Some(expected) = self.about.serial {
                self.check("ID-1", serial == expected, || {
                    format!("the serial number must stay {expected}, but it is {serial} in a heartbeat")
                });
            }
        }
        if let Some((_, packets)) = &mut self.life.sent {
            *packets = packets.wrapping_add(1);
        }
    }
}
