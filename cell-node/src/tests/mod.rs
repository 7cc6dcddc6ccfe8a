//! Tests of the whole crate.

mod exchange;
mod kernel;
mod ports;
mod sums;
