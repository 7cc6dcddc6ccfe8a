//! Embedded buses on which frames take time, with real servers, cells and clients.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use std::collections::BTreeSet;
use std::time::Duration;

use bus_model::TransmitQueue;
use protocol::bus::embedded::{ClientHello, FiguresRequest, HelloReply, seqpacket_socket, socket_address};
use protocol::bus::{Bus, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{BIT_RATE_SWITCH, Frame};
use protocol::wire_time::{BitRates, FrameBits};
use rustix::net::{RecvFlags, SendFlags, SocketFlags};
use rustix::process::Signal;
use serde_json::Value;
use skinbus_tests::bus_time::check_record;
use skinbus_tests::process::page::{Page, address, watched_skin};
use skinbus_tests::process::{PRESSED, Running, TestDir, skin, until};
use trace::capture::{CaptureEntry, Reader};

const RATES: &str = "1M/5M";

fn serve(place: &TestDir, options: &str) -> Running {
    let server = place.start("vcan-setup", &format!("serve vcan0 {options}"));
    server.wait_for_stdout("serving vcan0 at ");
    server
}

fn open(place: &TestDir) -> Bus {
    let directory = Some(place.buses());
    let options = BusOptions { filters: vec![Filter::ALL], directory, ..BusOptions::default() };
    Bus::open("vcan0", KindChoice::Only(BusKind::Embedded), &options).unwrap()
}

fn frame(id: u32, data: &[u8]) -> Frame {
    Frame::fd(id, BIT_RATE_SWITCH, data).unwrap()
}

fn nanos(frame: &Frame) -> u64 {
    FrameBits::from_frame(frame).unwrap().nanoseconds(RATES.parse::<BitRates>().unwrap())
}

#[test]
fn frames_are_stamped_with_their_ends_and_refused_when_the_queue_is_full() {
    let place = TestDir::new();
    let server = serve(&place, &format!("--rates {RATES} --queue fifo:3 --record record.txt"));
    let (sender, listener) = (open(&place), open(&place));
    assert!(sender.is_timed() && listener.is_timed());
    let fit = place.start("skinbus", "fit vcan0 --bus-kind embedded");
    fit.wait_for_stderr("vcan0, a bus of kind embedded");
    // A program of version 2 gets the same frames without stamps.
    let older = seqpacket_socket(SocketFlags::empty()).unwrap();
    rustix::net::connect(&older, &socket_address(&place.buses(), "vcan0").unwrap()).unwrap();
    let hello =
        ClientHello { filters: vec![Filter::ALL], buffer: 1 << 20, version: 2, ..ClientHello::default() };
    rustix::net::send(&older, &hello.encode(), SendFlags::empty()).unwrap();
    let mut bytes = [0; 128];
    let (len, _) = rustix::net::recv(&older, &mut bytes, RecvFlags::empty()).unwrap();
    let answer = HelloReply::decode(&bytes[..len]);
    assert!(matches!(answer, Some(HelloReply::Welcome { version: 2, stamps: false, .. })), "{answer:?}");

    // The frames of one call are requested within a few microseconds, much faster than the bus sends them.
    let sent: Vec<_> = (0..8).map(|id| frame(0x100 + id, &[0xAA; 64])).collect();
    sender.send(&sent).unwrap();
    let mut inbox = Inbox::new();
    let mut last = Some(frame(0x7FF, &[]));
    until("the last frame", || {
        sender.receive(&mut inbox).unwrap();
        // The other program has a queue of its own, which is empty.
        if inbox.refused_count() > 0
            && let Some(last) = last.take()
        {
            listener.send(&[last]).unwrap();
        }
        inbox.frames().any(|received| received.frame.id() == 0x7FF).then_some(())
    });
    // The time stamps of a live bus are known to be ends, too.
    fit.signal(Signal::INT);
    let live = fit.end();
    assert!(live.stdout.contains("ends of frames"), "{live:#?}");
    server.signal(Signal::TERM);
    let ended = server.end();
    assert_eq!(ended.code(), Some(0));
    let record = place.read("record.txt");
    let lines: Vec<Vec<&str>> = record.lines().skip(1).map(|line| line.split(' ').collect()).collect();
    let refused = lines.iter().filter(|line| line[0] == "X").count();
    assert!(refused > 0 && refused < 8, "{record}");
    let ends: Vec<u64> = lines.iter().filter(|it| it[0] == "S").map(|it| it[3].parse().unwrap()).collect();
    let starts: Vec<u64> = lines.iter().filter(|it| it[0] == "S").map(|it| it[2].parse().unwrap()).collect();
    assert_eq!(
        record.lines().next().unwrap(),
        "# skinbus timed bus 1 rates 1M/5M queue fifo:3 errors 0 seed 1"
    );
    for (start, end) in starts.iter().skip(1).zip(&ends) {
        assert!(start >= end, "{record}");
    }
    for (line, (start, end)) in
        lines.iter().filter(|line| line[0] == "Q").zip(starts.iter().zip(&ends)).take(8 - refused)
    {
        let frame = protocol::candump::parse_frame(line[4]).unwrap();
        assert_eq!(end - start, nanos(&frame), "{record}");
    }
    let mut older_frames = 0;
    while let Ok((len @ 1.., _)) = rustix::net::recv(&older, &mut bytes, RecvFlags::DONTWAIT) {
        assert!([16, 72].contains(&len), "no stamps, no notices: {len}");
        older_frames += 1;
    }
    assert_eq!(older_frames, ends.len());
    // The listener has sent the last frame and received all others, with the stamps of the record.
    let mut stamped = Vec::new();
    while listener.receive(&mut inbox).is_ok_and(|count| count > 0) {
        stamped.extend(inbox.frames().map(|received| received.at_nanos));
    }
    assert!(!stamped.is_empty() && stamped.iter().all(|stamp| ends.contains(stamp)), "{stamped:?} {ends:?}");
    place.is_left_clean();
}

#[test]
fn a_second_program_computes_the_times_of_a_live_bus_again() {
    for options in ["--queue priority:8", "--queue fifo:8 --bit-errors 0.0001 --seed 3"] {
        let place = TestDir::new();
        place.skin(24);
        place.scenario(PRESSED);
        let server = serve(&place, &format!("--rates {RATES} --record record.txt {options}"));
        place.bench(2.0, "--record run.mcap").end().succeeded();
        place.summary().adds_up();
        server.signal(Signal::TERM);
        server.end().succeeded();
        let figures = check_record(&place.read("record.txt"));
        assert!(figures.sent.len() > 24 * 50 && figures.bench > 0, "{options}: {figures:?}");
        // The recording has the ends of the frames as time stamps, and says so.
        let ends: BTreeSet<_> = figures.sent.iter().map(|sent| sent.end).collect();
        let mut recorded = Reader::open_all(&[place.path("run.mcap")]).unwrap();
        let mut count = 0;
        while let Some(entry) = recorded.next().unwrap() {
            if let CaptureEntry::Frame(record) = entry {
                count += usize::from(ends.contains(&record.time.nanos));
            }
        }
        assert!(count > 24 * 50, "{options}: {count} of {} frames", figures.sent.len());
        assert_eq!(recorded.extras().timed_buses().collect::<Vec<_>>(), ["vcan0"]);
        place.is_left_clean();
    }
}

/// A skin of six cells on a bus on which frames take time.
fn timed_skin() -> String {
    skin(6).replace(
        "format = \"fd\"",
        "format = \"fd\"\nbitrate = 1000000\ndata_bitrate = 5000000\ntime = \"real\"",
    )
}

#[test]
fn a_page_shows_the_slowest_reply_beside_its_bound_and_who_waits() {
    let place = TestDir::new();
    // A busy machine must not halt the robot.
    place.write("skin.toml", &(timed_skin() + "\n[safety]\nbad_cycles = 10000\n"));
    let fit = place.start("skinbus", "fit skin.toml --json").end().succeeded();
    let fit: Value = serde_json::from_str(&fit.stdout).unwrap();
    let bound_ms = fit["buses"][0]["last_answer_us"].as_f64().unwrap() / 1e3;
    let (run, address_of_run) = watched_skin(&place, "--record run.mcap");
    let mut page = Page::new(&address_of_run);
    page.wait_for_snapshot("all cells", |it| it.cells.iter().all(|cell| cell.0 == 1));
    page.press(3, 5.0);
    let is_slow = |said: &Value| said["buses"][0]["timed"]["last_reply_ms"].as_f64() > Some(0.0);
    let said = page.wait_for_status("a reply, and frames that have waited", |said| {
        is_slow(said) && said["buses"][0]["timed"]["queues"]["wait_us"]["count"].as_u64() > Some(0)
    });
    let timed = &said["buses"][0]["timed"];
    assert_eq!(timed["rates"], "1M/5M");
    assert!((timed["bound_ms"].as_f64().unwrap() - bound_ms).abs() < 1e-3, "{timed} {bound_ms}");
    run.signal(Signal::INT);
    run.end();
    place.summary().adds_up();
    // The recording knows that its stamps are ends of frames.
    let view = place.start("skinbus", "view run.mcap");
    let mut page = Page::new(&address(&view));
    page.send(r#"{"do":"play"}"#);
    page.wait_for_status("a slowest reply", is_slow);
    view.signal(Signal::INT);
    view.end();
    place.is_left_clean();
    // On a bus without time there is none.
    let place = TestDir::new();
    place.write("skin.toml", &timed_skin());
    let (run, address_of_run) = watched_skin(&place, "--bus-time none");
    let mut page = Page::new(&address_of_run);
    let said = page.wait_for_status("a state", |said| said["bench"]["buses"][0].is_object());
    assert!(said["buses"][0]["timed"].is_null(), "{said}");
    run.signal(Signal::INT);
    run.end();
    place.is_left_clean();
}

#[test]
fn a_run_on_a_timed_bus_accounts_for_each_reply() {
    let place = TestDir::new();
    place.write("skin.toml", &timed_skin());
    place.scenario(PRESSED);
    let ended = place.bench(2.0, "--record run.mcap").end().succeeded();
    let summary = place.summary();
    summary.adds_up();
    let timed = &summary.0["buses"][0]["timed"];
    assert_eq!(
        (&timed["rates"], &timed["queue"]),
        (&"1M/5M".into(), &TransmitQueue::default().to_string().into())
    );
    assert_eq!(timed["sent"], timed["requested"], "{timed}");
    let bound = &summary.0["buses"][0]["last_reply_bound_us"];
    // The table breaks its texts into lines.
    let words =
        ended.stdout.split([' ', '\n', '│']).filter(|word| !word.is_empty()).collect::<Vec<_>>().join(" ");
    assert!(bound.as_f64() > Some(0.0) && words.contains(" by `skinbus fit`"), "{bound} {}", ended.stdout);
    assert_eq!((timed["refused"].as_u64(), timed["waiting"].as_u64()), (Some(0), Some(0)), "{timed}");
    assert!(timed["beside"].as_u64() > Some(0) && timed["load"].as_f64() > Some(0.0), "{timed}");
    // The report says it, and shows the latest reply beside the bound.
    place.start("skinbus", "report run.mcap -o report.html").end().succeeded();
    let report = place.read("report.html");
    assert!(report.contains("On vcan0 each frame took the time of its bits"), "{report}");
    assert!(report.contains("worst case of skinbus fit"), "{report}");
    let stamps = |words: &str| {
        let ended = place.start("skinbus", words).end().succeeded();
        ended.stdout.contains("ends of frames")
    };
    assert!(stamps("fit run.mcap"));
    assert!(!stamps("fit run.mcap --time-stamps request"));
    // A log cannot say it.
    assert!(stamps("fit run.log --time-stamps end") && !stamps("fit run.log"));
    let refused = place.start("skinbus", "fit skin.toml --time-stamps end").end();
    assert!(refused.refusal(2).contains("--time-stamps is only for frames of"), "{}", refused.stderr);
    // The option goes before the skin.
    place.bench(1.0, "--bus-time none").end().succeeded();
    assert!(place.summary().0["buses"][0]["timed"].is_null());
    place.is_left_clean();
}

#[test]
fn on_a_full_bus_nothing_is_missing_without_a_reason() {
    let place = TestDir::new();
    // Six cells whose replies alone would take the bus more than its time.
    place.write(
        "skin.toml",
        &(skin(6).replace("format = \"fd\"", "format = \"fd\"\nbitrate = 50000")
            + "\n[safety]\nbad_cycles = 10000\n"),
    );
    place.scenario(&PRESSED.replace("[3]", "[1, 2, 3, 4, 5, 6]"));
    let check = |options: &str| {
        let ended = place.bench(6.0, options).end();
        let summary = place.summary();
        summary.adds_up();
        let bus = &summary.0["buses"][0];
        let timed = &bus["timed"];
        assert!(timed["load"].as_f64() > Some(0.9), "{timed}\n{}", ended.stderr);
        assert!(timed["refused"].as_u64() > Some(0), "{timed}");
        assert!(bus["replies"]["in_time"].as_u64() < bus["replies"]["due"].as_u64(), "{bus}");
        for account in ["uplink", "replies"] {
            assert_eq!(bus[account]["unknown"], 0, "{bus}");
        }
        assert_eq!(bus["uplink"]["restarts"], 0, "{bus}");
        timed["requested"].as_u64().unwrap()
    };
    let own = check("--bus-time real:priority:4");
    // The same on a bus that another program serves, and again there: each run counts for itself.
    let server = serve(&place, "--rates 50k --queue priority:4");
    let status = place.start("vcan-setup", "status").end().succeeded();
    let expected = "frames on vcan0 take time: 50k, priority:4, 0 waiting, 0 refused\n";
    assert!(status.stdout.contains(expected), "{}", status.stdout);
    for _ in 0..2 {
        let requested = check("--overwrite");
        assert!((own / 2..own * 3 / 2).contains(&requested), "{requested} of {own}");
    }
    server.signal(Signal::TERM);
    server.end().succeeded();
    place.is_left_clean();
}

#[test]
fn what_cannot_take_time_is_refused() {
    let place = TestDir::new();
    place.pressed();
    let refused = |words: &str, code: i32, why: &str| {
        let ended = place.start("vcan-setup", words).end();
        assert!(ended.refusal(code).contains(why), "{words}: {}", ended.stderr);
    };
    refused("serve vcan0 --queue fifo", 2, "--rates");
    refused("serve vcan0 --rates 1M/5M --queue lifo", 2, "use fifo or priority");
    refused(
        "serve vcan0 --rates 1M/5M --bit-errors 0.5",
        2,
        "the bit error rate 0.5 is out of range: use 0 to 0.01",
    );
    refused("serve vcan0 --rates 9M", 2, "9M");
    place.write("record.txt", "mine");
    refused("serve vcan0 --rates 1M --record record.txt", 1, "cannot create record.txt");
    assert_eq!(place.read("record.txt"), "mine");

    let server = serve(&place, "");
    let figures = FiguresRequest::send("vcan0", Some(&place.buses())).unwrap();
    assert_eq!(figures.receive(Duration::from_secs(60)), Some(Vec::new()), "frames take no time");
    let ended = place.bench(1.0, "--bus-time real").end();
    let why = "vcan0 is served by another program without bit rates: end it, or start it as `vcan-setup serve vcan0 \
               --rates 1M/5M`, or add --bus-time none";
    assert!(ended.refusal(2).contains(why), "{}", ended.stderr);
    server.signal(Signal::TERM);
    server.end().succeeded();

    let server = serve(&place, "--rates 1M/5M");
    let ended = place.start("vcan-setup", "slcan vcan0 /dev/null --bus-kind embedded").end();
    assert!(ended.stderr.contains("frames take time on the embedded bus vcan0"), "{}", ended.stderr);
    let ended = place.start("skinbus", "conformance --bus vcan0 --cell 1").end();
    assert!(
        ended.refusal(2).contains("conformance tests do not support: serve it without --rates"),
        "{ended:#?}"
    );
    server.signal(Signal::TERM);
    server.end().succeeded();
    place.write("skin.toml", &skin(2).replace("format = \"fd\"", "format = \"fd\"\ntime = \"real\""));
    let ended = place.bench(1.0, "").end();
    assert!(
        ended.refusal(2).contains("bus[0].time = \"real\": this bus needs the key bitrate too"),
        "{}",
        ended.stderr
    );
    place.is_left_clean();
}
