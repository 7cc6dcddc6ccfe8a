//! The standard tools on a bench: cansend presses and halts, canplayer replays, cangen babbles, log2asc reads.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]
#![allow(clippy::wildcard_enum_match_arm, reason = "a test looks for what it looks for")]

use skinbus_tests::process;

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::Path;

use process::log::{Log, TorqueCause, same_torques};
use process::vcan::{Candump, backlog_drops, cansend, frames_of, small_skin, tool};
use process::{PRESSED, Summary, TestDir};
use protocol::can::{Format, Frame};
use protocol::candump::{CandumpLine, parse};
use protocol::id::{Id, Kind, Node};
use protocol::message::{Message, NetworkPage, RejectedCounts};
use protocol::packet::{Packet, PacketError, WORDS, data_frame_id};
use protocol::skin::Skin;
use rustix::process::Signal;

/// A scenario without touches, in which the arm stands.
const ALONE: &str = r#"version = 1
duration_s = 60.0

[motion]
kind = "hold"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]

[[mode]]
at_s = 0.0
kind = "compare"
"#;

/// A scenario in which the arm swings and the touch comes and goes, so that no two torques are equal.
const MOVING: &str = r#"version = 1
duration_s = 4.0

[motion]
kind = "sine"
start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]
amplitude_rad = [0.3, 0.3, 0.3, 0.3, 0.3, 0.3]
period_s = 3.0

[[touch]]
at_s = 0.0
for_s = 1.7
all = true
force_n = 1.5
profile = "half-sine"

[[touch]]
at_s = 2.2
for_s = 0.9
cells = [1, 3, 5]
force_n = 4.0
profile = "ramp"
"#;

/// Returns a predicate for a torque of a cell; with `pressed`, for one that is more than the end of a contact.
fn torque_of(cell: u8, pressed: bool) -> impl Fn(&Message) -> bool {
    move |message| {
        matches!(message, Message::Torque { from, torque, .. }
            if from.get() == cell && torque.is_zero() != pressed)
    }
}

/// Returns the number of joints before an index; these are the numbers of [`Log::torques`].
fn joints_before(log: &Log, index: usize) -> usize {
    let before = log.messages[..index].iter();
    before.filter(|(message, _)| matches!(message, Message::Joints { .. })).count()
}

#[test]
#[ignore = "needs vcan"]
fn cansend_presses_a_cell_and_its_torque_is_what_the_central_computation_says() {
    let place = TestDir::on_vcan();
    let text = small_skin(4);
    place.write("skin.toml", &text);
    place.scenario(ALONE);
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    cansend(&place, "stimulus --cell 2 --force 3");
    let (answers, pressed) = (Cell::new(0), torque_of(2, true));
    test_client.waits_for("twenty torques of cell 2", |message| {
        answers.set(answers.get() + u32::from(pressed(message)));
        answers.get() == 20
    });
    cansend(&place, "stimulus --cell 2");
    test_client.waits_for("the end of the contact", torque_of(2, false));
    let joints = Cell::new(0);
    test_client.waits_for("joints after that", |message| {
        joints.set(joints.get() + u32::from(matches!(message, Message::Joints { .. })));
        joints.get() == 5
    });
    bench.signal(Signal::TERM);
    bench.end().succeeded();

    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.odd(0), 0, "{:#}", summary.0);
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let torques = log.torques();
    let (ended, pressed): (Vec<_>, Vec<_>) =
        torques.iter().partition(|(_, _, packet)| packet.words == [0; WORDS]);
    assert!(torques.iter().all(|(_, (cell, ..), _)| *cell == 2), "no other cell is pressed");
    assert_eq!(
        (ended.len(), torques.last().unwrap().2.words.is_zero()),
        (1, true),
        "one torque of zeros, the last one"
    );
    assert!(pressed.len() >= 20, "{}", pressed.len());
    for (_, (_, _, contact_state), _) in &pressed {
        assert_eq!(*contact_state, [1_024, 1_024, 1_024, 0, 0, 0], "3 N, a newton in each word of Q5.10");
    }
    // Each of them was due, and compared in every joint that the contact loads.
    let answered = summary.of_bus("/replies/in_time") + summary.of_bus("/replies/late");
    let all = answered + summary.of_bus("/replies/unasked") + summary.of_bus("/replies/too_late");
    assert_eq!(all, torques.len() as u64, "{:#}", summary.0);
    assert!(answered > 2, "{:#}", summary.0);
    let skin = Skin::parse("skin.toml", &text).unwrap();
    let joint = skin.cells.iter().find(|cell| cell.node.get() == 2).unwrap().joint;
    let compared = summary.number("/accuracy/single/count");
    assert!(
        compared >= u64::from(joint) * answered,
        "{compared} of {answered} torques in {joint} joints each"
    );
    assert!(summary.figure("/accuracy/single/mean_nm") < 3e-4, "{:#}", summary.0);
    assert!(summary.figure("/accuracy/single/max_nm") < 2e-3, "{:#}", summary.0);
    // The compared torques are not small.
    let max = pressed.iter().flat_map(|(_, _, packet)| packet.words.first_six()).map(i16::unsigned_abs).max();
    assert!(max > Some(1_024), "a quarter of a newton metre: {max:?}");
}

