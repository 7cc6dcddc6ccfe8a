//! The state of the cell as far as the bench knows it, and the check that heartbeats report that state.

use protocol::message::{Message, NetworkPage, SkinSensors, State};
use protocol::parameters::{Abilities, Parameters};

use super::{Exchange, Session};

/// The identity and the abilities of the cell.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct CellAbilities {
    pub(crate) serial: Option<u32>,
    pub(crate) abilities: Abilities,
    /// True if the cell sends the network pages of a cell with ports.
    pub(crate) ports: bool,
    /// True if the cell has test mode.
    pub(crate) test_mode: bool,
    /// True if the cell can send sensor values without a request.
    pub(crate) sensing: bool,
    /// True if the cell can subtract a zero from its force sensor's readings.
    pub(crate) baseline: bool,
    /// True if the cell accepted a commit.
    pub(crate) committed: bool,
}

/// The present state of the cell; `None` means unknown.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct KnownCellState {
    pub(crate) hash: Option<u16>,
    /// The parameters in use, if this bench committed them.
    pub(crate) parameters: Option<Parameters>,
    /// The number of joints of the chain.
    pub(crate) joints: u8,
    pub(crate) test_mode: Option<bool>,
    pub(crate) halted: Option<bool>,
    pub(crate) active: Option<bool>,
    pub(crate) epoch: Option<u8>,
    /// True if sensors pages come without a request.
    pub(crate) senses: bool,
    /// True if the cell gave way or is off.
    pub(crate) may_be_silent: bool,
    /// The last epoch that was sent.
    pub(crate) last_epoch: u8,
    /// The staged parameters.
    pub(crate) staged: Option<Parameters>,
    /// The latched sensor values.
    pub(crate) skin: Option<SkinSensors>,
    /// True if the cell subtracts a zero, and so does not compute with the latched values.
    pub(crate) adapts: bool,
    /// The sensor values that the next joints latch.
    pub(crate) pending: Option<SkinSensors>,
}

impl KnownCellState {
    /// Returns the requirement that forbids the cell to send this packet unrequested.
    pub(crate) fn violated_requirement(&self, message: &Message) -> Option<&'static str> {
        match message {
            Message::Network { page: NetworkPage::Received(_) | NetworkPage::Rejected(_), .. } => {
                Some("CMD-4")
            }
            Message::Network { .. } => None,
            Message::Sensors { .. } if self.senses => None,
            Message::Torque { .. } => Some("JOINTS-6"),
            Message::Sum { .. }
            | Message::Sensors { .. }
            | Message::Configured { .. }
            | Message::Halt
            | Message::Joints { .. }
            | Message::Sync
            | Message::Resume
            | Message::Report
            | Message::Configure { .. }
            | Message::Stimulus { .. } => Some("SEND-1"),
        }
    }
}

impl Session<'_> {
    /// Checks the state that the heartbeat to a sync reports.
    pub(super) fn check_reported_state(&mut self, exchange: &Exchange) {
        let Some((beat, epoch)) = exchange.beat else { return };
        let (state, known) = (beat.state, self.known);
        let bits = [
            ("HALTED", State::HALTED, known.halted, "STATE-3"),
            ("TEST_MODE", State::TEST_MODE, known.test_mode, "STATE-3"),
            ("CLAIMING", State::CLAIMING_NODE_ID, Some(false), "STATE-3"),
            ("DUPLICATE", State::DUPLICATE, Some(false), "STATE-2"),
            (
                "FLASH_DAMAGED",
                State::FLASH_DAMAGED,
                known.hash.filter(|hash| *hash != 0).map(|_| false),
                "STATE-3",
            ),
            ("CONFIGURED", State::CONFIGURED, known.hash.map(|hash| hash != 0), "STATE-3"),
            ("ACTIVE", State::ACTIVE, known.active, "STATE-1"),
        ];
        for (name, bit, expected, id) in bits {
            if let Some(expected) = expected {
                let is_set = state.has(bit);
                self.check(id, is_set == expected, || {
                    format!(
                        "the bit {name} is {}set in state {:04X}, but the opposite was expected",
                        if is_set { "" } else { "not " },
                        state.0
                    )
                });
            }
        }
        if let Some(parameters) = known.parameters {
            let expected = u16::from(parameters.joint);
            self.check("STATE-3", state.joint() == expected, || {
                format!(
                    "the joint of the cell is {} in state {:04X}, but {expected} was expected",
                    state.joint(),
                    state.0
                )
            });
        }
        if let Some(hash) = known.hash {
            self.check("STATE-3", beat.configuration == hash, || {
                format!(
                    "a heartbeat reports configuration {:04X}, but it must report {hash:04X}",
                    beat.configuration
                )
            });
        }
        if let Some(expected) = known.epoch {
            self.check("JOINTS-3", epoch.0 == expected, || {
                format!(
                    "a heartbeat must have the epoch of the last accepted joints message, {expected}, but it \
                     has {epoch}"
                )
            });
        }
    }
}
