//! The part of the test's state that belongs to one life of the cell, that is, from one start to the next.
//!
//! A restart replaces this state as a whole. Between the command of a restart and the first heartbeat with CLAIMING, a
//! frame does not show to which life it belongs. Frames are therefore held until that heartbeat is complete. All frames
//! before it belong to the former life, which may have been cut off in the middle of a packet.

use protocol::can::{Format, Frame};
use protocol::id::{Id, Kind};
use protocol::message::{Heartbeat, Message, NetworkPage, State};
use protocol::packet::{Length, Lengths, Packet, Reassembler, Reassembly};
use protocol::time::Micros;

use super::Session;
use super::accounts::PacketAccounts;
use crate::bus::{ObservedFrame, StopReason};

/// The state of the test from one start of the cell to the next.
#[derive(Debug, Default)]
pub(super) struct CellLife {
    /// The time of the cell's first heartbeat with CLAIMING, after a restart.
    pub(super) claimed: Option<Micros>,
    /// Segments that wait for the others of their packet, by kind of packet, with the last frame received.
    pub(super) segments: [(Reassembler, Option<ObservedFrame>); 8],
    /// True for each kind of packet of which a complete packet has come. The test may have begun in the middle of the
    /// first one.
    pub(super) joined: [bool; 8],
    /// The bench's counts of packets.
    pub(super) accounts: PacketAccounts,
    /// The field *sent* of the last heartbeat, and the number of packets since that heartbeat.
    pub(super) sent: Option<(u16, u16)>,
    /// True if CLAIMING is set in the last heartbeat.
    pub(super) claiming: bool,
    /// True if the last torque was saturated.
    pub(super) saturated: bool,
    /// The time of the last regular heartbeat.
    pub(super) regular: Option<Micros>,
}

impl CellLife {
    /// Returns the state for a life that begins with a heartbeat at this time. Waiting segments of the bench's own
    /// packets are kept, because they were on the bus.
    fn after_restart(former: Self, claimed: Micros) -> Self {
        let accounts = former.accounts.after_cell_restart();
        Self { claimed: Some(claimed), joined: [true; 8], accounts, ..Self::default() }
    }

    /// Notes that a complete packet of a kind has come. Returns true if one had come before.
    pub(super) fn note_packet_kind(&mut self, place: usize) -> bool {
        self.joined.get_mut(place).is_none_or(|joined| core::mem::replace(joined, true))
    }

    /// Returns true if a segment waits for others.
    pub(super) fn has_waiting_segment(&self) -> bool {
        self.segments.iter().any(|(segments, _)| segments.is_waiting())
    }
}

impl Session<'_> {
    /// Begins to switch the cell off and on.
    pub(crate) fn begin_restart(&mut self) -> Result<(), StopReason> {
        self.bus.begin_restart()?;
        self.held = Some(Vec::new());
        self.life.claimed = None;
        Ok(())
    }

    /// Returns true while the command of the restart is running.
    pub(crate) fn is_restarting(&mut self) -> Result<bool, StopReason> {
        self.bus.is_restarting()
    }

    /// Ends the wait for the first heartbeat after a restart, and processes the held frames.
    pub(crate) fn end_restart(&mut self) {
        for (seen, id) in self.held.take().unwrap_or_default() {
            self.handle_cell_frame(seen, id);
        }
    }

    /// Returns the time of the first heartbeat with CLAIMING in the present life, after a restart.
    pub(crate) const fn first_claim_time(&self) -> Option<Micros> {
        self.life.claimed
    }

    /// Processes a frame of the cell, or holds it while a restart is in progress.
    pub(super) fn receive_cell_frame(&mut self, seen: ObservedFrame, id: Id) {
        let Some(held) = &mut self.held else { return self.handle_cell_frame(seen, id) };
        held.push((seen, id));
        let Some((beat, places)) = completed_claim(held, self.format) else { return };
        // A contact that bounces starts the cell more than once; an answer to another claim is not a start.
        if self.life.claimed.is_some() && beat.sent != 0 {
            return;
        }
        let (mut of_claim, mut before) = (Vec::new(), Vec::new());
        for (place, frame) in core::mem::take(held).into_iter().enumerate() {
            if places.contains(&place) { of_claim.push(frame) } else { before.push(frame) }
        }
        for (seen, id) in before {
            self.handle_cell_frame(seen, id);
        }
        self.life = CellLife::after_restart(core::mem::take(&mut self.life), seen.at);
        for (seen, id) in of_claim {
            self.handle_cell_frame(seen, id);
        }
    }
}

/// Returns the heartbeat with CLAIMING that the last frame completes, if there is one, and the indices of its frames.
fn completed_claim(held: &[(ObservedFrame, Id)], format: Format) -> Option<(Heartbeat, Vec<usize>)> {
    let (last, id) = held.last()?;
    if id.kind != Kind::Network || last.frame.format() != format {
        return None;
    }
    let (packet, places) = match format {
        Format::Fd => (Packet::from_fd(&last.frame).ok()?, vec![held.len() - 1]),
        Format::Classic => {
            let is_of_it =
                |(_, (seen, of)): &(usize, &(ObservedFrame, Id))| of == id && seen.frame.format() == format;
            let of_it: Vec<_> = held.iter().enumerate().filter(is_of_it).collect();
            // Pages have six words.
            let of_it = of_it.get(of_it.len().checked_sub(Length::Six.segments())?..)?;
            let frames = of_it.iter().map(|(_, (seen, _))| &seen.frame);
            (assemble_packet(*id, frames)?, of_it.iter().map(|(place, _)| *place).collect())
        }
    };
    let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = Message::decode(&packet).ok()? else {
        return None;
    };
    beat.state.has(State::CLAIMING_NODE_ID).then_some((beat, places))
}

/// Returns the packet that these segments form.
fn assemble_packet<'a>(id: Id, frames: impl Iterator<Item = &'a Frame>) -> Option<Packet> {
    let mut segments = Reassembler::NONE;
    let last = frames.map(|frame| segments.push(Micros(0), id, Lengths::for_id(id), frame.data())).last()?;
    if let Ok(Reassembly::Complete(packet)) = last { Some(packet) } else { None }
}
