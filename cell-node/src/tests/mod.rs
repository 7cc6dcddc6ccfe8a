//! Tests of the whole crate: exchanges of messages, kernels, ports and sums.

mod exchange;
mod kernel;
mod ports;
mod sums;
