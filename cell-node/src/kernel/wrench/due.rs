//! Bits for the values to compute for a row, because its element of J or a row further down reads them.

/// Single results of the turn: the x and y components of force and moment.
pub(super) const NEEDS_TURNED_FX: u32 = 1;
pub(super) const NEEDS_TURNED_FY: u32 = 2;
pub(super) const NEEDS_TURNED_MX: u32 = 4;
pub(super) const NEEDS_TURNED_MY: u32 = 8;
pub(super) const TURN_RESULTS_MASK: u32 =
    NEEDS_TURNED_FX | NEEDS_TURNED_FY | NEEDS_TURNED_MX | NEEDS_TURNED_MY;
/// The shift of moments by d.
pub(super) const NEEDS_SHIFT_BY_D: u32 = 16;
/// The shift of moments by a.
pub(super) const NEEDS_SHIFT_BY_A: u32 = 32;
/// Single results of a twist that is not a multiple of quarter turns.
pub(super) const NEEDS_TWISTED_FY: u32 = 64;
pub(super) const NEEDS_TWISTED_FZ: u32 = 128;
pub(super) const NEEDS_TWISTED_MY: u32 = 256;
pub(super) const NEEDS_TWISTED_MZ: u32 = 512;
/// Bits for twists by multiples of quarter turns.
pub(super) const TWISTS_QUARTER_TURN: u32 = 1 << 11;
pub(super) const TWISTS_QUARTER_TURN_BACK: u32 = 1 << 12;
pub(super) const TWISTS_HALF_TURN: u32 = 1 << 13;
/// The row has no joint.
pub(super) const HAS_NO_JOINT: u32 = 1 << 14;
pub(super) const ALL_TURN_RESULTS_READ: u32 = 1 << 15;
/// The row has a twist or no joint.
pub(super) const HAS_TWIST_OR_NO_JOINT: u32 = 1 << 16;
