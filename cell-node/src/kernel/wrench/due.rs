//! Bits for the values to compute for a row, because its element of J or a row further down reads them.

/// Single results of the turn: the x and y components of force and moment.
pub(super) const TURNED_FX: u32 = 1;
pub(super) const TURNED_FY: u32 = 2;
pub(super) const TURNED_MX: u32 = 4;
pub(super) const TURNED_MY: u32 = 8;
/// All results of the turn.
pub(super) const ALL_ROTATION: u32 = TURNED_FX | TURNED_FY | TURNED_MX | TURNED_MY;
/// The shift of moments by d.
pub(super) const SHIFT_BY_D: u32 = 16;
/// The shift of moments by a.
pub(super) const SHIFT_BY_A: u32 = 32;
/// Single results of a twist that is not a multiple of quarter turns.
pub(super) const TWISTED_FY: u32 = 64;
pub(super) const TWISTED_FZ: u32 = 128;
pub(super) const TWISTED_MY: u32 = 256;
pub(super) const TWISTED_MZ: u32 = 512;
/// Bits for twists by multiples of quarter turns.
pub(super) const QUARTER_TURN: u32 = 1 << 11;
pub(super) const QUARTER_TURN_BACK: u32 = 1 << 12;
pub(super) const HALF_TURN: u32 = 1 << 13;
/// The row has no joint.
pub(super) const NO_JOINT: u32 = 1 << 14;
/// All results of the turn are read.
pub(super) const ALL: u32 = 1 << 15;
/// The row has a twist or no joint.
pub(super) const TWIST_OR_NO_JOINT: u32 = 1 << 16;
