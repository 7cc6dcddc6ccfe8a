//! The embedded bus with real sockets.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::os::fd::AsFd;
use std::os::unix::fs::{DirBuilderExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use skinbus_tests::process::until;

use protocol::bus::embedded::{ClientHello, FilterPart, HELLO_VERSION, HelloReply, socket_address};
use protocol::bus::{Bus, BusError, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{FD_FORMAT, Frame};
use rustix::net::{AddressFamily, SendFlags, SocketFlags, SocketType};
use socketcan::{CanAnyFrame, CanFdSocket, EmbeddedFrame, Socket};
use tempfile::TempDir;
use vcan_setup::embedded::{BusTotals, ServerThread};

use skinbus_tests::can_raw as cases;
mod place;

const BUS: &str = "vcan0";
/// A time limit that only failures reach.
const FAILURE_TIMEOUT: Duration = Duration::from_secs(60);
/// The identifier of the frame that marks the end of a test's frames.
const END_MARKER_ID: u32 = 0x7FF;
/// The identifier of ignored frames, which are sent until the bus has processed everything.
const FILLER_ID: u32 = 0x6FF;

/// A bus of its own for each test, in a directory that does not exist yet.
struct Bench {
    parent: TempDir,
    served: ServerThread,
}

impl Bench {
    fn new() -> Self {
        let parent = TempDir::new().unwrap();
        let served = ServerThread::start_in(&parent.path().join("skinbus"), BUS).unwrap();
        Self { parent, served }
    }

    fn directory(&self) -> PathBuf {
        self.parent.path().join("skinbus")
    }

    fn options(&self) -> BusOptions {
        BusOptions { directory: Some(self.directory()), ..BusOptions::default() }
    }

    fn open(&self, filters: &[Filter]) -> Bus {
        self.open_with(BusOptions { filters: filters.to_vec(), ..self.options() })
    }

    fn open_with(&self, options: BusOptions) -> Bus {
        Bus::open(BUS, KindChoice::Only(BusKind::Embedded), &options).unwrap()
    }

    /// Connects without [`Bus`], and sends nothing yet.
    fn raw(&self) -> std::os::fd::OwnedFd {
        let socket =
            rustix::net::socket_with(AddressFamily::UNIX, SocketType::SEQPACKET, SocketFlags::CLOEXEC, None)
                .unwrap();
        rustix::net::connect(&socket, &socket_address(&self.directory(), BUS).unwrap()).unwrap();
        socket
    }

    /// Stops the bus, and checks that no file is left and every frame is accounted for.
    fn end(self) -> BusTotals {
        let totals = self.served.stop().unwrap();
        assert_eq!(std::fs::read_dir(self.parent.path()).unwrap().count(), 0, "the directory is removed too");
        assert_eq!(totals.routed, totals.delivered + totals.dropped + totals.abandoned, "{totals:?}");
        totals
    }
}

fn exact(id: u32) -> Filter {
    Filter { id, mask: Filter::EXACT_MASK }
}

fn frame(id: u32, number: u32) -> Frame {
    Frame::fd(id, 1, &number.to_le_bytes()).unwrap()
}

/// Returns all frames before [`END_MARKER_ID`], except [`FILLER_ID`].
fn read(bus: &Bus, inbox: &mut Inbox) -> Vec<Frame> {
    let mut frames = Vec::new();
    loop {
        assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap(), "the last frame comes; {} came", frames.len());
        bus.receive(inbox).unwrap();
        for received in inbox.frames() {
            match received.frame.id() {
                END_MARKER_ID => return frames,
                FILLER_ID => {}
                _ => frames.push(received.frame),
            }
        }
    }
}

fn read_all(bus: &Bus) -> Vec<Frame> {
    read(bus, &mut Inbox::new())
}

#[test]
fn a_broadcast_reaches_everyone_but_its_sender() {
    let bench = Bench::new();
    let sender = bench.open(&[Filter::ALL]);
    let receivers: Vec<_> = (0..100).map(|_| bench.open(&[exact(1), exact(END_MARKER_ID)])).collect();
    sender.send(&[frame(1, 7), frame(2, 8), frame(END_MARKER_ID, 0)]).unwrap();
    for receiver in &receivers {
        assert_eq!(read_all(receiver), [frame(1, 7)]);
    }
    assert!(!sender.wait(Some(Duration::from_millis(20))).unwrap());
    let totals = bench.end();
    assert_eq!((totals.clients, totals.frames, totals.routed, totals.delivered), (101, 3, 200, 200));
}

#[test]
fn every_senders_order_is_kept_and_all_receivers_see_the_same() {
    let bench = Bench::new();
    let receivers: Vec<_> = (0..3).map(|_| bench.open(&[Filter::ALL])).collect();
    std::thread::scope(|scope| {
        for sender in 0..4_u32 {
            let bus = bench.open(&[]);
            scope.spawn(move || {
                for block in 0..30 {
                    let frames: Vec<_> = (0..10).map(|n| frame(sender, 10 * block + n)).collect();
                    bus.send(&frames).unwrap();
                }
            });
        }
    });
    wait_until_routed(&bench);
    bench.open(&[]).send(&[frame(END_MARKER_ID, 0)]).unwrap();
    let seen: Vec<_> = receivers.iter().map(read_all).collect();
    assert!(seen.iter().all(|other| *other == seen[0]));
    for sender in 0..4 {
        let own: Vec<_> = seen[0].iter().filter(|frame| frame.id() == sender).copied().collect();
        assert_eq!(own, (0..300).map(|n| frame(sender, n)).collect::<Vec<_>>());
    }
    bench.end();
}

#[test]
fn every_rule_of_can_raw_holds() {
    let bench = Bench::new();
    for case in cases::cases() {
        // The end marker passes the same filters, so the case gets one more filter that accepts it.
        let filters = [&case.filters[..], &[exact(END_MARKER_ID)]].concat();
        let (own_frames, fd, error_mask) = (case.own_frames, case.fd, case.error_mask);
        let client = bench.open_with(BusOptions { filters, own_frames, fd, error_mask, ..bench.options() });
        let other = bench.open(&[]);
        if case.from_self { &client } else { &other }.send(&[case.frame]).unwrap();
        if case.from_self {
            wait_until_routed(&bench);
        }
        other.send(&[Frame::classic(END_MARKER_ID, &[]).unwrap()]).unwrap();
        let expected = if case.received { vec![case.frame] } else { vec![] };
        assert_eq!(read_all(&client), expected, "{}", case.what);
    }
    bench.end();
}

/// Waits until all frames sent before have been routed: this one is read in the same round or a later one.
fn wait_until_routed(bench: &Bench) {
    let (a, b) = (bench.open(&[]), bench.open(&[exact(FILLER_ID)]));
    for _ in 0..2 {
        a.send(&[frame(FILLER_ID, 0)]).unwrap();
        assert!(b.wait(Some(FAILURE_TIMEOUT)).unwrap());
        b.receive(&mut Inbox::new()).unwrap();
    }
}

#[test]
fn filters_change_in_order_with_the_frames() {
    let bench = Bench::new();
    let other = bench.open(&[]);
    let client = bench.open_with(BusOptions {
        own_frames: true,
        filters: vec![exact(1), exact(2)],
        ..bench.options()
    });
    // The order between its own frames and its filters is kept.
    client.send(&[frame(1, 1), frame(3, 1)]).unwrap();
    client.set_filters(&[exact(2), exact(3), exact(END_MARKER_ID)]).unwrap();
    client.send(&[frame(1, 2), frame(2, 2), frame(3, 2)]).unwrap();
    client.set_filters(&[]).unwrap();
    client.send(&[frame(1, 3), frame(2, 3), frame(3, 3)]).unwrap();
    // More filters than one datagram holds, with the relevant ones at both ends.
    let many: Vec<_> = [3, END_MARKER_ID].into_iter().chain(0x100..0x200).chain([1]).map(exact).collect();
    client.set_filters(&many).unwrap();
    wait_until_routed(&bench);
    other.send(&[frame(1, 4), frame(2, 4), frame(3, 4), frame(0x1FF, 4), frame(END_MARKER_ID, 0)]).unwrap();
    let expected = [(1, 1), (2, 2), (3, 2), (1, 4), (3, 4), (0x1FF, 4)].map(|(id, number)| frame(id, number));
    assert_eq!(read_all(&client), expected);

    let error = client.set_filters(&vec![Filter::ALL; 513]).unwrap_err().to_string();
    assert_eq!(error, "513 filters are too many for a socket on vcan0: use at most 512");
    client.set_filters(&vec![exact(END_MARKER_ID); 512]).unwrap();
    wait_until_routed(&bench);
    other.send(&[frame(1, 5), frame(END_MARKER_ID, 0)]).unwrap();
    assert_eq!(read_all(&client), []);
    assert_eq!(bench.end().garbage, 0);
}

#[test]
fn filters_that_never_end_are_garbage_and_those_latched_stay() {
    let bench = Bench::new();
    let client = bench.open(&[exact(1), exact(END_MARKER_ID)]);
    let part = |first, last| FilterPart { first, last, filters: vec![Filter::ALL; 8] }.encode();
    for count in 0..64 {
        rustix::net::send(&client, &part(count == 0, false), SendFlags::empty()).unwrap();
    }
    for _ in 0..2 {
        rustix::net::send(&client, &part(false, true), SendFlags::empty()).unwrap();
    }
    rustix::net::send(&client, &part(true, false), SendFlags::empty()).unwrap();
    wait_until_routed(&bench);
    bench.open(&[]).send(&[frame(1, 1), frame(2, 1), frame(END_MARKER_ID, 0)]).unwrap();
    assert_eq!(read_all(&client), [frame(1, 1)]);
    assert_eq!(bench.end().garbage, 2, "the part that made too many, and one of nothing");
}

#[test]
fn own_frames_are_marked_and_stamped_with_the_wall_clock() {
    let bench = Bench::new();
    let bus = bench.open_with(BusOptions { own_frames: true, ..bench.options() });
    let before = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos();
    bus.send(&[Frame::with_data(5, protocol::can::Format::Fd, 1, &[9]).unwrap()]).unwrap();
    bench.open(&[]).send(&[frame(6, 0)]).unwrap();
    let mut inbox = Inbox::new();
    let mut seen = Vec::new();
    while seen.len() < 2 {
        assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap());
        bus.receive(&mut inbox).unwrap();
        seen.extend(inbox.frames());
    }
    let after = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos();
    seen.sort_by_key(|received| received.frame.id());
    assert_eq!(seen.iter().map(|received| received.own).collect::<Vec<_>>(), [true, false]);
    assert_eq!(seen[0].frame.flags(), 1 | FD_FORMAT, "the bus sets the flag, as kernels do");
    assert!(seen.iter().all(|received| (before..=after).contains(&u128::from(received.at_nanos))));
    bench.end();
}

