//! `vcan-setup slcan` as a process: lines of all kinds on an embedded bus, and the treatment of their frames.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::slcan;

use std::net::TcpListener;
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixListener;
use std::time::Duration;

use process::{Running, TestDir, until};
use protocol::bus::{Bus, BusOptions, Inbox};
use protocol::can::{ERROR, ERROR_STATE, EXTENDED, EXTENDED_MASK, Frame};
use rustix::process::Signal;
use serde_json::Value;
use slcan::{Peer, Pty, carry};

/// A bus in a place.
struct Bench {
    place: TestDir,
    server: Running,
    client: Bus,
}

fn client(place: &TestDir) -> Bus {
    client_with(place, 0)
}

fn client_with(place: &TestDir, error_mask: u32) -> Bus {
    let options = BusOptions {
        error_mask,
        directory: Some(place.buses()),
        receive_buffer: 64 << 20,
        send_timeout: Duration::from_secs(60),
        ..BusOptions::default()
    };
    until("the bus", || Bus::open("vcan0", "embedded".parse().unwrap(), &options).ok())
}

impl Bench {
    fn new() -> Self {
        let place = TestDir::new();
        let server = place.start("vcan-setup", "serve vcan0");
        server.wait_for_stdout("serving vcan0");
        let client = client(&place);
        Self { place, server, client }
    }

    fn slcan(&self, words: &str) -> Running {
        self.place.start("vcan-setup", &format!("slcan vcan0 --bus-kind embedded {words}"))
    }

    /// Starts the same, and waits until all lines are open.
    fn joined(&self, words: &str) -> Running {
        let bridge = self.slcan(&format!("{words} --json"));
        bridge.wait_for_stderr(" on vcan0 (embedded)");
        bridge
    }

    /// Waits for a number of frames on the bus.
    fn receives(&self, count: usize) -> Vec<Frame> {
        let (mut inbox, mut frames) = (Inbox::new(), Vec::new());
        until("frames on the bus", || {
            while self.client.receive(&mut inbox).unwrap() > 0 {
                frames.extend(inbox.frames().map(|received| received.frame));
            }
            (frames.len() >= count).then_some(())
        });
        frames
    }
}

/// Ends the bridge, and returns the account of each line.
fn ended(bridge: Running) -> Vec<Value> {
    bridge.signal(Signal::TERM);
    let ended = bridge.end().succeeded();
    let mut report: Value = serde_json::from_str(&ended.stdout).unwrap();
    let lines: Vec<Value> = serde_json::from_value(report["lines"].take()).unwrap();
    for line in &lines {
        for way in ["to_line", "to_bus"] {
            let number = |value: &Value| value.as_u64().unwrap();
            let dropped: u64 = line[way]["dropped"].as_object().unwrap().values().map(number).sum();
            assert_eq!(number(&line[way]["received"]), number(&line[way]["sent"]) + dropped, "{line}");
        }
    }
    lines
}

/// Returns frames of every kind.
fn frames(count: usize) -> Vec<Frame> {
    let frame = |number: usize| {
        let id = u32::try_from(number % 0x700).unwrap();
        let data = [u8::try_from(number % 251).unwrap(); 64];
        match number % 5 {
            0 => Frame::classic(id, &data[..number % 9]),
            1 => Frame::fd(id, 1, &data[..16]),
            2 => Frame::fd(id | EXTENDED, 0, &data[..[0, 8, 12, 64][number % 4]]),
            3 => Frame::classic(id << 8 | EXTENDED, &data[..8]),
            _ => Frame::remote(id, 3),
        }
    };
    (0..count).map(|number| frame(number).unwrap()).collect()
}

