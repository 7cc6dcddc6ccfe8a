//! Filters for received frames, with the semantics of the kernel's `CAN_RAW`.

use crate::can::{ERROR, EXTENDED, EXTENDED_MASK, REMOTE, STANDARD_MASK};
use crate::id::{Id, Kind};
use crate::port::LinkId;

/// A receive filter. A frame passes if `identifier & mask == id & mask`. A filter whose `id` contains
/// [`Filter::INVERTED_FLAG`] passes all other frames instead.
///
/// `id` and `mask` hold the flags [`EXTENDED`] and [`REMOTE`] above the identifier. A socket receives a frame once if
/// at least one of its filters passes the frame; a socket without filters receives nothing. The layout is that of
/// `struct can_filter`.
#[derive(Clone, Copy, Debug, Eq, Hash, PartialEq)]
pub struct Filter {
    /// The identifier to compare with.
    pub id: u32,
    /// The bits that are compared.
    pub mask: u32,
}

impl Filter {
    /// The filter that passes every data and remote frame.
    pub const ALL: Self = Self { id: 0, mask: 0 };
    /// Flag in `id` that inverts the filter (`CAN_INV_FILTER`).
    pub const INVERTED_FLAG: u32 = ERROR;
    /// The mask that selects exactly one 11-bit identifier. The kernel looks such filters up in a table, so their
    /// number costs no time.
    pub const EXACT_MASK: u32 = STANDARD_MASK | EXTENDED | REMOTE;
    /// Maximum number of filters of a socket (the kernel's `CAN_RAW_FILTER_MAX`).
    pub const MAX_COUNT: usize = 512;

    /// Creates a filter for the data frames with this identifier.
    #[must_use]
    pub const fn exact(id: Id) -> Self {
        Self { id: id.to_bits() as u32, mask: Self::EXACT_MASK }
    }

    /// Creates a filter for the data frames of a message kind, from or to any node.
    #[must_use]
    pub const fn for_kind(kind: Kind) -> Self {
        Self { id: Id { kind, node: 0 }.to_bits() as u32, mask: Self::EXACT_MASK & !0xFF }
    }

    /// Creates a filter for the data frames that one end of a simulated wire sends.
    #[must_use]
    pub const fn for_link(link_id: LinkId) -> Self {
        Self { id: link_id.raw_id(), mask: EXTENDED_MASK | EXTENDED | REMOTE }
    }

    /// Returns the filter that passes exactly the frames that this one rejects.
    #[must_use]
    pub const fn inverted(self) -> Self {
        Self { id: self.id ^ Self::INVERTED_FLAG, mask: self.mask }
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
        assert_eq!(Filter::for_kind(Kind::Network), Filter { id: 0x400, mask: 0xC000_0700 });
        let link_id = LinkId { wire: 3, back: true };
        assert_eq!(Filter::for_link(link_id), Filter { id: 0x9000_0007, mask: 0xDFFF_FFFF });
    }
}