#[test]
#[ignore = "needs vcan"]
fn cansend_halts_the_cells_and_ack_lets_them_go_on() {
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(4));
    place.scenario(PRESSED);
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for("a torque", torque_of(1, true));
    cansend(&place, "halt");
    bench.wait_for_stderr(
        "the robot is halted: a halt frame was received; `skinbus frame resume --bus vcan0 --bus-kind socketcan` resumes it",
    );
    let test_client = place.test_client();
    let joints = Cell::new(0);
    test_client.waits_for("joints after that", |message| {
        joints.set(joints.get() + u32::from(matches!(message, Message::Joints { .. })));
        joints.get() == 10
    });
    place.start("skinbus", "frame resume --bus vcan0 --bus-kind socketcan").end().succeeded();
    bench.wait_for_stderr("the robot continues");
    let test_client = place.test_client();
    for cell in 1..=4 {
        test_client.waits_for("torques again", torque_of(cell, true));
    }
    bench.signal(Signal::TERM);
    bench.end().succeeded();

    let summary = place.summary();
    summary.adds_up();
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    let log = Log::read(&place.read("run.log"), Format::Fd);
    let halt = log.messages.iter().position(|(message, _)| *message == Message::Halt).unwrap();
    // The gateway has sent a resume too, before its loop began.
    let resumes = log.messages.iter().enumerate().skip(halt);
    let resume = resumes.clone().find(|(_, (message, _))| *message == Message::Resume).unwrap().0;
    let rounds = joints_before(&log, halt)..joints_before(&log, resume);
    assert!(rounds.len() >= 10, "{rounds:?}");
    let torques = log.torques();
    let answers = torques.iter().filter(|(round, ..)| rounds.contains(round)).count();
    assert_eq!(answers, 0, "halted cells answer nothing");
    for cell in 1..=4 {
        let after = torques.iter().filter(|(round, (of, ..), _)| *of == cell && *round >= rounds.end);
        assert!(after.count() > 0, "cell {cell} answers again");
    }
}

/// A reply, with the number of its broadcast.
type Reply = (usize, TorqueCause, [i16; WORDS]);

fn replies(log: &Log) -> BTreeSet<Reply> {
    log.torques()
        .into_iter()
        .map(|(number, cause, packet)| (number, cause, packet.words.first_six()))
        .collect()
}

/// Returns the times and frames of a log that cells receive: joints and stimuli.
fn joints_and_stimuli(log: &Path) -> String {
    let heard = |line: &&str| {
        let Ok(CandumpLine::Frame(record)) = parse(line) else { panic!("{line}") };
        let id = data_frame_id(&record.frame);
        id.is_ok_and(|id| id.kind == Kind::Stimulus || id.to_bits() == 1)
    };
    let text = fs::read_to_string(log).unwrap();
    text.lines().filter(heard).map(|line| format!("{line}\n")).collect()
}

