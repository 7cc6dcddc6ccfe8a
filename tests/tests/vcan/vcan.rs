//! The table of `CAN_RAW`'s rules, checked against a real kernel.
//!
//! Needs `vcan0` with MTU 72, up: `vcan-setup up vcan0`.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::time::Duration;

use protocol::bus::{Bus, BusError, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{FD_FORMAT, Frame};

use skinbus_tests::can_raw as cases;
use skinbus_tests::process::TIMEOUT;
use skinbus_tests::process::vcan::own_network;

const LAST: u32 = 0x7FF;

fn open(options: &BusOptions) -> Bus {
    Bus::open("vcan0", KindChoice::Only(BusKind::SocketCan), options).unwrap()
}

fn sender() -> Bus {
    open(&BusOptions { filters: vec![], ..BusOptions::default() })
}

/// Returns all frames before [`LAST`].
fn read(bus: &Bus, inbox: &mut Inbox) -> Vec<Frame> {
    let mut frames = Vec::new();
    loop {
        assert!(bus.wait(Some(TIMEOUT)).unwrap(), "the last frame comes");
        bus.receive(inbox).unwrap();
        for received in inbox.frames() {
            if received.frame.id() == LAST {
                return frames;
            }
            assert!(received.at_nanos > 1_000_000_000, "stamped with the wall clock");
            frames.push(received.frame);
        }
    }
}

/// Kernels before 6.1 leave the flag FDF as the sender set it.
fn same(a: &Frame, b: &Frame) -> bool {
    (a.raw_id(), a.format(), a.data()) == (b.raw_id(), b.format(), b.data())
        && a.flags() | FD_FORMAT == b.flags() | FD_FORMAT
}

#[test]
#[ignore = "needs vcan"]
fn the_kernel_keeps_every_rule() {
    own_network();
    let other = sender();
    for case in cases::cases() {
        let exact = Filter { id: LAST, mask: Filter::EXACT_MASK };
        let filters = [&case.filters[..], &[exact]].concat();
        let (own_frames, fd, error_mask) = (case.own_frames, case.fd, case.error_mask);
        let client = open(&BusOptions { filters, own_frames, fd, error_mask, ..BusOptions::default() });
        if case.from_self { &client } else { &other }.send(&[case.frame]).unwrap();
        other.send(&[Frame::classic(LAST, &[]).unwrap()]).unwrap();
        let got = read(&client, &mut Inbox::new());
        assert_eq!(got.len(), usize::from(case.received), "{}: {got:?}", case.what);
        assert!(got.iter().all(|frame| same(frame, &case.frame)), "{}: {got:?}", case.what);
    }
}

#[test]
#[ignore = "needs vcan"]
fn the_kernel_changes_filters_of_an_open_socket() {
    own_network();
    let exact = |id| Filter { id, mask: Filter::EXACT_MASK };
    let frame = |id| Frame::classic(id, &[1]).unwrap();
    let other = sender();
    let client = open(&BusOptions { filters: vec![exact(1)], ..BusOptions::default() });
    other.send(&[frame(1), frame(2)]).unwrap();
    client.set_filters(&[exact(2), exact(LAST)]).unwrap();
    other.send(&[frame(1), frame(2), frame(LAST)]).unwrap();
    let ids: Vec<_> = read(&client, &mut Inbox::new()).iter().map(Frame::id).collect();
    assert_eq!(ids, [1, 2]);
    assert!(client.is_virtual().unwrap());
}

#[test]
#[ignore = "needs vcan"]
fn the_kernel_refuses_what_the_table_says() {
    own_network();
    let [fd, classic] = [true, false].map(|fd| open(&BusOptions { fd, ..BusOptions::default() }));
    for refused in cases::refused() {
        let socket = if refused.fd { &fd } else { &classic };
        let sent = rustix::net::send(socket, &refused.datagram, rustix::net::SendFlags::empty());
        assert!(sent.is_err(), "{}: {sent:?}", refused.what);
    }
}

#[test]
#[ignore = "needs vcan"]
fn the_kernel_marks_own_frames_and_counts_drops() {
    own_network();
    let bus = open(&BusOptions { own_frames: true, receive_buffer: 0, ..BusOptions::default() });
    let small = bus.receive_buffer_bytes();
    for number in 0..100_u32 {
        bus.send(&[Frame::fd(1, 1, &number.to_le_bytes()).unwrap()]).unwrap();
    }
    let (mut inbox, mut heard) = (Inbox::new(), 0);
    while bus.wait(Some(Duration::from_millis(200))).unwrap() {
        bus.receive(&mut inbox).unwrap();
        assert!(inbox.frames().all(|received| received.own));
        heard += inbox.frames().len();
    }
    assert!(heard < 100, "{heard} frames fit into {small} bytes");
    sender().send(&[Frame::classic(LAST, &[]).unwrap()]).unwrap();
    assert!(read(&bus, &mut inbox).is_empty());
    assert_eq!(heard + inbox.dropped_count() as usize, 100, "the next frame brings the count");
}

#[test]
#[ignore = "needs vcan"]
fn the_choice_is_socketcan_and_a_missing_interface_is_no_reason_for_another_bus() {
    own_network();
    let bus = Bus::open("vcan0", KindChoice::Auto, &BusOptions::default()).unwrap();
    assert_eq!(bus.kind(), BusKind::SocketCan);
    assert!(
        bus.receive_buffer_bytes() >= BusOptions::default().receive_buffer,
        "{}",
        bus.receive_buffer_bytes()
    );
    let error = Bus::open("vcan77", KindChoice::Auto, &BusOptions::default()).unwrap_err().to_string();
    let expected =
        "there is no interface vcan77, and no running program serves an embedded bus of this name in ";
    assert!(error.starts_with(expected), "{error}");
    assert!(
        error.ends_with("`vcan-setup up vcan77`, or serve the bus with `vcan-setup serve vcan77`"),
        "{error}"
    );
    let only = KindChoice::Only(BusKind::SocketCan);
    let error = Bus::open("vcan77", only, &BusOptions::default()).unwrap_err();
    let expected = "there is no interface vcan77: make it with `vcan-setup up vcan77`, or plug it in if \
                    it is hardware";
    assert_eq!(error.to_string(), expected);
    let error = Bus::open("lo", KindChoice::Auto, &BusOptions::default()).unwrap_err();
    assert!(matches!(error, BusError::NotCan { .. }), "{error}");
}

/// Uses an interface of its own, so that the interface of another test does not go down.
#[test]
#[ignore = "needs vcan"]
fn an_interface_that_goes_down_and_up_and_away_is_told_apart() {
    own_network();
    let ip = |arguments: &str| {
        let status = std::process::Command::new("ip").args(arguments.split(' ')).status().unwrap();
        assert!(status.success(), "ip {arguments}");
    };
    let frame = Frame::fd(1, 1, &[1; 16]).unwrap();
    let open = || Bus::open("vcan9", KindChoice::Auto, &BusOptions::default());
    ip("link add vcan9 type vcan");
    assert!(matches!(open().unwrap_err(), BusError::Down { .. }), "made, and not up");
    ip("link set vcan9 mtu 16");
    ip("link set vcan9 up");
    let error = open().unwrap_err().to_string();
    assert!(error.starts_with("vcan9 has MTU 16, but CAN FD needs 72"), "{error}");
    Bus::open("vcan9", KindChoice::Auto, &BusOptions { fd: false, ..BusOptions::default() }).unwrap();
    ip("link set vcan9 down");
    ip("link set vcan9 mtu 72");
    ip("link set vcan9 up");

    let [a, b, c] = [(); 3].map(|()| open().unwrap());
    let mut inbox = Inbox::new();
    ip("link set vcan9 down");
    assert!(a.wait(Some(TIMEOUT)).unwrap(), "going down can be waited for");
    let error = a.receive(&mut inbox).unwrap_err();
    assert!(matches!(error, BusError::Down { .. }) && error.is_temporary(), "{error}");
    assert_eq!(a.receive(&mut inbox).unwrap(), 0, "and is told once");
    // A loop that only offers frames consumes the error; a receiver on the same bus still gets it.
    assert!(!c.try_send_all(&[frame]) && c.wait(Some(Duration::ZERO)).unwrap());
    assert!(matches!(c.receive(&mut inbox).unwrap_err(), BusError::Down { .. }));
    assert!(!c.wait(Some(Duration::ZERO)).unwrap(), "once for each time that it was said");
    // A pending error of the socket is returned before the requested operation.
    let errors = [(); 2].map(|()| b.send(&[frame]).unwrap_err());
    assert!(errors.iter().all(|error| matches!(error.cause, BusError::Down { .. })), "{errors:?}");
    ip("link set vcan9 up");
    b.send(&[frame]).unwrap();
    assert!(a.wait(Some(TIMEOUT)).unwrap());
    assert_eq!(a.receive(&mut inbox).unwrap(), 1, "the same socket goes on");

    ip("link del vcan9");
    assert!(a.wait(Some(TIMEOUT)).unwrap());
    let error = std::iter::repeat_with(|| a.receive(&mut inbox)).take(3).find_map(Result::err).unwrap();
    assert!(matches!(error, BusError::Gone { .. } | BusError::Down { .. }), "{error}");
    let error = std::iter::repeat_with(|| b.send(&[frame])).take(3).find_map(Result::err).unwrap();
    assert!(matches!(error.cause, BusError::Gone { .. } | BusError::Down { .. }), "{error}");
    let error = b.send(&[frame]).unwrap_err();
    assert!(error.cause.is_closed(), "a removed interface stays away: {error}");
}
