//! The gateway's side of the cells' network.

pub mod uplinks;

pub use uplinks::Uplinks;
