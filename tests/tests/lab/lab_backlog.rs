//! Frames that the kernel drops between sender and sockets while the sender gets no error: its queue of arrived packets
//! is made so short that the torques of one cell never get through.
//!
//! The queue belongs to the whole machine, so this test is for the lab machine only.

#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;

use process::vcan::{Candump, Vcan, backlog_drops, route, small_skin};
use process::{PRESSED, TestDir};

const MAX_BACKLOG: &str = "/proc/sys/net/core/netdev_max_backlog";

#[test]
#[ignore = "needs the lab machine"]
fn what_the_backlog_dropped_is_counted_exactly_and_nothing_stays_unknown() {
    let place = TestDir::on_vcan();
    let skin = small_skin(4);
    place.write("cells.toml", &skin);
    place.write("skin.toml", &skin.replace("vcan0", "vcan1"));
    place.scenario(PRESSED);
    let (_vcan1, _vcan2) = (Vcan::make("vcan1"), Vcan::make("vcan2"));
    let _cells = place.start("cell-node", "--bus vcan0 --bus-kind socketcan --nodes 1-4 --skin cells.toml");
    // The kernel's gateway forwards all frames. A rule before the exact one first copies each torque of cell 3 ten
    // times to an unused bus. The queue has room for two.
    route("vcan1", "vcan0", "0:0", "");
    route("vcan0", "vcan1", "203~C00007FF", "");
    for _ in 0..10 {
        route("vcan0", "vcan2", "203:7FF", "");
    }
    route("vcan0", "vcan1", "203:C00007FF", "");
    fs::write(MAX_BACKLOG, "1").unwrap();

    let before = backlog_drops();
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(3.0, "--no-spawn").end().succeeded();
    let sent = candump.frames().iter().filter(|frame| frame.raw_id() == 0x203).count() as u64;
    let dropped = backlog_drops() - before;
    let summary = place.summary();
    summary.adds_up();
    assert!(sent > 6, "{sent} torques of cell 3: {:#}", summary.0);
    // Of each eleven copies, two were accepted.
    assert_eq!((summary.number("/backlog_dropped"), dropped), (9 * sent, 9 * sent));
    assert_eq!(summary.of_bus("/uplink/backlog"), sent, "{:#}", summary.0);
    assert_eq!(summary.of_bus("/replies/lost"), sent, "{:#}", summary.0);
    assert_eq!((summary.of_bus("/dropped_by_bus"), summary.odd(0)), (0, 0));
    assert_eq!(
        summary.count("/buses/0/received", "torque"),
        summary.of_bus("/replies/in_time")
            + summary.of_bus("/replies/late")
            + summary.count("/buses/0/events", "stale torque"),
        "{:#}",
        summary.0
    );
}
