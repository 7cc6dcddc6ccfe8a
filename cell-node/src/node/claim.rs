//! A cell's address claim: claimed, defended, and stated with each heartbeat.

use protocol::message::{Heartbeat, NetworkPage, Refused, State};
use protocol::time::{Micros, Span};

use super::Node;
use crate::identity::Identity;
use crate::phase;

/// From one heartbeat to the next.
pub const HEARTBEAT: Span = Span::from_millis(250);
/// How long a new cell listens at least for another one with its node id.
pub const CLAIM: Span = Span::from_millis(250);
/// First heartbeats are spread over this time by serial number: two cells with one node id that are switched
/// on together would otherwise send different data with one identifier in the same bit time.
const FIRST_WORD: Span = Span::from_millis(64);
/// The shortest time between two answers to another cell with our node id.
const DEFEND: Span = Span::from_millis(10);

/// The stage of an address claim.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Claim {
    /// Nothing has been sent yet.
    Unsent,
    /// The claim has been sent; the cell listens whether another one owns the node id.
    Sent,
    /// The cell owns the node id.
    Settled,
}

/// The address claim, and the heartbeats that carry it.
#[derive(Debug)]
pub(super) struct AddressClaim {
    pub(super) stage: Claim,
    pub(super) next_heartbeat: Micros,
    /// A sync requested a heartbeat, which waits for the present epoch's end.
    pub(super) sync_waits: bool,
    /// When the node id was defended last.
    defended: Option<Micros>,
    /// The serial number of the cell that owns the node id already.
    pub(super) taken: Option<u32>,
}

impl AddressClaim {
    /// A claim that starts now; without a node id it never starts.
    pub(super) fn new(identity: Identity, now: Micros) -> Self {
        let wait = phase::by_serial(FIRST_WORD, identity.serial);
        let next_heartbeat = identity.cell.map_or(Micros(u64::MAX), |_| now + wait);
        Self { stage: Claim::Unsent, next_heartbeat, sync_waits: false, defended: None, taken: None }
    }

    /// Returns true if this cell owns the node id.
    pub(super) fn is_settled(&self) -> bool {
        self.stage == Claim::Settled
    }
}

impl Node {
    /// Sends the heartbeat that is due: the first is the address claim, with the next the cell owns the node id.
    pub(super) fn claim_in_time(&mut self, now: Micros) {
        let Some(cell) = self.identity.cell.filter(|_| now >= self.claim.next_heartbeat) else { return };
        if self.claim.stage == Claim::Unsent {
            self.claim.stage = Claim::Sent;
            self.claim.next_heartbeat = now + CLAIM + phase::by_number(HEARTBEAT, cell);
            return self.push_heartbeat();
        }
        self.claim.stage = Claim::Settled;
        self.regular_heartbeat(now);
    }

    /// One of four a second, with what has changed.
    pub(super) fn regular_heartbeat(&mut self, now: Micros) {
        self.push_heartbeat();
        self.beat_network(now);
        let pages = self.sensing.beat(now);
        self.push_sensors(pages);
        self.beat_zero();
        self.claim.next_heartbeat = phase::next(self.claim.next_heartbeat, HEARTBEAT, now);
    }

    /// Another cell sent with our node id. While we claim it we give way, unless the other claims it
    /// too and has the larger serial number. Once we own it we defend it, but only against claims:
    /// two settled cells would answer each other for ever.
    pub(super) fn hear_own_number(&mut self, now: Micros, page: &NetworkPage) {
        self.flags = self.flags.with(State::DUPLICATE, true);
        let other = if let NetworkPage::Heartbeat(other) = page { Some(other) } else { None };
        let claims = other.is_some_and(|other| other.state.has(State::CLAIMING));
        let stays = claims && other.is_some_and(|other| other.serial > self.identity.serial);
        if !self.claim.is_settled() && !stays {
            self.claim.taken = Some(other.map_or(0, |other| other.serial));
        } else if claims && self.claim.defended.is_none_or(|at| now.since(at) >= DEFEND) {
            self.claim.defended = Some(now);
            self.push_heartbeat();
        }
    }

    /// The cell's state: its flags, and what can be derived.
    pub(super) fn state(&self) -> State {
        let in_use = self.configuration.in_use();
        self.flags
            .with(State::CONFIGURED, in_use.is_some())
            .with(State::ACTIVE, self.active)
            .with(State::CLAIMING, !self.claim.is_settled())
            .with_joint(in_use.map_or(0, |in_use| in_use.parameters.joint))
    }

    pub(super) fn push_heartbeat(&mut self) {
        let Refused { length, crc, foreign, meaning, incomplete, stimuli } = self.receiver.refused;
        let rejected =
            [length, crc, foreign, meaning, incomplete, stimuli].into_iter().fold(0, u16::wrapping_add);
        let heartbeat = Heartbeat {
            serial: self.identity.serial,
            configuration: self.configuration.hash(),
            sent: 0, // filled in when it goes out
            rejected,
            state: self.state(),
        };
        self.flags = self.flags.with(State::SATURATED, false).with(State::DUPLICATE, false);
        self.push_network(NetworkPage::Heartbeat(heartbeat));
    }
}
