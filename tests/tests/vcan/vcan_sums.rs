//! Sums along a tree on a real kernel's vcan: complete, broken and repaired.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use process::TestDir;
use process::sums::{goes_on_without_a_wire, goes_round_a_cell, keeps_ways_without_a_touch};
use protocol::can::Format;

#[test]
#[ignore = "needs vcan"]
fn sums_go_round_a_cell_that_is_killed_or_hangs_and_who_comes_back_is_in_them_again() {
    goes_round_a_cell(&TestDir::on_vcan(), Format::Fd);
}

#[test]
#[ignore = "needs vcan"]
fn so_they_do_in_classic_frames() {
    goes_round_a_cell(&TestDir::on_vcan(), Format::Classic);
}

#[test]
#[ignore = "needs vcan"]
fn without_a_touch_hellos_tell_who_is_gone_and_the_rest_finds_another_way() {
    keeps_ways_without_a_touch(&TestDir::on_vcan(), Format::Fd);
}

#[test]
#[ignore = "needs vcan"]
fn so_it_is_in_classic_frames() {
    keeps_ways_without_a_touch(&TestDir::on_vcan(), Format::Classic);
    goes_on_without_a_wire(&TestDir::on_vcan(), Format::Classic);
}

#[test]
#[ignore = "needs vcan"]
fn who_is_unreachable_any_more_is_named_and_the_rest_finds_another() {
    goes_on_without_a_wire(&TestDir::on_vcan(), Format::Fd);
}
