//! To be written.

pub mod central;
