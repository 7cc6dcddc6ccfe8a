//! The gateway's side of the cells' network: the wires to the roots, the tree, and its check against the description.

pub mod check;
pub mod tree;
pub mod uplinks;

pub use uplinks::Uplinks;