#[test]
#[ignore = "needs vcan"]
fn canplayer_brings_back_every_torque_of_a_recording_bit_for_bit() {
    const CELLS: usize = 6;
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(CELLS));
    place.scenario(MOVING);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    place.bench(4.0, "").end().succeeded();
    let recorded = Log::from_frames(candump.frames(), Format::Fd);
    let summary = place.summary();
    summary.adds_up();
    let unanswered = summary.of_bus("/replies/skipped") + summary.of_bus("/replies/not_heard");
    let torques = replies(&recorded);
    let different: BTreeSet<_> = torques.iter().map(|(_, _, words)| words).collect();
    assert!(different.len() > torques.len() / 2, "{} torques in {}", different.len(), torques.len());

    let text = joints_and_stimuli(&place.path("candump.log"));
    place.write("replay.log", &text);
    // New cells: the last contact state, and the last epoch, are those of the recording.
    let cells = place.start("cell-node", &format!("--bus vcan0 --nodes 1-{CELLS} --skin skin.toml"));
    place.test_client().waits_for_settled_cells(CELLS);
    let candump = Candump::start("vcan0", &place.path("again.log"));
    tool(&format!("canplayer -I {} vcan0=vcan0", place.path("replay.log").display()));
    let test_client = place.test_client();
    cansend(&place, "report");
    let skipped = RefCell::new(BTreeMap::new());
    test_client.waits_for("what the cells have received", |message| {
        if let Message::Network { from: Node::Cell(cell), page: NetworkPage::Received(heard), .. } = message {
            skipped.borrow_mut().insert(cell.get(), heard.joints_late);
        }
        skipped.borrow().len() == CELLS
    });
    let frames = candump.frames();
    drop(cells);
    let sent = frames.iter().filter(|frame| text.contains(&frame_text(frame))).count();
    assert!(sent >= text.lines().count(), "{sent} of {} frames were played", text.lines().count());
    let replayed = Log::from_frames(frames, Format::Fd);
    // Equal causes have equal torques. Cells skip joints when a machine pauses for more than a period, and count them:
    // the same number of replies may be missing, and as many ends of contacts come with later joints.
    same_torques(&recorded, &replayed);
    let again = replies(&replayed);
    let [missing, extra] = [torques.difference(&again), again.difference(&torques)].map(Iterator::count);
    let shared = torques.len() - missing;
    let away = unanswered + skipped.borrow().values().map(|&count| u64::from(count)).sum::<u64>();
    let said = format!("{shared} equal, {missing} missing and {extra} extra, {away} joints skipped");
    // A tenth of the number on a machine that is always in time.
    assert!(shared > 26 && missing.max(extra) as u64 <= away, "{said}");
}

fn frame_text(frame: &Frame) -> String {
    let mut text = String::new();
    protocol::candump::write_frame(&mut text, frame).unwrap();
    text
}

/// The number of cells on the bench that `cangen` disturbs.
const CELLS: u8 = 6;

/// Arguments of `cangen`: babbling identifiers, and everything at random.
const NOISE: &[&str] = &[
    // A node that does not exist, as fast as possible.
    "-g 0 -I 6A0 -L 8 -n 3000",
    "-g 0 -I 6A0 -L 8 -n 3000",
    // The same in packets of our size.
    "-g 0 -f -b -I 2C8 -L 16 -n 1000",
    // Packets that every cell has to check and refuse: joints, a cell's heartbeat, its parameters, its stimuli.
    "-g 0 -I 001 -n 300",
    "-g 0 -f -I 001 -L 16 -n 100",
    "-g 0 -f -b -I 003 -L 12 -n 300",
    "-g 0 -f -I 403 -L 16 -n 50",
    "-g 0 -f -I 502 -L 16 -n 50",
    "-g 0 -f -I 5FF -L 16 -n 50",
    "-g 0 -I 704 -n 300",
    // Frames with a cell's identifier.
    "-g 0 -f -b -I 205 -L 16 -n 50",
    "-g 0 -f -b -I 206 -L 20 -n 50",
    // At random, in every kind of frame.
    "-g 0 -I r -n 500",
    "-g 0 -I r -e -n 500",
    "-g 0 -I r -f -n 500",
    "-g 0 -I r -f -b -E -n 200",
    "-g 0 -I r -f -e -n 200",
    "-g 0 -I r -R -n 200",
    "-g 0 -I r -R -e -n 200",
    "-g 0 -I r -m -n 500",
    // Occasionally, beside the cells' answers.
    "-g 5 -I r -m -n 100",
];

/// Returns true if a node of this bench uses an identifier: cells 1 to [`CELLS`], or the gateway.
fn is_used(id: Id) -> bool {
    let bits = id.to_bits();
    bits <= 0x004 || [0x400, 0x5FF, 0x7FF].contains(&bits) || (bits > 0x0FF && (1..=CELLS).contains(&id.node))
}

/// Returns the reason why a frame cannot be used, as the name of an event, derived from candump's output.
fn reason(frame: &Frame) -> Option<&'static str> {
    match Packet::from_fd(frame) {
        _ if frame.is_error() => Some("error frame"),
        Err(PacketError::Foreign) => Some("foreign"),
        Err(_) if data_frame_id(frame).is_ok_and(|id| !is_used(id)) => Some("foreign"),
        Err(PacketError::Length { .. }) => Some("wrong length"),
        Err(PacketError::Crc { .. }) => Some("wrong CRC"),
        Err(_) => panic!("{frame:?}"),
        Ok(packet) => Message::decode(&packet).is_err().then_some("no meaning"),
    }
}

