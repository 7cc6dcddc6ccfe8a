//! Which frames a socket wants, by the rule of the kernel's `CAN_RAW`.

use crate::can::{ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK};
use crate::id::{Id, Kind};
use crate::port::LinkId;

/// A frame passes when `identifier & mask == id & mask`; with [`Filter::INVERTED`] in `id`, when not.
///
/// Both words hold the flags [`EXTENDED`] and [`REMOTE`] above the identifier. A socket receives a frame
/// once when any of its filters lets it pass; with no filters at all, nothing. Two words of 32 bits, like
/// `struct can_filter`.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct Filter {
    /// What the identifier is compared with.
    pub id: u32,
    /// Which bits of it count.
    pub mask: u32,
}

impl Filter {
    /// Every data and remote frame.
    pub const ALL: Self = Self { id: 0, mask: 0 };
    /// In `id`: what matches does not pass, and the rest does (`CAN_INV_FILTER`).
    pub const INVERTED: u32 = ERROR;
    /// The mask that makes a filter of one 11-bit identifier exact, so that it costs the kernel nothing.
    pub const EXACT_MASK: u32 = STANDARD_MASK | EXTENDED | REMOTE;
    /// The most that a socket may have (the kernel's `CAN_RAW_FILTER_MAX`).
    pub const MAX: usize = 512;

    /// Exactly the data frames with this identifier: the fast path.
    #[must_use]
    pub const fn exact(id: Id) -> Self {
        Self { id: id.to_bits() as u32, mask: Self::EXACT_MASK }
    }

    /// The data frames of a kind, whatever their node.
    #[must_use]
    pub const fn kind(kind: Kind) -> Self {
        Self { id: Id { kind, node: 0 }.to_bits() as u32, mask: Self::EXACT_MASK & !0xFF }
    }

    /// Exactly the data frames of one direction of a simulated wire.
    #[must_use]
    pub const fn link_id(link_id: LinkId) -> Self {
        Self { id: link_id.raw_id(), mask: EXTENDED_MASK | EXTENDED | REMOTE }
    }

    /// What this one does not let pass, and only that.
    #[must_use]
    pub const fn inverted(self) -> Self {
        Self { id: self.id ^ Self::INVERTED, mask: self.mask }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::id::Command;

    #[test]
    fn an_exact_filter_is_what_the_kernel_hashes() {
        let filter = Filter::exact(Id::command(Command::Joints));
        assert_eq!(filter, Filter { id: 0x001, mask: 0xC000_07FF });
        assert_eq!(filter.inverted().inverted(), filter);
        assert_eq!(Filter::kind(Kind::Network), Filter { id: 0x400, mask: 0xC000_0700 });
        let link_id = LinkId { wire: 3, back: true };
        assert_eq!(Filter::link_id(link_id), Filter { id: 0x9000_0007, mask: 0xDFFF_FFFF });
    }
}
