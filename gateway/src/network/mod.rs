//! The gateway's side of the cells' network.