/// Returns the counts of these frames that a cell has to refuse.
fn refused_by(cell: u8, frames: &[Frame]) -> RejectedCounts {
    let cell = u16::from(cell);
    let heard = [0x000, 0x001, 0x002, 0x003, 0x004, 0x400 + cell, 0x500 + cell, 0x5FF, 0x700 + cell, 0x7FF];
    let mut refused = RejectedCounts::default();
    let hears = |frame: &&Frame| data_frame_id(frame).is_ok_and(|id| heard.contains(&id.to_bits()));
    for frame in frames.iter().filter(hears) {
        match reason(frame) {
            Some("wrong length") => refused.length += 1,
            Some("wrong CRC") => refused.crc += 1,
            Some("no meaning") => refused.meaning += 1,
            Some(other) => panic!("{other}: {frame:?}"),
            None => {}
        }
    }
    refused
}

/// Checks that every frame of a bus is in the gateway's counts, by kind and by reason.
fn all_are_counted(frames: &[Frame], summary: &Summary) {
    let (mut kinds, mut reasons) = (BTreeMap::<_, u64>::new(), BTreeMap::<_, u64>::new());
    for frame in frames {
        if let Ok(id) = data_frame_id(frame)
            && reason(frame) != Some("foreign")
        {
            *kinds.entry(id.kind.name()).or_default() += 1;
        }
        if let Some(reason) = reason(frame) {
            *reasons.entry(reason).or_default() += 1;
        }
    }
    for reason in ["wrong length", "wrong CRC", "no meaning", "foreign", "error frame"] {
        let counted = summary.count("/buses/0/events", reason);
        assert_eq!(
            counted,
            reasons.get(reason).copied().unwrap_or(0),
            "{reason}: {reasons:?}, {:#}",
            summary.0
        );
    }
    for kind in Kind::ALL {
        let counted =
            summary.count("/buses/0/received", kind.name()) + summary.count("/buses/0/sent", kind.name());
        let seen = kinds.get(kind.name()).copied().unwrap_or(0);
        // Cells that are being ended may still send a heartbeat when the gateway no longer listens.
        assert!(
            counted == seen || (kind == Kind::Network && counted < seen),
            "{kind:?}: {counted} of {seen}"
        );
    }
}

#[test]
#[ignore = "needs vcan"]
fn cangen_at_full_speed_disturbs_nobody_and_each_of_its_frames_is_counted() {
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(CELLS.into()));
    place.scenario(PRESSED);
    let mut candump = Candump::start("vcan0", &place.path("candump.log"));
    let backlog = backlog_drops();
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for("a torque", torque_of(1, true));
    for noise in NOISE {
        tool(&format!("cangen vcan0 -i {noise}"));
        // On one processor, every socket needs room for the next frames.
        candump.catch_up();
    }
    // An error frame, which reports a controller as bus-off.
    tool("cansend vcan0 20000040#0000000000000000");
    let test_client = place.test_client();
    for cell in 1..=CELLS {
        test_client.waits_for("torques after that", torque_of(cell, true));
    }
    cansend(&place, "report");
    let reported = RefCell::new(BTreeMap::new());
    test_client.waits_for("what the cells have refused", |message| {
        if let Message::Network { from: Node::Cell(cell), page: NetworkPage::Rejected(refused), .. } = message
        {
            reported.borrow_mut().insert(cell.get(), *refused);
        }
        reported.borrow().len() == usize::from(CELLS)
    });
    bench.signal(Signal::TERM);
    let ended = bench.end().succeeded();
    assert!(!ended.stderr.contains("panicked") && !ended.stderr.contains(" ended ("), "{}", ended.stderr);

    let frames = candump.frames();
    let summary = place.summary();
    summary.adds_up();
    assert_eq!(summary.of_bus("/dropped_by_bus"), 0, "{:#}", summary.0);
    assert_eq!(summary.of_bus("/uplink/restarts"), 0, "{:#}", summary.0);
    assert!(summary.0["halted"].is_null(), "{:#}", summary.0);
    assert_eq!(summary.silent().len(), 0);
    all_are_counted(&frames, &summary);
    let expected: u64 =
        NOISE.iter().map(|noise| noise.rsplit(' ').next().unwrap().parse::<u64>().unwrap()).sum();
    // That error frame, and a frame of candump's each time.
    let expected = expected + 1 + NOISE.len() as u64;
    // A busy kernel drops frames before they reach any socket, and reports nothing to the sender.
    let at_least = expected - (backlog_drops() - backlog);
    assert!(
        (at_least..=expected).contains(&summary.odd(0)),
        "each of cangen's {at_least} to {expected} frames is odd, and nothing else: {:#}",
        summary.0
    );
    for (cell, refused) in &*reported.borrow() {
        assert_eq!(*refused, refused_by(*cell, &frames), "cell {cell}");
    }
    // Frames with a cell's node id from another sender are in the cell's account.
    let of_cells = |frame: &&Frame| {
        data_frame_id(frame).is_ok_and(|Id { kind, node }| {
            kind.is_from_cells() && (1..=CELLS).contains(&node) && reason(frame).is_some()
        })
    };
    let forged = frames.iter().filter(of_cells).count() as u64;
    assert!(forged >= 150);
    assert_eq!(summary.of_bus("/uplink/rejected"), forged, "{:#}", summary.0);
    // The log has all of them too.
    let log = Log::read(&place.read("run.log"), Format::Fd);
    assert_eq!(log.frames.len() as u64, summary.number("/recording/frames"));
    assert_eq!(summary.number("/recording/lost"), 0);
    all_are_counted(&log.frames, &summary);
    // The cells' torques are the same as without noise.
    assert!(summary.figure("/accuracy/single/max_nm") < 2e-3, "{:#}", summary.0);
    let mut by_cause = BTreeMap::new();
    for (_, cause, packet) in log.torques() {
        assert_eq!(*by_cause.entry(cause).or_insert(packet.words), packet.words, "{cause:?}");
    }
}