#[test]
fn frames_of_every_kind_pass_both_ways_and_the_adapter_is_opened_and_closed() {
    for end in [Signal::TERM, Signal::INT] {
        let bench = Bench::new();
        let mut pty = Pty::new();
        let bridge = bench.slcan(&format!("{} --bit-rates 1M/5M --baud 1000000", pty.path.display()));
        bridge.wait_for_stdout("1 line on vcan0 (embedded)\n");
        pty.peer.wait_for_text("\rC\rS8\rY5\rO\r");
        let all = frames(100);
        bench.client.send(&all).unwrap();
        assert_eq!(pty.peer.receives(all.len()), all);
        pty.peer.sends(&all);
        assert_eq!(bench.receives(all.len()), all);
        bridge.signal(end);
        let ended = bridge.end().succeeded();
        pty.peer.wait_for_text("O\r");
        pty.peer.read_available();
        assert!(pty.peer.bytes.ends_with(b"C\r"));
        let name = pty.path.display();
        assert!(
            ended.stdout.ends_with(&format!(
                "\n{name}: opened once, lost never\n  to the line: 100 received, 100 sent\n  to the bus:  100 received, 100 sent\n"
            )),
            "{ended:?}"
        );
        assert_eq!(ended.stderr, "");
    }
}

#[test]
fn a_line_gets_what_its_cell_receives_and_lines_get_each_others_frames_but_not_their_own() {
    let bench = Bench::new();
    let [mut one, mut all] = [Pty::new(), Pty::new()];
    let bridge = bench.joined(&format!("{},cell=12 {}", one.path.display(), all.path.display()));
    let ids = [0x000, 0x001, 0x20C, 0x40C, 0x40D, 0x50C, 0x50D, 0x5FF, 0x60C, 0x70C, 0x7FF];
    let sent = ids.map(|id| Frame::classic(id, &[1]).unwrap());
    bench.client.send(&sent).unwrap();
    assert_eq!(all.peer.receives(ids.len()), sent);
    let own = [0x20C, 0x40C].map(|id| Frame::fd(id, 1, &[2; 16]).unwrap());
    one.peer.sends(&own);
    assert_eq!(all.peer.receives(ids.len() + 2)[ids.len()..], own);
    assert_eq!(bench.receives(2), own);
    let heard: Vec<_> = one.peer.receives(7).iter().map(Frame::id).collect();
    assert_eq!(heard, [0x000, 0x001, 0x40C, 0x50C, 0x5FF, 0x70C, 0x7FF]);
    let [one, all] = ended(bridge).try_into().unwrap();
    assert_eq!((&one["to_line"]["sent"], &all["to_line"]["sent"]), (&7.into(), &13.into()));
}

#[test]
fn garbage_is_counted_and_what_follows_it_is_read() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&format!("{} --classic", pty.path.display()));
    pty.peer.write_bytes(b"\x00\xff\xfe\r\x07z\rV1013\rt12\rt1239\rt9990\r");
    pty.peer.write_bytes(&[b'x'; 100_000]);
    pty.peer.write_bytes(b"\rt123");
    let frame = Frame::classic(0x123, &[5]).unwrap();
    std::thread::sleep(Duration::from_millis(20));
    pty.peer.write_bytes(b"105\r");
    assert_eq!(bench.receives(1), [frame]);
    bench.client.send(&[Frame::fd(1, 1, &[]).unwrap(), frame]).unwrap();
    assert_eq!(pty.peer.receives(1), [frame]);
    until("the losses", || bridge.stderr().contains("FD frames, but the adapter is classic").then_some(()));
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!(line["to_line"]["dropped"]["not_classic"], 1);
    let refused = serde_json::json!({"garbage": 1, "long": 1, "short": 1, "dlc": 1, "identifier": 1});
    assert_eq!(line["to_bus"]["refused"], refused);
    assert_eq!((&line["to_bus"]["bells"], &line["to_bus"]["other_lines"]), (&1.into(), &1.into()));
}

