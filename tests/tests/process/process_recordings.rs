//! Recordings of earlier builds are replayed to cells of this one, and answered as before (tests/recordings/README.md).
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::path::Path;

use process::TestDir;

/// Replays a recording of an earlier build in lockstep to new cells; returns the number of equal replies.
fn replayed(name: &str, more: &str) -> u64 {
    let place = TestDir::new();
    let from = Path::new(env!("CARGO_MANIFEST_DIR")).join("recordings").join(name);
    std::fs::copy(from, place.path(name)).unwrap();
    let (ended, replayed) = place.replayed(name, &format!("--expect --spawn --lockstep {more}"));
    place.is_left_clean();
    replayed.all_came_back(&ended)
}

#[test]
fn torques_come_back_bit_for_bit() {
    assert_eq!(replayed("fd.mcap", ""), 163);
    assert_eq!(replayed("classic.mcap", ""), 163);
}

#[test]
fn sums_come_back() {
    assert!(replayed("sums.mcap", "") >= 180);
}

#[test]
fn two_buses_of_which_one_has_a_cell_that_was_restarted_come_back() {
    assert!(replayed("two.mcap", "") >= 340);
}

#[test]
fn each_file_of_a_split_recording_comes_back() {
    assert_eq!(replayed("split.mcap", ""), 12);
    assert_eq!(replayed("split-1.mcap", ""), 128);
    assert_eq!(replayed("split-2.mcap", ""), 58);
}
