//! The state word of a cell.

use super::VERSION;

/// The state word of a cell: flags in bits 0 to 7, the joint that moves the cell in bits 8 to 11, and the protocol
/// version in bits 12 to 15.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct State(pub u16);

impl State {
    /// The cell has a configuration and computes torques.
    pub const CONFIGURED: Self = Self(1);
    /// The cell is in contact.
    pub const ACTIVE: Self = Self(1 << 1);
    /// The cell was halted and waits for a resume.
    pub const HALTED: Self = Self(1 << 2);
    /// The contents of the cell's flash are damaged and not used.
    pub const FLASH_DAMAGED: Self = Self(1 << 3);
    /// The cell has received frames from another cell with the same node id.
    pub const DUPLICATE: Self = Self(1 << 4);
    /// The cell uses stimuli instead of its sensors.
    pub const TEST_MODE: Self = Self(1 << 5);
    /// A torque has saturated since the last heartbeat.
    pub const SATURATED: Self = Self(1 << 6);
    /// The cell has just started and checks whether another cell uses its node id.
    pub const CLAIMING_NODE_ID: Self = Self(1 << 7);

    /// Each flag and its name in all output.
    pub const NAMES: [(Self, &'static str); 8] = [
        (Self::CONFIGURED, "configured"),
        (Self::ACTIVE, "active"),
        (Self::HALTED, "halted"),
        (Self::FLASH_DAMAGED, "flash-damaged"),
        (Self::DUPLICATE, "duplicate"),
        (Self::TEST_MODE, "test-mode"),
        (Self::SATURATED, "saturated"),
        (Self::CLAIMING_NODE_ID, "claiming"),
    ];

    /// Returns the names of the flags that are set.
    pub fn flag_names(self) -> impl Iterator<Item = &'static str> {
        Self::NAMES.into_iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| name)
    }

    /// Returns true if all of these bits are set.
    #[must_use]
    pub const fn has(self, bits: Self) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// Returns a copy with these bits set or cleared.
    #[must_use]
    pub const fn with_flags(self, bits: Self, set: bool) -> Self {
        if set { Self(self.0 | bits.0) } else { Self(self.0 & !bits.0) }
    }

    /// Returns a copy with this joint, and with the protocol version of this crate.
    #[must_use]
    pub const fn with_joint(self, joint: u8) -> Self {
        Self((self.0 & 0xFF) | (((joint & 0xF) as u16) << 8) | ((VERSION as u16) << 12))
    }

    /// Returns the joint that moves the cell; 0 while it is not configured.
    #[must_use]
    pub const fn joint(self) -> u16 {
        (self.0 >> 8) & 0xF
    }

    /// Returns the protocol version of the cell.
    #[must_use]
    pub const fn version(self) -> u16 {
        self.0 >> 12
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_state_word_keeps_its_parts_apart() {
        let state = State::CONFIGURED.with_flags(State::ACTIVE, true).with_joint(5);
        assert!(state.has(State::CONFIGURED) && state.has(State::ACTIVE) && !state.has(State::HALTED));
        assert_eq!((state.joint(), state.version()), (5, 1));
        assert_eq!(state.with_flags(State::ACTIVE, false).0, 0x1501);
    }
}
