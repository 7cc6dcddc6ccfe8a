use super::*;

#[test]
fn names_are_those_that_an_interface_can_have() {
    for name in ["vcan0", "can0", "a23456789012345"] {
        check_name(name).unwrap();
    }
    for name in ["", "a234567890123456", ".", "..", "a/b", "a b", "a:b"] {
        let error = check_name(name).unwrap_err().to_string();
        let rest =
            "is not a valid bus name: use 1 to 15 bytes without spaces, '/' or ':', and not '.' or '..'";
        assert_eq!(error, format!("{name:?} {rest}"));
    }
}

#[test]
fn a_bus_that_nobody_serves_says_how_to_serve_it() {
    let options = BusOptions { directory: Some("/nowhere/skinbus".into()), ..BusOptions::default() };
    let error = Bus::open("vcan7", KindChoice::Only(BusKind::Embedded), &options).unwrap_err();
    let expected = "no embedded bus vcan7 is served in /nowhere/skinbus: start `vcan-setup serve vcan7`, or \
                    `skinbus run`, which serves it";
    assert_eq!(error.to_string(), expected);
}

#[test]
fn a_bus_of_either_kind_that_is_absent_names_both_ways() {
    let options = BusOptions { directory: Some("/nowhere/skinbus".into()), ..BusOptions::default() };
    let error = Bus::open("nosuchcan0", KindChoice::Auto, &options).unwrap_err();
    let expected = "there is no interface nosuchcan0, and no running program serves an embedded bus of this name in \
                    /nowhere/skinbus: make the interface with `vcan-setup up nosuchcan0`, or serve the bus with \
                    `vcan-setup serve nosuchcan0`";
    assert_eq!(error.to_string(), expected);
    assert!(error.may_open_later());
    // An interface of that name is chosen, whatever its type.
    assert_eq!(
        [KindChoice::Auto.resolve("lo"), KindChoice::Auto.resolve("nosuchcan0")],
        [BusKind::SocketCan, BusKind::Embedded]
    );
}

#[test]
fn a_kernel_without_can_says_so_and_one_with_it_names_the_missing_interface() {
    let error =
        Bus::open("nosuchcan0", KindChoice::Only(BusKind::SocketCan), &BusOptions::default()).unwrap_err();
    if has_socketcan() {
        let expected = "there is no interface nosuchcan0: make it with `vcan-setup up nosuchcan0`, or plug \
                        it in if it is hardware";
        assert_eq!(error.to_string(), expected);
    } else {
        assert!(matches!(error, BusError::NoSocketCan { .. }), "{error}");
    }
}

#[test]
fn too_many_filters_are_refused_before_anything_is_opened() {
    let options = BusOptions { filters: vec![Filter::ALL; 513], ..BusOptions::default() };
    let error = Bus::open("vcan0", KindChoice::Auto, &options).unwrap_err();
    assert_eq!(error.to_string(), "513 filters are too many for a socket on vcan0: use at most 512");
}

/// Returns an embedded bus without a server, and the server's end of its connection.
fn pair() -> (Bus, std::os::fd::OwnedFd) {
    use rustix::net::{AddressFamily, SocketFlags, SocketType, socketpair};
    let (near, far) =
        socketpair(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None).unwrap();
    let bus = Bus {
        name: "vcan0".to_owned(),
        kind: BusKind::Embedded,
        socket: near.into(),
        receive_buffer: 0,
        is_timed: false,
        fd: true,
        send_timeout: Duration::from_millis(100),
        directory: Some("/nowhere".into()),
        down: AtomicBool::new(false),
        failed: AtomicBool::new(false),
        receive_timeout: AtomicU32::new(0),
        expired: AtomicBool::new(false),
    };
    (bus, far)
}

#[test]
fn errors_that_pass_cost_no_frame() {
    let (bus, far) = pair();
    let frame = Frame::classic(0x123, &[1]).unwrap();
    for errno in [Errno::NOMEM, Errno::NOBUFS, Errno::CONNRESET] {
        batch::send_one(&far, &frame.to_bytes()[..frame.byte_len()]).unwrap();
        let failures = std::cell::Cell::new(3_u32);
        let mut inbox = Inbox::new();
        let count = bus.receive_with(&mut inbox, |batch, socket| {
            if failures.replace(failures.get().saturating_sub(1)) > 0 {
                return Err(errno.into());
            }
            batch.receive(socket)
        });
        assert_eq!(count.unwrap(), 1, "{errno}");
        assert_eq!(inbox.frames().next().unwrap().frame, frame);
    }
}

#[test]
fn a_lack_of_memory_that_lasts_is_an_error() {
    let (bus, _far) = pair();
    let error = bus.receive_with(&mut Inbox::new(), |_, _| Err(Errno::NOMEM.into())).unwrap_err();
    assert_eq!(error.to_string(), "cannot receive from vcan0: Cannot allocate memory (os error 12)");
}

#[test]
fn an_error_behind_frames_is_reported_by_the_next_receive_for_which_nothing_waits() {
    let (bus, far) = pair();
    let frame = Frame::classic(0x123, &[1]).unwrap();
    batch::send_one(&far, &frame.to_bytes()[..frame.byte_len()]).unwrap();
    let mut inbox = Inbox::new();
    let count = bus.receive_with(&mut inbox, |batch, socket| {
        let count = batch.receive(socket)?;
        batch.fail_after(Errno::PIPE.into());
        Ok(count)
    });
    assert_eq!(count.unwrap(), 1);
    assert!(bus.wait(None).unwrap());
    assert!(matches!(bus.receive(&mut inbox), Err(BusError::Closed(_))));
    assert_eq!(bus.receive(&mut inbox).unwrap(), 0, "once");
}

#[test]
fn a_bus_is_shared_between_threads() {
    const fn shared<T: Send + Sync>() {}
    const { shared::<Bus>() };
}