#[test]
fn an_adapter_that_was_deaf_when_it_was_opened_is_opened_again_at_its_first_refusal() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&format!("{} --bit-rates 500k", pty.path.display()));
    pty.peer.wait_for_text("\rC\rS6\rY0\rO\r");
    pty.peer.bytes.clear();
    let frames = [1, 2].map(|id| Frame::classic(id, &[]).unwrap());
    bench.client.send(&frames[..1]).unwrap();
    pty.peer.wait_for_text("t0010\r");
    pty.peer.write_bytes(b"\x07");
    pty.peer.wait_for_text("\rC\rS6\rY0\rO\r");
    bridge.wait_for_stderr("the adapter refuses frames (BEL)");
    bridge.wait_for_stderr("1 more frames to the line lost; total: 1 dropped (refused by the adapter: 1)");
    // It is open now.
    pty.peer.write_bytes(b"\r\r\r");
    bench.client.send(&frames[1..]).unwrap();
    pty.peer.wait_for_text("t0020\r");
    pty.peer.write_bytes(b"z\r\x07z\r");
    pty.peer.sends(&frames);
    assert_eq!(bench.receives(2), frames);
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!((&line["reopened"], &line["to_bus"]["bells"]), (&1.into(), &2.into()), "{line}");
    assert_eq!(pty.peer.bytes.windows(2).filter(|bytes| bytes == b"O\r").count(), 1, "{line}");
}

#[test]
fn a_bit_rate_that_an_adapter_does_not_have_is_reported() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&format!("{} --bit-rates 500k/2M", pty.path.display()));
    // Closing a closed channel is refused as well, and has no effect.
    pty.peer.wait_for_text("C\r");
    pty.peer.write_bytes(b"\x07");
    pty.peer.wait_for_text("S6\r");
    pty.peer.write_bytes(b"\x07");
    bridge.wait_for_stderr("the adapter refused one of the commands S6, Y2 (BEL)");
    pty.peer.wait_for_text("Y2\rO\r");
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!((&line["reopened"], &line["to_line"]["dropped"]["refused"]), (&0.into(), &0.into()), "{line}");
}

#[test]
fn faults_of_an_adapter_are_reported_counted_and_error_frames_on_the_bus() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&pty.path.display().to_string());
    pty.peer.wait_for_text("O\r");
    let errors = client_with(&bench.place, EXTENDED_MASK);
    pty.peer.write_bytes(b"e1a\rsb256256\rF80\r");
    let expected = [(0xA8, [0, 0, 0, 0x19]), (0x40, [0; 4]), (0x88, [0; 4])]
        .map(|(class, [a, b, c, d])| Frame::classic(ERROR | class, &[a, b, c, d, 0, 0, 0, 0]).unwrap());
    let (mut inbox, mut frames) = (Inbox::new(), Vec::new());
    until("error frames", || {
        errors.receive(&mut inbox).unwrap();
        frames.extend(inbox.frames().map(|received| received.frame));
        (frames.len() >= 3).then_some(())
    });
    assert_eq!(frames, expected);
    for fault in ["no ACK", "bus off", "bus error"] {
        until(fault, || bridge.stderr().contains(fault).then_some(()));
    }
    assert!(bridge.stderr().contains(": the adapter reports "), "{}", bridge.stderr());
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!(line["faults"], serde_json::json!({"no ACK": 1, "bus off": 1, "bus error": 1}));
    assert_eq!((&line["to_bus"]["sent"], &line["to_bus"]["other_lines"]), (&3.into(), &0.into()));
}

#[test]
fn the_state_of_a_sender_behind_the_data_is_that_of_the_frame() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&pty.path.display().to_string());
    pty.peer.write_bytes(b"t1232AABB0\rt1232AABB0A510\rt1232AABB0000000F1\rb1232AABBS\rd1232AABB1\r");
    let data = [0xAA, 0xBB];
    let classic = Frame::classic(0x123, &data).unwrap();
    let fd = [1, 0].map(|flags| Frame::fd(0x123, flags | ERROR_STATE, &data).unwrap());
    assert_eq!(bench.receives(5), [classic, classic, classic, fd[0], fd[1]]);
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!((&line["to_bus"]["sent"], &line["to_bus"]["refused"]["long"]), (&5.into(), &0.into()));
}

