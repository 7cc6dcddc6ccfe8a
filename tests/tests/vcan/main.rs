//! Benches on a real kernel's vcan, each test in a network of its own: `tests/vcan`.

mod vcan;
mod vcan_bench;
mod vcan_buses;
mod vcan_cangw;
mod vcan_faults;
mod vcan_loss;
mod vcan_record;
mod vcan_replay;
mod vcan_setup;
mod vcan_slcan;
mod vcan_sums;
mod vcan_tools;
