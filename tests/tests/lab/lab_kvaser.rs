//! A real driver under the classic format: two emulated Kvaser controllers on one bus, `can0` and `can1`, with
//! interrupts, a transmit queue of ten frames and bit timing over netlink, and without physics.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop"
)]

use skinbus_tests::process;

use std::fs::{self, OpenOptions};
use std::os::unix::fs::FileExt;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::{Duration, Instant};

use model::generate::{Format as Generated, SkinRequest, generate};
use process::log::{Log, same_torques};
use process::vcan::{Candump, by_identifier, command, frames_of, refused, tool};
use process::{Running, Summary, TIMEOUT, TestDir, until};
use protocol::bus::{Bus, BusError, BusKind, BusOptions, Filter, Inbox, KindChoice};
use protocol::can::{Format, Frame};
use protocol::candump::{CandumpLine, parse};
use protocol::packet::{Length, Lengths, Reassembler, Reassembly, data_frame_id};
use protocol::time::Micros;
use rustix::process::Signal;
use serde_json::Value;

const CONTROLLERS: [&str; 2] = ["can0", "can1"];
const CELLS: usize = 8;

/// Returns a scenario in which the joints stand still and each touch is a step, so that torques depend on little, and
/// two runs share their causes.
fn scenario() -> String {
    let mut text = "version = 1\nduration_s = 600.0\n\n[motion]\nkind = \"hold\"\n\
                    start_rad = [0.0, -1.2, 1.0, -1.4, -1.57, 0.0]\n"
        .to_owned();
    for step in 0..8 {
        let (at, force) = (0.5 * f64::from(step), 0.7 + 0.4 * f64::from(step));
        let length = if step == 7 { 600.0 } else { 0.5 };
        text += &format!(
            "\n[[touch]]\nat_s = {at:?}\nfor_s = {length:?}\nall = true\nforce_n = {force:?}\nprofile = \"step\"\n"
        );
    }
    text
}

/// Both controllers at 1 Mbit/s and up; they go down again with the test.
struct Controllers;

impl Controllers {
    fn up() -> Self {
        // Their driver answers; vcan would refuse a bit rate.
        for name in CONTROLLERS {
            tool(&format!("ip link set {name} down"));
            tool(&format!("ip link set {name} type can bitrate 1000000"));
            tool(&format!("ip link set {name} txqueuelen 10 up"));
        }
        Self
    }

    /// Blocks the interrupts of both controllers: completed transmissions go unnoticed, and their queues fill. The
    /// controllers share an interrupt, so both or none are blocked.
    fn hang(&self) -> Hanging {
        Hanging::new()
    }
}

impl Drop for Controllers {
    fn drop(&mut self) {
        for name in CONTROLLERS {
            let _ = command(&format!("ip link set {name} down")).status();
        }
    }
}

/// Controllers whose interrupts are disabled by a bit of their PCI command registers.
struct Hanging(Vec<PathBuf>);

impl Hanging {
    /// The offset of the register, which has 16 bits, and its bit that disables interrupts.
    const COMMAND: u64 = 4;
    const NO_INTERRUPTS: u16 = 0x0400;

    fn new() -> Self {
        let path = |name| PathBuf::from(format!("/sys/bus/pci/devices/{}/config", address(name)));
        let hanging = Self(CONTROLLERS.map(path).into());
        hanging.set(|word| word | Self::NO_INTERRUPTS);
        hanging
    }

    fn set(&self, change: impl Fn(u16) -> u16) {
        for path in &self.0 {
            let file = OpenOptions::new().read(true).write(true).open(path).unwrap();
            let mut word = [0; 2];
            file.read_exact_at(&mut word, Self::COMMAND).unwrap();
            // Both bytes at once: the emulated bus reacts to a write of the first one.
            file.write_all_at(&change(u16::from_le_bytes(word)).to_le_bytes(), Self::COMMAND).unwrap();
        }
    }
}

impl Drop for Hanging {
    fn drop(&mut self) {
        self.set(|word| word & !Self::NO_INTERRUPTS);
    }
}

/// Returns the output of `ip` as JSON.
fn json(words: &str) -> Value {
    serde_json::from_slice(&tool(words).stdout).unwrap()
}

