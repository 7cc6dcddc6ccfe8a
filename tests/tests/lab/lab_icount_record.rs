//! The whole skin, one process per cell, recorded and replayed where time is counted in instructions.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use process::TestDir;
use recorded::has_what_candump_sees;

#[test]
#[ignore = "needs the lab machine"]
fn all_253_processes_are_recorded_as_candump_sees_them_and_answer_two_replays_bit_for_bit() {
    let place = TestDir::on_vcan();
    has_what_candump_sees(&place, 253, 62.5, "");
    let summary = place.summary();
    let broadcasts = summary.number("/loop/broadcasts");
    assert_eq!((broadcasts, summary.number("/loop/broadcasts_skipped")), (250, 0));
    assert_eq!(summary.of_bus("/replies/in_time"), 253 * broadcasts, "{:#}", summary.0);
    for _ in 0..2 {
        let (ended, replayed) = place.replayed("run.mcap", "--expect --spawn");
        eprintln!("{}", ended.stdout);
        // The cells' first and last packets are compared as well.
        assert!(replayed.all_came_back(&ended) >= 253 * broadcasts, "{:#}", replayed.0);
        assert_eq!(
            (replayed.number("/expect/joints_skipped"), replayed.text("/buses/0/kind")),
            (0, "socketcan")
        );
    }
}
