//! `vcan-setup slcan` on a real kernel's vcan: filters, frames in both directions, and an interface that goes down and
//! comes back.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::slcan;

use process::vcan::tool;
use process::{TestDir, until};
use protocol::bus::{Bus, BusOptions, Inbox};
use protocol::can::{EXTENDED, Frame};
use rustix::process::Signal;
use serde_json::Value;
use slcan::Pty;

#[test]
#[ignore = "needs vcan"]
fn a_line_is_a_participant_of_a_vcan() {
    let place = TestDir::on_vcan();
    let [mut all, mut one] = [Pty::new(), Pty::new()];
    let words = format!("slcan vcan0 --json {} {},cell=12", all.path.display(), one.path.display());
    let bridge = place.start("vcan-setup", &words);
    bridge.wait_for_stderr("2 lines on vcan0 (socketcan)");
    let open = || Bus::open("vcan0", "socketcan".parse().unwrap(), &BusOptions::default()).unwrap();
    let bus = open();
    let frames = [
        Frame::fd(0x001, 1, &[1; 16]).unwrap(),
        Frame::fd(0x50C, 1, &[2; 64]).unwrap(),
        Frame::classic(0x20C, &[3; 8]).unwrap(),
        Frame::remote(0x123, 4).unwrap(),
        Frame::fd(EXTENDED | 0x1234_5678, 0, &[]).unwrap(),
    ];
    bus.send(&frames).unwrap();
    assert_eq!(all.peer.receives(frames.len()), frames);
    assert_eq!(one.peer.receives(2), frames[..2]);
    one.peer.sends(&frames);
    assert_eq!(all.peer.receives(2 * frames.len())[frames.len()..], frames);
    let (mut inbox, mut received) = (Inbox::new(), Vec::new());
    until("frames on vcan0", || {
        bus.receive(&mut inbox).unwrap();
        received.extend(inbox.frames().map(|received| received.frame));
        (received.len() >= frames.len()).then_some(())
    });
    assert_eq!(received, frames);

    tool("ip link set vcan0 down");
    bridge.wait_for_stderr("the bus is unavailable (vcan0 is down");
    all.peer.sends(&frames[..1]);
    tool("ip link set vcan0 up");
    until("both to be back", || {
        (bridge.stderr().matches("the bus is available again").count() == 2).then_some(())
    });
    let bus = open();
    bus.send(&frames[..1]).unwrap();
    assert_eq!(all.peer.receives(2 * frames.len() + 1)[2 * frames.len()..], frames[..1]);

    bridge.signal(Signal::TERM);
    let account: Value = serde_json::from_str(&bridge.end().succeeded().stdout).unwrap();
    let [all, one] = [0, 1].map(|at| &account["lines"][at]);
    assert_eq!((&all["to_line"]["sent"], &all["to_line"]["received"]), (&11.into(), &11.into()), "{all}");
    assert_eq!((&one["to_line"]["sent"], &one["to_bus"]["sent"]), (&3.into(), &5.into()), "{one}");
}
