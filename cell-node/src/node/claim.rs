//! A cell's number: claimed, defended, and told with each heartbeat.

use protocol::message::{Heartbeat, NetworkPage, Refused, State};
use protocol::time::{Micros, Span};

use super::{Node, Summing};
use crate::identity::Identity;
use crate::phase;

/// From one heartbeat to the next.
pub const HEARTBEAT: Span = Span::from_millis(250);
/// How long a new cell listens at least for another one under its number.
pub const CLAIM: Span = Span::from_millis(250);
/// First words are spread over this time by serial number: two cells under one number that are switched
/// on together would else send different data under one identifier in the same bit time.
const FIRST_WORD: Span = Span::from_millis(64);
/// The shortest time between two answers to another cell under our number.
const DEFEND: Span = Span::from_millis(10);

/// How far a cell is with claiming its number.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
pub(super) enum Claim {
    /// It has not said anything yet.
    Unsaid,
    /// It has claimed the number and listens whether somebody else has it.
    Said,
    /// The number is its own.
    Settled,
}

/// The claim of a number, and the heartbeats that tell it.
#[derive(Debug)]
pub(super) struct AddressClaim {
    pub(super) stage: Claim,
    pub(super) next_heartbeat: Micros,
    /// A sync asks for a heartbeat, which waits for the present epoch's end.
    pub(super) sync_waits: bool,
    /// When another cell was told last that the number is taken.
    defended: Option<Micros>,
    /// The serial number of the cell that has the number already.
    pub(super) taken: Option<u32>,
}

impl AddressClaim {
    /// The number will be claimed; never while there is none.
    pub(super) fn new(identity: Identity, now: Micros) -> Self {
        let wait = phase::by_serial(FIRST_WORD, identity.serial);
        let next_heartbeat = identity.cell.map_or(Micros(u64::MAX), |_| now + wait);
        Self { stage: Claim::Unsaid, next_heartbeat, sync_waits: false, defended: None, taken: None }
    }

    /// Whether the number is this cell's own.
    pub(super) fn is_settled(&self) -> bool {
        self.stage == Claim::Settled
    }
}

impl Node {
    /// Says the heartbeat that is due: the first one claims the number, and the next one has it.
    pub(super) fn claim_in_time(&mut self, now: Micros) {
        let Some(cell) = self.identity.cell.filter(|_| now >= self.claim.next_heartbeat) else { return };
        if self.claim.stage == Claim::Unsaid {
            self.claim.stage = Claim::Said;
            self.claim.next_heartbeat = now + CLAIM + phase::by_number(HEARTBEAT, cell);
            return self.push_heartbeat();
        }
        self.claim.stage = Claim::Settled;
        self.regular_heartbeat(now);
    }

    /// One of four a second, with what has changed.
    pub(super) fn regular_heartbeat(&mut self, now: Micros) {
        self.push_heartbeat();
        let Summing { network, report, .. } = &mut self.summing;
        if network.exists() {
            // Another round alone is no news for anybody else.
            report.due |= report.round != network.round();
            self.tell_tree(now);
            if self.summing.network.ports_changed(now) {
                self.push_ports(now);
            }
        }
        let pages = self.sensing.beat(now);
        self.push_sensors(pages);
        self.claim.next_heartbeat = phase::next(self.claim.next_heartbeat, HEARTBEAT, now);
    }

    /// Somebody else spoke under our number. While we claim it we give way, unless the other claims it
    /// too and has the greater serial number; once it is ours we tell those who claim it, and only those:
    /// two settled cells would go on telling each other for ever.
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

    /// How the cell is: its flags, and what can be derived.
    pub(super) fn state(&self) -> State {
        let in_use = self.configuration.in_use.as_ref();
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