/// Returns a controller's PCI address.
fn address(name: &str) -> String {
    let link = json(&format!("ip -json -details link show {name}"));
    link[0]["parentdev"].as_str().unwrap_or_else(|| panic!("{name} is no PCI device: {link}")).to_owned()
}

fn options(filters: &[Filter]) -> BusOptions {
    BusOptions { fd: false, filters: filters.to_vec(), receive_buffer: 8 << 20, ..BusOptions::default() }
}

fn open(name: &str, options: &BusOptions) -> Result<Bus, BusError> {
    Bus::open(name, KindChoice::Only(BusKind::SocketCan), options)
}

/// Returns a frame that contains its number.
fn numbered(number: u32) -> Frame {
    Frame::classic(0x123, &number.to_le_bytes()).unwrap()
}

/// Receives until this number, and returns all numbers.
fn numbers_until(bus: &Bus, last: u32) -> Vec<u32> {
    let mut inbox = Inbox::new();
    let mut numbers = Vec::new();
    until("the last frame", || {
        bus.receive(&mut inbox).unwrap();
        numbers.extend(
            inbox.frames().map(|received| u32::from_le_bytes(*received.frame.data().first_chunk().unwrap())),
        );
        (numbers.last() == Some(&last)).then_some(())
    });
    assert_eq!(inbox.dropped_count(), 0);
    numbers
}

/// Writes the files of a bench whose gateway and cells are on two interfaces of the same bus.
fn prepare(place: &TestDir, gateway: &str, cells: &str) {
    let target = SkinRequest {
        cells: CELLS,
        broadcast_hz: 20.0,
        format: Generated::Classic,
        ..SkinRequest::default()
    };
    let skin = generate(&target).unwrap();
    place.write("skin.toml", &skin.replace("vcan0", gateway));
    place.write("cells.toml", &skin.replace("vcan0", cells));
    place.scenario(&scenario());
}

/// Starts the cells, in three processes.
fn start_cells(place: &TestDir, kind: BusKind, bus: &str) -> Vec<Running> {
    let cells = ["--nodes 1-3", "--nodes 4-7", "--node 8"].map(|nodes| {
        let words = format!("--bus {bus} --bus-kind {kind} {nodes} --skin cells.toml");
        place.start("cell-node", &words)
    });
    cells.into()
}

/// Starts a bench with these cells.
fn start_bench(place: &TestDir, kind: BusKind, seconds: f64) -> Running {
    let words = format!(
        "run skin.toml --bus-kind {kind} --scenario scenario.toml --duration {seconds} --no-spawn \
         --candump run.log --summary run.json"
    );
    place.start("skinbus", &words)
}

/// Counts the packets in a log, without comments of the recorder, and the segments without a matching one in time.
fn pairs(log: &str) -> (u64, u64) {
    let (mut segments, mut whole, mut incomplete) = (vec![Reassembler::NONE; 1 << 11], 0, 0);
    for line in log.lines().filter(|line| !line.starts_with("# ")) {
        let Ok(CandumpLine::Frame(record)) = parse(line) else { panic!("{line}") };
        let Ok(id) = data_frame_id(&record.frame) else { continue };
        let segment = &mut segments[usize::from(id.to_bits())];
        match segment.push(
            Micros(record.time.nanos / 1_000),
            id,
            Lengths::only(Length::Six),
            record.frame.data(),
        ) {
            Ok(Reassembly::Waiting) => {}
            Ok(Reassembly::Incomplete | Reassembly::Ambiguous) => incomplete += 1,
            Ok(Reassembly::Complete(_)) => whole += 1,
            Err(error) => panic!("{line}: {error}"),
        }
    }
    (whole, incomplete)
}