#[test]
fn what_a_client_does_not_read_is_dropped_and_counted_exactly() {
    const SENT: u32 = 20_000;
    let bench = Bench::new();
    let filters = vec![exact(1), exact(2), exact(END_MARKER_ID)];
    let slow = bench.open_with(BusOptions { filters, receive_buffer: 64 * 1024, ..bench.options() });
    assert!(slow.receive_buffer_bytes() >= 64 * 1024);
    let sender = bench.open(&[]);
    for first in (0..SENT).step_by(50) {
        sender.send(&(first..first + 50).map(|n| frame(1, n)).collect::<Vec<_>>()).unwrap();
    }
    wait_until_routed(&bench);

    // Every frame that arrives is preceded by the number of missing ones.
    let mut inbox = Inbox::new();
    let mut heard = 0;
    while heard + inbox.dropped_count() < SENT {
        assert!(
            slow.wait(Some(FAILURE_TIMEOUT)).unwrap(),
            "{heard} heard, {} dropped",
            inbox.dropped_count()
        );
        slow.receive(&mut inbox).unwrap();
        for received in inbox.frames() {
            assert_eq!(received.frame, frame(1, heard), "the oldest are kept");
            heard += 1;
        }
    }
    assert!(heard > 100 && inbox.dropped_count() > 1000, "{heard} heard, {} dropped", inbox.dropped_count());
    assert_eq!(heard + inbox.dropped_count(), SENT);

    // After that, everything is as before.
    sender.send(&[frame(2, 0), frame(END_MARKER_ID, 0)]).unwrap();
    assert_eq!(read(&slow, &mut inbox), [frame(2, 0)]);
    let dropped = inbox.dropped_count();
    assert_eq!(bench.end().dropped, u64::from(dropped));
}