#[test]
fn a_board_that_opening_its_line_resets_is_left_alone_until_it_has_started() {
    let bench = Bench::new();
    let [mut slow, mut quick] = [Pty::new(), Pty::new()];
    let bridge =
        bench.joined(&format!("{},settle=60 {},settle=0.01", slow.path.display(), quick.path.display()));
    quick.peer.wait_for_text("\rC\rO\r");
    let frame = Frame::classic(1, &[]).unwrap();
    bench.client.send(&[frame]).unwrap();
    assert_eq!(quick.peer.receives(1), [frame]);
    let [first, second] = ended(bridge).try_into().unwrap();
    slow.peer.read_available();
    assert_eq!(slow.peer.bytes, b"", "nothing was written");
    assert_eq!(
        (&first["to_line"]["dropped"]["line_away"], &second["to_line"]["sent"]),
        (&1.into(), &1.into())
    );
}

/// A line goes away and comes back; `connect` makes its other end. Returns the number of lines that were cut.
fn goes_and_returns(
    bench: &Bench,
    address: &str,
    mut connect: impl FnMut() -> Peer,
    gone: impl Fn(Peer),
) -> u64 {
    let bridge = bench.slcan(&format!("{address} --json --wait"));
    bridge.wait_for_stderr(" on vcan0 (embedded)");
    for round in 0..3_u8 {
        let mut peer = connect();
        peer.wait_for_text("\rC\rO\r");
        let frame = Frame::classic(0x100 + u32::from(round), &[round]).unwrap();
        peer.sends(&[frame]);
        assert_eq!(bench.receives(1), [frame], "{address}");
        bench.client.send(&[frame]).unwrap();
        assert_eq!(peer.receives(1), [frame], "{address}");
        peer.write_bytes(b"t12");
        let before = bridge.stderr().matches(": the line is unavailable (").count();
        gone(peer);
        until("the end to be noticed", || {
            (bridge.stderr().matches(": the line is unavailable (").count() > before).then_some(())
        });
        bench.client.send(&[frame]).unwrap();
    }
    until("all losses", || bridge.stderr().contains("3 dropped (line unavailable: 3)").then_some(()));
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!((&line["opened"], &line["lost"]), (&3.into(), &3.into()), "{line}");
    assert_eq!(line["to_line"]["dropped"]["line_away"], 3, "{line}");
    line["to_bus"]["refused"]["short"].as_u64().unwrap()
}

#[test]
fn a_terminal_goes_and_returns() {
    let bench = Bench::new();
    let path = bench.place.path("tty");
    let slaves = std::cell::RefCell::new(Vec::new());
    let connect = || {
        let Pty { peer, slave, .. } = Pty::under(&path);
        slaves.borrow_mut().push(slave);
        peer
    };
    let short = goes_and_returns(&bench, &path.display().to_string(), connect, |peer| {
        std::fs::remove_file(&path).unwrap();
        drop(peer);
        slaves.borrow_mut().clear();
    });
    // Data that a terminal has not read is lost when it is hung up.
    assert!(short <= 3);
}

#[test]
fn a_unix_socket_goes_and_returns() {
    let bench = Bench::new();
    let path = bench.place.path("cell.sock");
    let connect = || {
        let _ = std::fs::remove_file(&path);
        let listener = UnixListener::bind(&path).unwrap();
        Peer::new(OwnedFd::from(listener.accept().unwrap().0))
    };
    assert_eq!(goes_and_returns(&bench, &format!("unix:{}", path.display()), connect, drop), 3);
}

#[test]
fn a_tcp_socket_goes_and_returns() {
    let bench = Bench::new();
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let connect = || {
        // The other end is gone once it is connected, like a program that ends.
        let listener = TcpListener::bind(("127.0.0.1", port)).unwrap();
        Peer::new(OwnedFd::from(listener.accept().unwrap().0))
    };
    assert_eq!(goes_and_returns(&bench, &format!("tcp:127.0.0.1:{port}"), connect, drop), 3);
}

