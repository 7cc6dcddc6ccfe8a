//! Joint numbers as an enumeration, with which arrays are indexed without bounds checks.

use protocol::parameters::MAX_JOINTS;

/// A joint of a chain. The enumeration has as many values as a joint array has elements, so the compiler omits bounds
/// checks.
#[repr(u8)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Joint {
    J1,
    J2,
    J3,
    J4,
    J5,
    J6,
    J7,
    J8,
    J9,
    J10,
    J11,
    J12,
    J13,
    J14,
}

impl Joint {
    #[rustfmt::skip]
    pub(super) const ALL: [Self; MAX_JOINTS] = [
        Self::J1, Self::J2, Self::J3, Self::J4, Self::J5, Self::J6, Self::J7,
        Self::J8, Self::J9, Self::J10, Self::J11, Self::J12, Self::J13, Self::J14,
    ];

    /// Returns the element of an array that belongs to this joint.
    #[inline(always)]
    pub(super) fn element_of<T>(self, joints: &[T; MAX_JOINTS]) -> Option<&T> {
        joints.get(self as usize)
    }

    #[inline(always)]
    pub(super) fn element_of_mut<T>(self, joints: &mut [T; MAX_JOINTS]) -> Option<&mut T> {
        joints.get_mut(self as usize)
    }
}
