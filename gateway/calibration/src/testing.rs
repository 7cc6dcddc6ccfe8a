//! Skins for tests.

#![allow(clippy::unwrap_used, clippy::missing_panics_doc, missing_docs, reason = "for tests")]

use protocol::skin::Skin;

/// The skin of the demo: 253 cells on two links of a UR5.
pub const UR5: &str = include_str!("../../examples/ur5-253.toml");
/// 126 cells on all links of an arm of seven joints, imported from its URDF.
pub const PANDA: &str = include_str!("../tests/data/panda.toml");
/// A cell on an arm on a lift.
pub const LIFT: &str = include_str!("../tests/data/lift.toml");

#[must_use]
pub fn ur5() -> Skin {
    Skin::parse("ur5-253.toml", UR5).unwrap()
}

#[must_use]
pub fn panda() -> Skin {
    Skin::parse("panda.toml", PANDA).unwrap()
}

#[must_use]
pub fn lift() -> Skin {
    Skin::parse("lift.toml", LIFT).unwrap()
}