#[test]
fn what_a_line_is_too_slow_for_is_counted_exactly_and_holds_up_nobody() {
    let bench = Bench::new();
    let path = bench.place.path("slow.sock");
    let listener = UnixListener::bind(&path).unwrap();
    let mut quick = Pty::new();
    let bridge = bench.joined(&format!("unix:{} {}", path.display(), quick.path.display()));
    let mut slow = Peer::new(OwnedFd::from(listener.accept().unwrap().0));
    // One line is not read, and the other one still gets everything.
    let all: Vec<_> = (0..20_000_u32).map(|n| Frame::fd(1, 1, &n.to_le_bytes()).unwrap()).collect();
    for (done, frames) in (1..).zip(all.chunks(100)) {
        bench.client.send(frames).unwrap();
        assert_eq!(quick.peer.receives(100 * done).len(), 100 * done);
    }
    assert_eq!(quick.peer.frames(), all);
    until("a report", || bridge.stderr().contains("line too slow").then_some(()));
    // While it ends, the data in the socket and unfinished lines are read.
    bridge.signal(Signal::TERM);
    while slow.read_available() {
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(!bridge.stderr().contains("not closed"), "{}", bridge.stderr());
    let [line, quick] = ended_already(bridge).try_into().unwrap();
    let count = |key: &str| line["to_line"][key].as_u64().unwrap();
    let dropped = &line["to_line"]["dropped"];
    assert_eq!(count("received") + count("dropped_by_bus"), 20_000);
    assert_eq!(count("sent"), slow.frames().len() as u64);
    assert_eq!(slow.frames(), all[..slow.frames().len()]);
    assert!(dropped["queue_full"].as_u64().unwrap() > 10_000, "{line}");
    assert_eq!(
        dropped["ended"].as_u64().unwrap() + dropped["queue_full"].as_u64().unwrap() + count("sent"),
        count("received")
    );
    assert_eq!(quick["to_line"]["sent"], 20_000);
    assert!(slow.bytes.ends_with(b"\rC\r"), "its adapter was closed");
}

/// Returns the accounts of lines after the bridge got a signal.
fn ended_already(bridge: Running) -> Vec<Value> {
    let mut report: Value = serde_json::from_str(&bridge.end().succeeded().stdout).unwrap();
    serde_json::from_value(report["lines"].take()).unwrap()
}

#[test]
fn a_bus_goes_and_returns() {
    let bench = Bench::new();
    let mut pty = Pty::new();
    let bridge = bench.joined(&pty.path.display().to_string());
    bench.server.signal(Signal::TERM);
    bridge.wait_for_stderr("the bus is unavailable (the embedded bus vcan0 was closed: its server ended)");
    let frame = Frame::classic(0x123, &[5]).unwrap();
    pty.peer.sends(&[frame]);
    let server = bench.place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving");
    bridge.wait_for_stderr("the bus is available again");
    let client = client(&bench.place);
    client.send(&[frame]).unwrap();
    assert_eq!(pty.peer.receives(1), [frame]);
    let [line] = ended(bridge).try_into().unwrap();
    assert_eq!((&line["to_bus"]["received"], &line["to_bus"]["dropped"]["bus_away"]), (&1.into(), &1.into()));
}

#[test]
fn what_cannot_be_is_refused_in_one_line() {
    let bench = Bench::new();
    let pty = Pty::new();
    let (tty, file, socket) = (pty.path.display(), bench.place.write("file", ""), bench.place.path("socket"));
    let _listener = UnixListener::bind(&socket).unwrap();
    let refused = |words: &str, code| bench.slcan(words).end().refusal(code).to_owned();
    let cannot = |what: &str, why: &str| {
        format!("vcan-setup: cannot open {what}: {why}; with --wait, this command opens it when it appears")
    };
    assert_eq!(refused("/dev/none", 1), cannot("/dev/none", "No such file or directory (os error 2)"));
    assert_eq!(refused("unix:/none", 1), cannot("unix:/none", "No such file or directory (os error 2)"));
    assert_eq!(refused("tcp:127.0.0.1:1", 1), cannot("tcp:127.0.0.1:1", "Connection refused (os error 111)"));
    let file = file.display().to_string();
    assert_eq!(refused(&file, 1), format!("vcan-setup: cannot open {file}: it is not a terminal"));
    let path = socket.display().to_string();
    assert_eq!(
        refused(&path, 1),
        format!("vcan-setup: cannot open {path}: it is a socket: write unix:{path}")
    );
    assert_eq!(
        refused(&format!("{tty} {tty}"), 2),
        format!("vcan-setup: {tty} is named twice: name each line once")
    );
    assert_eq!(
        refused(&format!("{tty} --cell 1 --cell 2"), 2),
        "vcan-setup: there are 2 --cell options for 1 lines: give one for each line, or write /dev/ttyACM0,cell=12"
    );
    assert!(refused("ttyACM0", 2).contains("\"ttyACM0\" is not a line: use a form such as /dev/ttyACM0"));
    assert!(
        refused(&format!("{tty} --bit-rates 300k"), 2)
            .contains("--bit-rates 300k: slcan has the bit rates 10k")
    );
    let bridge = bench.joined(&tty.to_string());
    assert_eq!(
        refused(&tty.to_string(), 1),
        format!("vcan-setup: cannot open {tty}: another program uses it; stop that program first")
    );
    // A link to the same terminal is the same terminal.
    let link = bench.place.path("link");
    std::os::unix::fs::symlink(&pty.path, &link).unwrap();
    assert!(refused(&link.display().to_string(), 1).contains("another program uses it"));
    ended(bridge);
    drop(bench.joined(&tty.to_string()));
    ended(bench.joined(&tty.to_string()));
    let nowhere = TestDir::new();
    let refused = nowhere.start("vcan-setup", &format!("slcan vcan0 {tty} --bus-kind embedded")).end();
    assert!(refused.refusal(1).contains("no embedded bus vcan0 is served"));
}

#[test]
fn a_cell_behind_a_line_answers_as_one_on_the_bus() {
    // The cell is on a bus of its own, which stands for the bus behind an adapter.
    let [bench, behind] = [Bench::new(), Bench::new()];
    for place in [&bench.place, &behind.place] {
        place.pressed();
    }
    let [near, far] = [Pty::new(), Pty::new()];
    carry(&near.peer, &far.peer);
    carry(&far.peer, &near.peer);
    let near = bench.joined(&format!("{} --cell 5", near.path.display()));
    let far = behind.joined(&far.path.display().to_string());
    let cells = [("1-4", &bench), ("6-8", &bench), ("5-5", &behind)].map(|(nodes, on)| {
        on.place
            .start("cell-node", &format!("--bus vcan0 --bus-kind embedded --nodes {nodes} --skin skin.toml"))
    });
    let heartbeats =
        |frames: &[Frame]| (1..=8).all(|cell| frames.iter().any(|frame| frame.id() == 0x400 + cell));
    let mut heard = Vec::new();
    until("all cells", || {
        heard.extend(bench.receives(1));
        heartbeats(&heard).then_some(())
    });
    bench.place.bench(3.0, "--no-spawn").end().succeeded();
    let summary = bench.place.summary();
    let [line] = ended(near).try_into().unwrap();
    assert_eq!(line["to_line"]["received"], line["to_line"]["sent"], "{line}");
    assert_eq!(line["to_bus"]["received"], line["to_bus"]["sent"], "{line}");
    let [to_line, to_bus] = ["to_line", "to_bus"].map(|way| line[way]["sent"].as_u64().unwrap());
    let (joints, fifth) = (summary.number("/loop/broadcasts"), &summary.cells()[4]);
    let answers = fifth["in_time"].as_u64().unwrap() + fifth["late"].as_u64().unwrap();
    assert!(joints > 18 && to_line >= joints, "{joints} joints, {line}");
    assert!(answers > 18 && to_bus >= answers, "{answers} answers, {line}");
    assert_eq!(summary.0["buses"][0]["replies"]["unknown"], 0, "{:#}", summary.0["buses"][0]);
    ended(far);
    drop(cells);
}
