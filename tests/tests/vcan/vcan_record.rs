//! A recording of a bench on a real kernel's vcan, beside `candump`: it is complete.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use process::TestDir;
use recorded::has_what_candump_sees;

#[test]
#[ignore = "needs vcan"]
fn twelve_cells_are_recorded_as_candump_sees_them() {
    has_what_candump_sees(&TestDir::on_vcan(), 12, 20.0, "");
}

#[test]
#[ignore = "needs vcan"]
fn the_whole_skin_is_recorded_as_candump_sees_it() {
    has_what_candump_sees(&TestDir::on_vcan(), 253, 62.5, "--cells-per-process 16");
}
