//! The whole skin on the lab machine's own clock, at a rate that it sustains.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

mod process;

use process::whole;

#[test]
#[ignore = "needs the lab machine"]
fn all_253_processes_answer_every_broadcast_at_20_hz() {
    whole::runs_for_half_a_minute(20 * 30);
}