#[test]
#[ignore = "needs vcan"]
fn the_stock_tools_read_our_log() {
    let place = TestDir::on_vcan();
    place.write("skin.toml", &small_skin(4));
    place.scenario(PRESSED);
    let candump = Candump::start("vcan0", &place.path("candump.log"));
    let bench = place.running_bench(600.0, "");
    place.test_client().waits_for("a torque", torque_of(1, true));
    for noise in ["-I r -m -n 200", "-I r -R -n 20", "-I r -e -n 20", "-I r -f -b -E -n 20"] {
        tool(&format!("cangen vcan0 -i -g 0 {noise}"));
    }
    bench.signal(Signal::TERM);
    bench.end().succeeded();
    let path = place.path("run.log");
    let ours = frames_of(&path);
    assert_eq!(ours.len() as u64, place.summary().number("/recording/frames"));
    assert!(ours.len() > 260, "{} frames, of which cangen sent 260", ours.len());
    // Its output equals candump's exactly.
    candump.frames();
    let texts = |file: &str| {
        let text = place.read(file);
        let frames = text.lines().map(|line| line.rsplit(' ').next().unwrap().to_owned());
        frames.filter(|frame| !frame.starts_with("1BADCAFE#")).collect::<Vec<_>>()
    };
    let mut theirs = BTreeMap::<String, usize>::new();
    for frame in texts("candump.log") {
        *theirs.entry(frame).or_default() += 1;
    }
    for frame in texts("run.log") {
        let left = theirs.get_mut(&frame).filter(|left| **left > 0);
        *left.unwrap_or_else(|| panic!("candump has not seen {frame}")) -= 1;
    }
    // Cells that are being ended may still send a heartbeat when the gateway no longer listens.
    theirs.retain(|frame, left| *left > 0 && !frame.starts_with('4'));
    assert_eq!(theirs, BTreeMap::new(), "candump has seen what we have not");

    let candump = Candump::start("vcan0", &place.path("played.log"));
    let played = tool(&format!("canplayer -t -I {} vcan0=vcan0", path.display()));
    assert_eq!((played.stdout, played.stderr), (vec![], vec![]));
    assert!(candump.frames() == ours, "canplayer plays what we wrote");

    let asc = place.path("run.asc");
    let read = tool(&format!("log2asc -I {} -O {} vcan0", path.display(), asc.display()));
    assert_eq!((read.stdout, read.stderr), (vec![], vec![]));
    // The counterpart converts back, and drops the length of classic remote frames.
    let back = place.path("back.log");
    tool(&format!("asc2log -I {} -O {}", asc.display(), back.display()));
    let back = frames_of(&back);
    assert_eq!(back.len(), ours.len(), "log2asc reads what we wrote");
    for (back, ours) in back.iter().zip(&ours) {
        assert_eq!((back.raw_id(), back.data()), (ours.raw_id(), ours.data()));
    }
}