/// Checks that all packets of a run are accounted for by its log; returns the log and the summary.
fn packets_add_up(place: &TestDir) -> (Log, Summary) {
    let (summary, text) = (place.summary(), place.read("run.log"));
    let (whole, incomplete) = pairs(&text);
    let packets = summary.total("/buses/0/received") + summary.total("/buses/0/sent");
    assert_eq!(
        (whole, incomplete),
        (packets - incomplete, summary.count("/buses/0/events", "incomplete packet"))
    );
    assert_eq!((summary.odd(0), summary.of_bus("/dropped_by_bus")), (incomplete, 0), "{:#}", summary.0);
    assert_eq!(summary.of_bus("/replies/unknown"), 0, "{:#}", summary.0);
    let of = |pointer: &str| summary.of_bus(pointer);
    let reasons = ["dropped", "backlog", "outage", "unknown"];
    let lost: u64 = reasons.map(|reason| of(&format!("/uplink/{reason}"))).iter().sum();
    let arrived = of("/uplink/delivered") + of("/uplink/rejected");
    assert_eq!(of("/uplink/sent") + of("/uplink/surplus"), arrived + lost, "{:#}", summary.0);
    (Log::read(&text, Format::Classic), summary)
}

/// Checks that all packets and replies of a run are accounted for; returns its log.
fn adds_up(place: &TestDir) -> Log {
    let (log, summary) = packets_add_up(place);
    summary.adds_up();
    log
}

/// Waits for torques of cell 1, in two segments each.
fn torques_come(bus: &str) {
    let torque = Filter { id: 0x201, mask: Filter::EXACT_MASK };
    let bus = open(bus, &options(&[torque])).unwrap();
    let (mut inbox, mut segments) = (Inbox::new(), 0);
    until("torques", || {
        segments += bus.receive(&mut inbox).unwrap();
        (segments >= 10).then_some(())
    });
}

/// Runs a bench across both controllers, which must both see the same frames; returns its log.
fn across_controllers() -> Log {
    let place = TestDir::on_vcan();
    prepare(&place, "can0", "can1");
    let candumps = CONTROLLERS.map(|name| Candump::start(name, &place.path(&format!("{name}.log"))));
    let cells = start_cells(&place, BusKind::SocketCan, "can1");
    start_bench(&place, BusKind::SocketCan, 5.0).end().succeeded();
    drop(cells);
    let [near, far] = candumps.map(|candump| {
        let mut frames = candump.frames();
        // Each candump ends with a frame that the other one sees as well.
        frames.retain(|frame| !frame.is_extended());
        by_identifier(&frames)
    });
    assert_eq!(near, far, "both controllers saw the same, each sender's in the same order");
    let summary = place.summary();
    let answered = summary.of_bus("/replies/in_time") + summary.of_bus("/replies/late");
    assert!(answered > 10 * CELLS as u64, "a tenth of what a machine has that is in time: {:#}", summary.0);
    let ours = frames_of(&place.path("run.log"));
    assert!(ours.iter().all(|frame| frame.format() == Format::Classic && frame.len() == 8));
    for (id, ours) in by_identifier(&ours) {
        // Cells send before the gateway listens and after it.
        assert!(near[&id].windows(ours.len()).any(|part| part == ours), "{id:03X} comes in another order");
    }
    adds_up(&place)
}