#[test]
fn a_slow_client_holds_up_nobody() {
    let bench = Bench::new();
    let _slow = bench.open_with(BusOptions { receive_buffer: 0, ..bench.options() });
    let fast = bench.open(&[Filter::ALL]);
    let sender = bench.open(&[]);
    let mut inbox = Inbox::new();
    for round in 0..100 {
        let frames: Vec<_> = (0..64).map(|n| frame(1, 64 * round + n)).collect();
        sender.send(&frames).unwrap();
        sender.send(&[frame(END_MARKER_ID, 0)]).unwrap();
        assert_eq!(read(&fast, &mut inbox), frames);
    }
    assert_eq!(inbox.dropped_count(), 0);
    let totals = bench.end();
    assert!(totals.dropped > 0 && totals.abandoned > 0, "{totals:?}");
}

#[test]
fn a_client_that_vanishes_has_said_what_it_said_and_the_rest_go_on() {
    let bench = Bench::new();
    let stays = bench.open(&[Filter::ALL]);
    for round in 0..50 {
        let goes = bench.open(&[Filter::ALL]);
        stays.send(&[frame(3, 0), frame(3, 1)]).unwrap();
        goes.send(&[frame(1, round), frame(END_MARKER_ID, 0)]).unwrap();
        // The client leaves without reading, so the system reports an error to the server before the end.
        drop(goes);
        assert_eq!(read_all(&stays), [frame(1, round)]);
    }
    assert_eq!(bench.end().clients, 51);
}

