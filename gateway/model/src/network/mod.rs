//! The gateway's side of the cells' network: where its ways end, what its tree is, and what is wrong with it.

pub mod check;
pub mod tree;
pub mod uplinks;

pub use uplinks::Uplinks;
