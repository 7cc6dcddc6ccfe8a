//! How a cell is, in one word.

use super::VERSION;

/// How a cell is: one bit each, the joint in bits 8 to 11, the protocol version in bits 12 to 15.
#[derive(Clone, Copy, Debug, Default, Eq, PartialEq)]
pub struct State(pub u16);

impl State {
    /// It has a configuration and computes with it.
    pub const CONFIGURED: Self = Self(1);
    /// It feels a contact.
    pub const ACTIVE: Self = Self(1 << 1);
    /// It was halted and waits for a resume.
    pub const HALTED: Self = Self(1 << 2);
    /// Its flash was damaged; what was in it is not used.
    pub const FLASH_DAMAGED: Self = Self(1 << 3);
    /// It has received frames of another cell with its node id.
    pub const DUPLICATE: Self = Self(1 << 4);
    /// It obeys stimuli instead of measuring.
    pub const TEST_MODE: Self = Self(1 << 5);
    /// A torque saturated since the last heartbeat.
    pub const SATURATED: Self = Self(1 << 6);
    /// It has just started and listens for another cell under its number.
    pub const CLAIMING: Self = Self(1 << 7);

    /// The bits and their names, as everything prints them.
    pub const NAMES: [(Self, &'static str); 8] = [
        (Self::CONFIGURED, "configured"),
        (Self::ACTIVE, "active"),
        (Self::HALTED, "halted"),
        (Self::FLASH_DAMAGED, "flash-damaged"),
        (Self::DUPLICATE, "duplicate"),
        (Self::TEST_MODE, "test-mode"),
        (Self::SATURATED, "saturated"),
        (Self::CLAIMING, "claiming"),
    ];

    /// The names of the bits that are set.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        Self::NAMES.into_iter().filter(move |(bit, _)| self.has(*bit)).map(|(_, name)| name)
    }

    /// Whether all of these bits are set.
    #[must_use]
    pub const fn has(self, bits: Self) -> bool {
        self.0 & bits.0 == bits.0
    }

    /// The same with these bits set or not.
    #[must_use]
    pub const fn with(self, bits: Self, set: bool) -> Self {
        if set { Self(self.0 | bits.0) } else { Self(self.0 & !bits.0) }
    }

    /// The same with the joint and this protocol's version.
    #[must_use]
    pub const fn with_joint(self, joint: u8) -> Self {
        Self((self.0 & 0xFF) | (((joint & 0xF) as u16) << 8) | ((VERSION as u16) << 12))
    }

    /// The joint that moves the cell; 0 while it is not configured.
    #[must_use]
    pub const fn joint(self) -> u16 {
        (self.0 >> 8) & 0xF
    }

    /// The version of the protocol that the cell uses.
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
        let state = State::CONFIGURED.with(State::ACTIVE, true).with_joint(5);
        assert!(state.has(State::CONFIGURED) && state.has(State::ACTIVE) && !state.has(State::HALTED));
        assert_eq!((state.joint(), state.version()), (5, 1));
        assert_eq!(state.with(State::ACTIVE, false).0, 0x1501);
    }
}