#[test]
fn garbage_is_counted_and_hurts_nobody() {
    let bench = Bench::new();
    let bus = bench.open(&[Filter::ALL]);
    let bad = bench.open_with(BusOptions { fd: false, filters: vec![], ..bench.options() });
    let worse = bench.open(&[]);
    let mut sent = 0;
    for refused in cases::refused() {
        let socket = if refused.fd { &worse } else { &bad };
        rustix::net::send(socket, &refused.datagram, SendFlags::empty()).unwrap();
        sent += 1;
    }
    for len in [0, 200, 4000] {
        rustix::net::send(&worse, &vec![0; len], SendFlags::empty()).unwrap();
        sent += 1;
    }
    wait_until_routed(&bench);
    worse.send(&[frame(1, 1), frame(END_MARKER_ID, 0)]).unwrap();
    assert_eq!(read_all(&bus), [frame(1, 1)]);
    assert_eq!(bench.end().garbage, sent);
}

#[test]
fn who_does_not_say_hello_is_turned_away() {
    let bench = Bench::new();
    let mut other_version = ClientHello::default().encode();
    other_version[7] = HELLO_VERSION + 1;
    for first in [&frame(1, 1).to_bytes()[..], b"hello", &[0; 5000], &other_version] {
        let socket = bench.raw();
        rustix::net::send(&socket, first, SendFlags::empty()).unwrap();
        let mut answer = [0; 64];
        let (len, _) = rustix::net::recv(&socket, &mut answer, rustix::net::RecvFlags::empty()).unwrap();
        assert_eq!(HelloReply::decode(&answer[..len]), Some(HelloReply::Refused { version: HELLO_VERSION }));
        let (len, _) = rustix::net::recv(&socket, &mut answer, rustix::net::RecvFlags::empty()).unwrap();
        assert_eq!(len, 0, "and then it is closed");
    }
    drop(bench.raw());
    let silent = bench.raw();
    let bus = bench.open(&[Filter::ALL]);
    bench.open(&[]).send(&[frame(1, 1), frame(END_MARKER_ID, 0)]).unwrap();
    assert_eq!(read_all(&bus), [frame(1, 1)], "who says nothing holds up nobody");
    drop(silent);
    assert_eq!(bench.end().refused, 4);
}

#[test]
fn a_socketcan_socket_works_on_it_unchanged() {
    let bench = Bench::new();
    let bus = bench.open(&[Filter::ALL]);
    let adopted = CanFdSocket::from(bench.open(&[Filter::ALL]).as_fd().try_clone_to_owned().unwrap());
    bus.send(&[frame(0x123, 0x0403_0201), Frame::classic(0x12, &[5]).unwrap()]).unwrap();
    let (CanAnyFrame::Fd(fd), CanAnyFrame::Normal(classic)) =
        (adopted.read_frame().unwrap(), adopted.read_frame().unwrap())
    else {
        panic!("an FD frame, then a classic one");
    };
    assert_eq!((fd.data(), classic.data()), (&[1, 2, 3, 4][..], &[5][..]));
    let id = socketcan::StandardId::new(0x321).unwrap();
    adopted.write_frame(&socketcan::CanFdFrame::new(id, &[1; 16]).unwrap()).unwrap();
    adopted
        .write_frame(&socketcan::CanFrame::new(socketcan::StandardId::new(0x7FF).unwrap(), &[]).unwrap())
        .unwrap();
    assert_eq!(read_all(&bus), [Frame::fd(0x321, 0, &[1; 16]).unwrap()]);
    bench.end();
}

