//! The firmware in an emulator, alone and in benches of processes: `tests/firmware/run`.

mod firmware_alone;
mod firmware_bench;
mod firmware_conformance;
