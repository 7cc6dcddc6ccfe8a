//! Every command of README.md works in a machine whose kernel has CAN, too.

#![allow(clippy::unwrap_used, reason = "a test may stop")]

use skinbus_tests::process;

use process::TestDir;
use process::readme::{README, commands, run};

/// The built programs run there; the timing of 253 processes depends on the machine, so it is not checked.
#[test]
#[ignore = "needs the lab machine"]
fn every_command_works_where_the_kernel_has_can() {
    let place = TestDir::on_vcan();
    let ended = run(&place, &commands(README)).succeeded();
    assert!(ended.stdout.contains("\n+ skinbus replay run.mcap "), "{ended:#?}");
    place.is_left_clean();
}