#[test]
fn a_bus_that_ends_is_read_to_its_end_and_then_closed() {
    let bench = Bench::new();
    let (bus, idle) = (bench.open(&[Filter::ALL]), bench.open(&[Filter::ALL]));
    let sender = bench.open(&[]);
    sender.send(&[frame(1, 1), frame(1, 2)]).unwrap();
    wait_until_routed(&bench);
    bench.end();

    let mut inbox = Inbox::new();
    assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap());
    bus.receive(&mut inbox).unwrap();
    let seen: Vec<_> =
        inbox.frames().map(|received| received.frame).filter(|frame| frame.id() == 1).collect();
    assert_eq!(seen, [frame(1, 1), frame(1, 2)]);
    assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap(), "the end can be waited for too");
    let error = bus.receive(&mut inbox).unwrap_err();
    assert!(matches!(error, BusError::Closed { .. }) && error.is_closed(), "{error}");
    // A child that another test has just forked holds the server's end open until its `exec`.
    let error = until("an error", || idle.send(&[frame(1, 3), frame(1, 4)]).err());
    assert_eq!(error.to_string(), "the embedded bus vcan0 was closed: its server ended (0 of 2 frames sent)");
}

#[test]
fn a_client_that_alone_is_hung_up_on_is_not_told_that_the_server_ended() {
    let bench = Bench::new();
    let (bus, other) = (bench.open(&[Filter::ALL]), bench.open(&[Filter::ALL]));
    // The server hangs up on a client that will never send again.
    rustix::net::shutdown(&bus, rustix::net::Shutdown::Write).unwrap();
    assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap());
    let error = bus.receive(&mut Inbox::new()).unwrap_err();
    let said = "the embedded bus vcan0 was closed: its server disconnected this program, but still serves others; \
                connect again";
    assert_eq!((error.to_string().as_str(), error.is_closed(), error.may_open_later()), (said, true, true));
    let sender = bench.open(&[]);
    sender.send(&[frame(1, 1)]).unwrap();
    assert!(other.wait(Some(FAILURE_TIMEOUT)).unwrap(), "the others go on");
    bench.end();
}

#[test]
fn a_server_that_lets_nobody_in_is_given_up_on() {
    let parent = TempDir::new().unwrap();
    // Bound but not running, like a stopped process: it accepts no client.
    let server = vcan_setup::embedded::Server::bind_in(&parent.path().join("skinbus"), BUS).unwrap();
    let directory = Some(parent.path().join("skinbus"));
    let error = Bus::open(
        BUS,
        KindChoice::Only(BusKind::Embedded),
        &BusOptions { directory, ..BusOptions::default() },
    );
    let error = error.unwrap_err().to_string();
    let expected = "the embedded bus vcan0 did not answer within 2000 ms: check that its server runs and has \
                    file descriptors left (`ulimit -n`)";
    assert_eq!(error, expected);
    drop(server);
}

#[test]
fn one_receives_while_others_send_on_the_same_bus() {
    let bench = Bench::new();
    let bus = bench.open_with(BusOptions { own_frames: true, ..bench.options() });
    std::thread::scope(|scope| {
        for thread in 0..3 {
            let bus = &bus;
            scope.spawn(move || (0..500).for_each(|n| bus.send(&[frame(thread, n)]).unwrap()));
        }
        let (mut inbox, mut next) = (Inbox::new(), [0; 3]);
        while next != [500; 3] {
            assert!(bus.wait(Some(FAILURE_TIMEOUT)).unwrap());
            bus.receive(&mut inbox).unwrap();
            for received in inbox.frames() {
                let count = &mut next[received.frame.id() as usize];
                assert_eq!(received.frame, frame(received.frame.id(), *count));
                *count += 1;
            }
        }
        assert_eq!(inbox.dropped_count(), 0);
    });
    bench.end();
}
