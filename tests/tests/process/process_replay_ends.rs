//! Replays that cannot continue or begin: their messages, and the files they leave.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;
use std::time::Duration;

use process::replay::{FRESH, Replayed, by_hand};
use process::{TestDir, until};
use protocol::message::Message;
use rustix::process::Signal;

#[test]
fn an_interrupted_replay_says_how_far_it_came_and_leaves_nothing() {
    let place = TestDir::new();
    place.records(8);
    let replay = place.replay("run.log", &format!("{FRESH} --loop 0"));
    place.test_client().waits_for_epoch(30);
    replay.signal(Signal::INT);
    let ended = replay.end();
    place.is_left_clean();
    let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
    assert_eq!(replayed.0["interrupted"], true);
    replayed.all_came_back_in_time(&ended);
    assert!(ended.stdout.contains("interrupted"), "{}", ended.stdout);
}

#[test]
fn a_bus_that_ends_in_mid_replay_is_one_line_and_a_table() {
    let place = TestDir::new();
    place.records(8);
    let [cells, server] = by_hand(&place, "1-8");
    let replay = place.replay("run.log", "--only inputs");
    place.test_client().waits_for_epoch(30);
    server.signal(Signal::TERM);
    let ended = replay.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let said = "skinbus: the embedded bus vcan0 was closed: its server ended";
    assert_eq!(ended.stderr.lines().filter(|line| line.contains("was closed")).collect::<Vec<_>>(), [said]);
    assert!(ended.stdout.contains("sent") && place.files().contains(&"replay.json".to_owned()), "{ended:#?}");
    drop((cells, server));
}

#[test]
fn frames_that_a_full_bus_does_not_take_are_refused_and_counted() {
    let place = TestDir::new();
    let frames: String =
        (0..20_000_u32).map(|at| format!("(1.{:06}) vcan0 123##1{at:032X}\n", at * 50)).collect();
    place.write("many.log", &frames);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let replay = place.replay("many.log", "SKINBUS_SEND_TIMEOUT_MS=1 --loop 3");
    let test_client = place.test_client();
    until("a frame", || test_client.bus.wait(Some(Duration::from_millis(5))).unwrap().then_some(()));
    server.signal(Signal::STOP);
    until("a stopped server", || process::is_stopped(server.pid()).then_some(()));
    let ended = replay.end_after(Duration::from_secs(120));
    server.signal(Signal::CONT);
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let replayed = Replayed(serde_json::from_str(&place.read("replay.json")).unwrap());
    let [sent, refused, lost] = ["/sent", "/refused", "/lost"].map(|what| replayed.number(what));
    assert!(sent > 0 && refused > 0 && lost == 0 && sent + refused == 60_000, "{:#}", replayed.0);
    assert!(
        ended.stderr.contains(&format!("{refused} frames were refused: a bus stayed full")),
        "{ended:#?}"
    );
}

#[test]
fn a_gateway_and_a_replay_notice_each_other() {
    let place = TestDir::new();
    place.records(8);
    // The next run overwrites its log.
    fs::rename(place.path("run.log"), place.path("old.log")).unwrap();
    let bench = place.running_bench(600.0, "");
    for route in ["", "--expect"] {
        let ended = place.replay("old.log", &format!("--quiet {route}")).end();
        let said =
            "skinbus: another gateway is on vcan0: stop it, or send the capture to another bus with --map";
        assert_eq!(ended.refusal(1), said);
    }
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    // A bus that comes while the replay lasts.
    let replay = place.replay("old.log", FRESH);
    place.test_client().waits_for_epoch(10);
    let joints = protocol::message::Joints { in_use: 6, ..Default::default() };
    place.test_client().send(&Message::Joints { epoch: protocol::packet::Epoch(200), joints });
    let ended = replay.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stderr.contains("skinbus: another gateway is on vcan0"), "{ended:#?}");
    place.is_left_clean();
}

