//! The state of the test that belongs to one life of the cell, from a start to the next.
//!
//! A restart replaces it as a whole. Between the command of a restart and the first heartbeat with CLAIMING nothing shows
//! to which life a frame belongs, so frames are held until that heartbeat is complete: all frames before it are of the
//! former life, which may have been cut off in the middle of a packet.

use protocol::can::{Format, Frame};
use protocol::id::{Id, Kind};
use protocol::message::{Heartbeat, Message, NetworkPage, State};
use protocol::packet::{Length, Lengths, Packet, Reassembly, Segment};
use protocol::time::Micros;

use super::Session;
use super::accounts::Accounts;
use crate::bus::{Seen, Stop};

/// State of the test about one life of the cell.
#[derive(Debug, Default)]
pub(super) struct Life {
    /// Time of its first heartbeat with CLAIMING, after a restart.
    pub(super) claimed: Option<Micros>,
    /// Segments that wait for the others, by kind, and the last one that came.
    pub(super) segments: [(Segment, Option<Seen>); 8],
    /// Kinds of which a packet came as a whole; the test may have begun in the middle of the first one.
    pub(super) joined: [bool; 8],
    /// Accounts of the bus.
    pub(super) accounts: Accounts,
    /// *sent* of the last heartbeat, and packets since.
    pub(super) sent: Option<(u16, u16)>,
    /// Flag of the last heartbeat: CLAIMING.
    pub(super) claiming: bool,
    /// The last torque was saturated.
    pub(super) saturated: bool,
    /// Time of the last heartbeat that nothing asked for.
    pub(super) regular: Option<Micros>,
}

impl Life {
    /// Returns the life that begins with a heartbeat of that time. The test's own packets continue: they were on the bus.
    fn after(former: Self, claimed: Micros) -> Self {
        let accounts = former.accounts.restarted();
        Self { claimed: Some(claimed), joined: [true; 8], accounts, ..Self::default() }
    }

    /// Notes that packets of a kind are received from their beginnings on; returns whether that was so before.
    pub(super) fn joins(&mut self, place: usize) -> bool {
        self.joined.get_mut(place).is_none_or(|joined| core::mem::replace(joined, true))
    }

    /// Returns whether a segment waits for others.
    pub(super) fn is_waiting(&self) -> bool {
        self.segments.iter().any(|(segments, _)| segments.is_waiting())
    }
}

impl Session<'_> {
    /// Begins to switch the cell off and on.
    pub(crate) fn begin_restart(&mut self) -> Result<(), Stop> {
        self.bus.begin_restart()?;
        self.held = Some(Vec::new());
        self.life.claimed = None;
        Ok(())
    }

    /// Returns whether the command of the restart is still running.
    pub(crate) fn is_restarting(&mut self) -> Result<bool, Stop> {
        self.bus.is_restarting()
    }

    /// Ends the wait for a new life: frames belong to the present one from here on.
    pub(crate) fn end_restart(&mut self) {
        for (seen, id) in self.held.take().unwrap_or_default() {
            self.take(seen, id);
        }
    }

    /// Returns when the first heartbeat with CLAIMING of the present life came, after a restart.
    pub(crate) const fn claimed(&self) -> Option<Micros> {
        self.life.claimed
    }

    /// Receives a frame of the cell.
    pub(super) fn receive(&mut self, seen: Seen, id: Id) {
        let Some(held) = &mut self.held else { return self.take(seen, id) };
        held.push((seen, id));
        let Some((beat, places)) = claim(held, self.format) else { return };
        // A contact that bounces starts the cell more than once; an answer to another claim is no start.
        if self.life.claimed.is_some() && beat.sent != 0 {
            return;
        }
        let (mut of_claim, mut before) = (Vec::new(), Vec::new());
        for (place, frame) in core::mem::take(held).into_iter().enumerate() {
            if places.contains(&place) { of_claim.push(frame) } else { before.push(frame) }
        }
        for (seen, id) in before {
            self.take(seen, id);
        }
        self.life = Life::after(core::mem::take(&mut self.life), seen.at);
        for (seen, id) in of_claim {
            self.take(seen, id);
        }
    }
}

/// Returns the heartbeat with CLAIMING that ends with the last frame, if one does, and the places of its frames.
fn claim(held: &[(Seen, Id)], format: Format) -> Option<(Heartbeat, Vec<usize>)> {
    let (last, id) = held.last()?;
    if id.kind != Kind::Network || last.frame.format() != format {
        return None;
    }
    let (packet, places) = match format {
        Format::Fd => (Packet::from_fd(&last.frame).ok()?, vec![held.len() - 1]),
        Format::Classic => {
            let is_of_it = |(_, (seen, of)): &(usize, &(Seen, Id))| of == id && seen.frame.format() == format;
            let of_it: Vec<_> = held.iter().enumerate().filter(is_of_it).collect();
            // Pages are of six words.
            let of_it = of_it.get(of_it.len().checked_sub(Length::Six.segments())?..)?;
            let frames = of_it.iter().map(|(_, (seen, _))| &seen.frame);
            (whole(*id, frames)?, of_it.iter().map(|(place, _)| *place).collect())
        }
    };
    let Message::Network { page: NetworkPage::Heartbeat(beat), .. } = Message::decode(&packet).ok()? else {
        return None;
    };
    beat.state.has(State::CLAIMING).then_some((beat, places))
}

/// Returns the packet that these segments are.
fn whole<'a>(id: Id, frames: impl Iterator<Item = &'a Frame>) -> Option<Packet> {
    let mut segments = Segment::NONE;
    let last = frames.map(|frame| segments.push(Micros(0), id, Lengths::of(id), frame.data())).last()?;
    if let Ok(Reassembly::Complete(packet)) = last { Some(packet) } else { None }
}