/// Runs the same bench on the embedded bus.
fn on_the_embedded_bus() -> Log {
    let place = TestDir::new();
    prepare(&place, "vcan0", "vcan0");
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let _cells = start_cells(&place, BusKind::Embedded, "vcan0");
    start_bench(&place, BusKind::Embedded, 5.0).end().succeeded();
    adds_up(&place)
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn classic_cells_across_two_controllers_say_what_they_say_on_the_embedded_bus() {
    let _controllers = Controllers::up();
    let [one, other] = [across_controllers(), on_the_embedded_bus()];
    let (shared, all) = same_torques(&one, &other);
    // A machine that pauses misses some of the eight steps, in either run.
    assert!(shared >= 2 * CELLS, "{shared} of {all} causes are in both runs");
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn a_full_queue_is_waited_for_and_nothing_is_lost_or_sent_twice() {
    const FRAMES: u32 = 2_000;
    let controllers = Controllers::up();
    let receiver = open("can1", &options(&[Filter::ALL])).unwrap();
    let sender = open("can0", &BusOptions { send_timeout: TIMEOUT, ..options(&[]) }).unwrap();
    let frames: Vec<_> = (0..FRAMES).map(numbered).collect();
    for (round, part) in frames.chunks(400).enumerate() {
        let before = refused("can0");
        let hanging = controllers.hang();
        std::thread::scope(|scope| {
            // Frame by frame and in batches, which are different system calls.
            let at_once = if round % 2 == 0 { 1 } else { 100 };
            let sender = &sender;
            scope.spawn(move || part.chunks(at_once).for_each(|some| sender.send(some).unwrap()));
            until("a full queue", || (refused("can0") > before).then_some(()));
            drop(hanging);
        });
    }
    assert_eq!(numbers_until(&receiver, FRAMES - 1), (0..FRAMES).collect::<Vec<_>>());
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn a_queue_that_stays_full_is_given_up_in_time_and_used_again() {
    let controllers = Controllers::up();
    let receiver = open("can1", &options(&[Filter::ALL])).unwrap();
    let timeout = Duration::from_millis(50);
    let patient = open("can0", &BusOptions { send_timeout: timeout, ..options(&[]) }).unwrap();
    let hasty = open("can0", &BusOptions { send_timeout: Duration::ZERO, ..options(&[]) }).unwrap();
    let frames: Vec<_> = (0..40).map(numbered).collect();

    let hanging = controllers.hang();
    let (before, began) = (refused("can0"), Instant::now());
    let error = patient.send(&frames).unwrap_err();
    assert!(began.elapsed() >= timeout);
    // Ten frames in the queue, one in the controller, and one between them if an empty queue is bypassed.
    let sent = error.sent;
    assert!((11..=12).contains(&sent) && error.total == 40, "{error}");
    assert!(error.cause.is_temporary() && matches!(error.cause, BusError::Full { .. }), "{error}");
    let said = "can0 accepted no frame for 50 ms: its queue is full; send less, or check that another node is on \
                the bus";
    assert_eq!(error.to_string(), format!("{said} ({sent} of 40 frames sent)"));
    // It polls every half millisecond, without a busy loop.
    let tries = refused("can0") - before;
    assert!((2..=102).contains(&tries), "{tries} tries in 50 ms");

    // A caller without a time limit tries once.
    let before = refused("can0");
    let error = hasty.send(&frames[sent..]).unwrap_err();
    assert!(error.sent == 0 && matches!(error.cause, BusError::Full { .. }), "{error}");
    assert!(!hasty.try_send_all(&frames[sent..=sent]));
    assert_eq!(refused("can0"), before + 2);

    drop(hanging);
    let rest = u32::try_from(sent).unwrap();
    assert_eq!(numbers_until(&receiver, rest - 1), (0..rest).collect::<Vec<_>>());
    patient.send(&frames[sent..]).unwrap();
    assert_eq!(numbers_until(&receiver, 39), (rest..40).collect::<Vec<_>>());
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn controllers_that_go_down_and_up_in_mid_run_are_survived() {
    let (place, _controllers) = (TestDir::on_vcan(), Controllers::up());
    prepare(&place, "can0", "can1");
    let cells = start_cells(&place, BusKind::SocketCan, "can1");
    let bench = start_bench(&place, BusKind::SocketCan, 600.0);
    bench.wait_for_loop();
    for name in CONTROLLERS {
        torques_come("can0");
        let silent = || bench.stderr().matches("fallen silent").count();
        let before = silent();
        tool(&format!("ip link set {name} down"));
        if name == "can0" {
            bench.wait_for_stderr("can0 is down: bring it up with `ip link set can0 up`");
        }
        // For some broadcasts.
        until("silent cells", || (silent() > before).then_some(()));
        tool(&format!("ip link set {name} up"));
    }
    torques_come("can0");
    bench.signal(Signal::INT);
    let ended = bench.end().succeeded();
    assert!(ended.stderr.contains("can0 works again"), "{}", ended.stderr);
    for cell in &cells {
        assert!(command(&format!("kill -0 {}", cell.pid().as_raw_nonzero())).status().unwrap().success());
    }
    let (_, summary) = packets_add_up(&place);
    assert_eq!(summary.silent().len(), 0, "{:#}", summary.0);
    // Frames that were sent to or by a controller that was down are known to be missing, without the reason.
    assert!(summary.number("/loop/unsent") > 0, "{:#}", summary.0);
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn wires_are_not_simulated_on_a_real_bus() {
    let controllers = Controllers::up();
    assert!(!open("can0", &options(&[])).unwrap().is_virtual().unwrap());
    let place = TestDir::new();
    let (reply, format) = (model::generate::ReplyMode::Sum, Generated::Classic);
    let text = generate(&SkinRequest { cells: CELLS, reply, format, ..SkinRequest::default() }).unwrap();
    place.write("skin.toml", &text.replace("\"vcan0\"", "\"can0\""));
    let cell = place.start("cell-node", "--bus can0 --bus-kind socketcan --node 1 --skin skin.toml");
    let said = "cell-node: can0 is real hardware, but cells that answer with sums simulate their wires with frames that \
                must not be sent there: use a vcan or the embedded bus, or reply = \"torque\"";
    assert_eq!(cell.end().refusal(2), said);
    drop(controllers);
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn error_frames_of_the_driver_are_counted() {
    let (place, controllers) = (TestDir::on_vcan(), Controllers::up());
    prepare(&place, "can1", "can0");
    let _cells = start_cells(&place, BusKind::SocketCan, "can0");
    let candump = Candump::start("can1", &place.path("candump.log"));
    let errors = open("can1", &BusOptions { error_mask: u32::MAX, ..options(&[]) }).unwrap();
    let bench = start_bench(&place, BusKind::SocketCan, 600.0);
    bench.wait_for_loop();
    for _ in 0..2 {
        torques_come("can1");
        // The gateway's controller has room for 64 bytes, which are not read. The cells' controller does not report its
        // transmissions either, and is restarted for each frame.
        let hanging = controllers.hang();
        for _ in 0..10 {
            tool("ip link set can0 down");
            tool("ip link set can0 up");
            // Its queue may be full of the cells' frames, and its controller busy with them.
            command("cansend can0 1ABCDEF0#0102030405060708").stderr(Stdio::null()).status().unwrap();
        }
        drop(hanging);
        let mut inbox = Inbox::new();
        until("an error frame", || (errors.receive(&mut inbox).unwrap() > 0).then_some(()));
        let frames: Vec<_> = inbox.frames().map(|received| received.frame).collect();
        // A controller error (class 4): the receive buffer overflowed (1).
        assert!(
            frames.iter().all(|frame| frame.is_error() && frame.raw_id() & 4 != 0 && frame.data()[1] == 1),
            "{frames:?}"
        );
    }
    torques_come("can1");
    bench.signal(Signal::INT);
    bench.end().succeeded();
    let (ours, theirs) = (frames_of(&place.path("run.log")), candump.frames());
    let [ours, theirs] =
        [&ours, &theirs].map(|frames| frames.iter().filter(|frame| frame.is_error()).count());
    let summary = place.summary();
    let counted = summary.count("/buses/0/events", "error frame");
    assert!(theirs >= 2 && ours == theirs && counted == theirs as u64, "{ours}, {theirs}, {counted}");
}

#[test]
#[ignore = "needs Kvaser controllers"]
fn a_controller_that_is_not_ready_is_refused_with_the_hint() {
    let _controllers = Controllers::up();
    // A driver that has just found its hardware has no bit timing yet.
    let (driver, address) = ("/sys/bus/pci/drivers/kvaser_pci", address("can0"));
    for what in ["unbind", "bind"] {
        fs::write(format!("{driver}/{what}"), &address).unwrap();
    }
    let up = command("ip link set can0 up").output().unwrap();
    assert!(!up.status.success(), "the kernel has nothing to set it up with: {up:?}");
    let error = open("can0", &options(&[Filter::ALL])).unwrap_err();
    assert!(matches!(error, BusError::Down { .. }), "{error}");

    tool("ip link set can0 type can bitrate 1000000");
    tool("ip link set can0 up");
    open("can0", &options(&[Filter::ALL])).unwrap();
    let error = open("can0", &BusOptions { fd: true, ..options(&[]) }).unwrap_err().to_string();
    assert!(error.starts_with("can0 has MTU 16, but CAN FD needs 72"), "{error}");
    assert!(error.contains("or use the classic format"), "{error}");
}