#[test]
fn invalid_input_is_refused_in_one_line() {
    let place = TestDir::new();
    place.skin(3);
    place.write("empty.log", "");
    place.write("none.log", "# nothing\n");
    place.write("some.log", "(1.000000) vcan0 123#00\n(1.) vcan0 123#00\n(3.000000) vcan0 123#00\n");
    place.write("torques.log", "(1.000000) vcan0 20C##5001000F80100000000000000070175D6\n");
    let zip = place.path("some.zip");
    fs::write(&zip, b"PK\x03\x04..............").unwrap();
    for (words, code, said) in [
        ("empty.log", 1, "skinbus: empty.log contains no frames"),
        ("none.log", 1, "skinbus: none.log contains no frames"),
        ("nothing.log", 2, "skinbus: nothing.log: No such file"),
        ("some.zip", 2, "skinbus: some.zip is a zip"),
        ("-", 2, "skinbus: a replay reads its input twice, which is impossible with standard input"),
        (
            "some.log --from 5",
            2,
            "skinbus: there are no frames to send between --from and --to: some.log ends at 2.000 s",
        ),
        ("some.log --from 2 --to 1", 2, "skinbus: --from 2 must be before --to 1"),
        ("some.log --map can0=can1", 2, "skinbus: --map can0=can1: some.log has no bus can0; it has vcan0"),
        ("some.log --bus can0", 2, "skinbus: --bus can0: some.log has no bus can0; it has vcan0"),
        (
            "some.log --map vcan0",
            2,
            "skinbus: invalid value 'vcan0' for '--map <FROM=TO>': use a recorded bus and the bus to",
        ),
        (
            "some.log --speed 101",
            2,
            "skinbus: invalid value '101' for '--speed <X>': use a number from 0.1 to 100",
        ),
        (
            "some.log --speed 0.01",
            2,
            "skinbus: invalid value '0.01' for '--speed <X>': use a number from 0.1 to 100",
        ),
        (
            "some.log --only replies --expect",
            2,
            "skinbus: --expect makes cells answer, but --only would send recorded",
        ),
        ("some.log --expect --spawn", 2, "skinbus: --spawn: some.log contains no skin"),
        (
            "some.log --map vcan0=can9 --spawn --skin skin.toml",
            2,
            "skinbus: --spawn: the capture is sent to can9, but the",
        ),
        ("some.log --spawn --skin nothing.toml", 2, "skinbus: nothing.toml: "),
        ("some.log", 2, "skinbus: no embedded bus vcan0 is served"),
    ] {
        let ended = place
            .replay(
                words.split(' ').next().unwrap(),
                &format!("--quiet {}", words.split_once(' ').map_or("", |(_, more)| more)),
            )
            .end();
        let line = ended.refusal(code);
        assert!(line.starts_with(said), "{words}: {line}");
        assert!(!place.files().contains(&"replay.json".to_owned()), "{words}");
        place.is_left_clean();
    }
    // A recording without heartbeats.
    let ended = place.replay("torques.log", "--expect --spawn --skin skin.toml --quiet").end();
    assert!(
        ended.refusal(1).starts_with("skinbus: these cells of the recording are not on the bus: 12 on vcan0"),
        "{ended:#?}"
    );
}

#[test]
fn an_unreadable_line_is_named_and_omitted_and_times_that_run_backwards_are_reported_once() {
    let place = TestDir::new();
    let log = "(5.000000) vcan0 001#\n(1.) vcan0 123#00\n(5.100000) vcan0 002#00\n(1.000000) vcan0 003#00\n\
               (2.000000) vcan0 004#00\n(5.150000) vcan0 005#00\nDROPCOUNT: dropped 7 CAN frames on 'vcan0' socket (total drops 7)\n";
    place.write("odd.log", log);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let (ended, replayed) = place.replayed("odd.log", "");
    let ended = ended.succeeded();
    let said: Vec<_> = ended.stderr.lines().collect();
    assert_eq!(
        said[..4],
        [
            "odd.log:2: column 4: expected digits of a second",
            "odd.log: lines skipped because they could not be read: 1",
            "odd.log: 7 frames are missing: they were lost during recording",
            "odd.log: time stamps go backwards (first at frame 3, by 4.100 s): a frame that is out of order \
             is sent immediately",
        ]
    );
    assert_eq!((replayed.number("/sent"), replayed.number("/sent_at_once")), (5, 2), "{:#}", replayed.0);
}
