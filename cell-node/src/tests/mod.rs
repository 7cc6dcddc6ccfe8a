//! Tests of the whole crate: exchanges of messages, kernels, ports, sums and zeros.

mod exchange;
mod kernel;
mod ports;
mod sums;
mod zero;
