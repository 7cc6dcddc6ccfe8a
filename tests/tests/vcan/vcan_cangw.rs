//! Frames that are damaged on their way, on a real kernel: the cells are on `vcan0`, the gateway is on `vcan1`, and the
//! kernel's own CAN gateway between them flips bits as its rules define.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    clippy::indexing_slicing,
    clippy::wildcard_enum_match_arm,
    reason = "a test may stop"
)]

use skinbus_tests::process;

use process::log::Log;
use process::vcan::{Candump, Vcan, command, frames_of, route, small_skin};
use process::{PRESSED, Running, TestDir, until};
use protocol::can::{Format, Frame};
use protocol::id::Node;
use protocol::message::{Message, NetworkPage};
use protocol::packet::{Packet, PacketError};
use rustix::process::Signal;

const CELLS: usize = 8;

/// The bus of the cells and that of the gateway, not connected yet.
struct Parted {
    place: TestDir,
    _cells: Vec<Running>,
    _rules: Rules,
    _vcan1: Vcan,
}

/// The rules of the kernel's gateway, which are removed with the test.
struct Rules;

impl Drop for Rules {
    fn drop(&mut self) {
        let _ = command("cangw -F").status();
    }
}

impl Parted {
    fn new() -> Self {
        let place = TestDir::on_vcan();
        let skin = small_skin(CELLS);
        place.write("cells.toml", &skin);
        place.write("skin.toml", &skin.replace("vcan0", "vcan1"));
        place.scenario(PRESSED);
        let vcan1 = Vcan::make("vcan1");
        let cells = ["1-4", "5-8"].map(|nodes| {
            place.start(
                "cell-node",
                &format!("--bus vcan0 --bus-kind socketcan --nodes {nodes} --skin cells.toml"),
            )
        });
        Self { place, _cells: cells.into(), _rules: Rules, _vcan1: vcan1 }
    }
}

/// Returns a change of data bits, from the first byte on; the part for the identifier is ignored.
fn turned(bits: &str) -> String {
    format!("-M XOR:D:0.0.0.{bits:0<128}")
}

/// Returns how many frames the rule with this filter has passed on, by the kernel's own count.
fn passed(filter: &str) -> usize {
    // Its exit code is not a status: it depends on the length of the kernel's answer.
    let rules = command("cangw -L").output().unwrap().stdout;
    let rules = String::from_utf8(rules).unwrap();
    let rule =
        rules.lines().find(|rule| rule.contains(filter)).unwrap_or_else(|| panic!("{filter}: {rules}"));
    let (_, counts) = rule.split_once("# ").unwrap();
    let &[handled, "handled", "0", "dropped", ..] = &counts.split(' ').collect::<Vec<_>>()[..] else {
        panic!("{counts}")
    };
    handled.parse().unwrap()
}

/// Returns the frames with a wrong CRC, and checks that no frame has another defect.
fn damaged(frames: &[Frame]) -> Vec<&Frame> {
    let is_damaged = |frame: &&Frame| match Packet::from_fd(frame) {
        Ok(_) => false,
        Err(PacketError::Crc { .. }) => true,
        Err(other) => panic!("{frame:?}: {other}"),
    };
    frames.iter().filter(is_damaged).collect()
}

/// Returns the number of frames under an identifier.
fn under(frames: &[Frame], id: u32) -> usize {
    frames.iter().filter(|frame| frame.raw_id() == id).count()
}

/// Returns the number of complete torques.
fn torques(log: &Log) -> u64 {
    log.messages.iter().filter(|(message, _)| matches!(message, Message::Torque { .. })).count() as u64
}

#[test]
#[ignore = "needs vcan"]
fn damaged_torques_are_counted_by_their_crc_and_none_is_used() {
    let bench = Parted::new();
    // Cells 2 and 3, whose first word changes by 4 Nm and whose fourth by one step.
    let (harmed, others) = ("202:C00007FE", "202~C00007FE");
    route("vcan1", "vcan0", "0:0", "");
    route("vcan0", "vcan1", others, "");
    route("vcan0", "vcan1", harmed, &turned("00400000000001"));
    let candump = Candump::start("vcan1", &bench.place.path("candump.log"));
    let ended = bench.place.bench(3.0, "--no-spawn").end().succeeded();
    let (ours, theirs) = (frames_of(&bench.place.path("run.log")), candump.frames());
    let summary = bench.place.summary();
    summary.adds_up();
    summary.all_were_due(CELLS as u64, &ended.stderr);

    let wrong = damaged(&theirs);
    assert!(
        wrong.len() > 12 && wrong.iter().all(|frame| [0x202, 0x203].contains(&frame.raw_id())),
        "{wrong:?}"
    );
    assert_eq!(wrong.len(), under(&theirs, 0x202) + under(&theirs, 0x203), "every one of theirs");
    assert_eq!(damaged(&ours), wrong, "the log has them as they came");
    assert_eq!(passed("202:C00007FE"), wrong.len());
    let wrong = wrong.len() as u64;
    assert_eq!(summary.count("/buses/0/events", "wrong CRC"), wrong);
    assert_eq!((summary.odd(0), summary.of_bus("/uplink/rejected")), (wrong, wrong), "{:#}", summary.0);
    assert_eq!((summary.of_bus("/uplink/surplus"), summary.of_bus("/dropped_by_bus")), (0, 0));
    assert_eq!(summary.of_bus("/replies/lost"), wrong, "each was a reply that was due: {:#}", summary.0);

    // The torques of the other six are all used, and none of the two.
    let log = Log::from_frames(theirs, Format::Fd);
    let used = summary.of_bus("/replies/in_time") + summary.of_bus("/replies/late");
    assert_eq!(used + summary.count("/buses/0/events", "stale torque"), torques(&log));
    assert_eq!(summary.count("/buses/0/received", "torque"), torques(&log) + wrong);
    assert!(summary.count("/buses/0/cells", "active") <= CELLS as u64 - 2, "{:#}", summary.0);
    assert_eq!((summary.of_bus("/epochs_complete"), summary.number("/accuracy/whole/count")), (0, 0));
    assert!(
        summary.of_bus("/epochs_due") > 5 && summary.number("/accuracy/single/count") > 0,
        "{:#}",
        summary.0
    );
    assert!(summary.figure("/accuracy/single/max_nm") < 0.002, "{:#}", summary.0["accuracy"]);
}

#[test]
#[ignore = "needs vcan"]
fn cells_refuse_damaged_joints_count_them_and_are_not_blamed() {
    let bench = Parted::new();
    let (joints, others) = ("001:C00007FF", "001~C00007FF");
    // A rule with a number can be changed while frames pass.
    let with_joints = |change: &str| route("vcan1", "vcan0", joints, &format!("-u 1 {change}"));
    with_joints(&turned(""));
    route("vcan1", "vcan0", others, "");
    route("vcan0", "vcan1", "0:0", "");
    let [gateways, cells] =
        ["vcan1", "vcan0"].map(|bus| Candump::start(bus, &bench.place.path(&format!("{bus}.log"))));
    let run = bench.place.running_bench(600.0, "--no-spawn");
    let more = |count: usize| {
        let enough = passed(joints) + count;
        until("more joints", || (passed(joints) >= enough).then_some(()));
    };
    more(10);
    with_joints(&turned("000080"));
    more(20);
    with_joints(&turned(""));
    more(5);
    run.signal(Signal::TERM);
    let ended = run.end().succeeded();
    let [gateways, cells] = [gateways, cells].map(Candump::frames);

    let wrong = damaged(&cells);
    assert!(wrong.len() >= 19 && wrong.iter().all(|frame| frame.raw_id() == 1), "{wrong:?}");
    assert_eq!(damaged(&gateways).len(), 0, "what cells see is nothing to the other side");
    let (sent, came) = (under(&gateways, 1), under(&cells, 1));
    assert_eq!((sent, passed(joints)), (came, came));
    let wrong = wrong.len() as u64;

    let summary = bench.place.summary();
    summary.adds_up();
    assert_eq!((summary.number("/loop/broadcasts"), summary.odd(0)), (sent as u64, 0), "{:#}", summary.0);
    summary.all_were_due(CELLS as u64, &ended.stderr);
    assert_eq!(summary.of_bus("/replies/not_heard"), CELLS as u64 * wrong, "{:#}", summary.0);
    assert_eq!((summary.of_bus("/replies/lost"), summary.of_bus("/uplink/rejected")), (0, 0));
    let complete = summary.of_bus("/epochs_complete");
    assert!(complete > 0 && complete <= sent as u64 - wrong, "{complete} of {sent}");

    // Each cell reports it itself, at the end of the run.
    let log = Log::from_frames(gateways, Format::Fd);
    for cell in 1..=CELLS {
        let refused = log.messages.iter().rev().find_map(|(message, _)| match message {
            Message::Network { from: Node::Cell(from), page: NetworkPage::Rejected(refused), .. } => {
                (usize::from(from.get()) == cell).then_some(*refused)
            }
            _ => None,
        });
        let refused = refused.unwrap();
        assert_eq!((u64::from(refused.crc), refused.length, refused.meaning), (wrong, 0, 0), "cell {cell}");
    }
}

#[test]
#[ignore = "needs vcan"]
fn a_torque_under_another_cells_number_is_refused_because_the_crc_covers_the_identifier() {
    let bench = Parted::new();
    // Only the identifier changes: cell 3's torques arrive under cell 5's node id.
    let (third, others) = ("203:C00007FF", "203~C00007FF");
    route("vcan1", "vcan0", "0:0", "");
    route("vcan0", "vcan1", others, "");
    route("vcan0", "vcan1", third, &format!("-M SET:I:205.0.0.{:0<128}", ""));
    let candump = Candump::start("vcan1", &bench.place.path("candump.log"));
    let ended = bench.place.bench(3.0, "--no-spawn").end().succeeded();
    let theirs = candump.frames();
    let wrong = damaged(&theirs);
    let fifth = |frame: &&Frame| frame.raw_id() == 0x205;
    assert!(wrong.len() > 6 && wrong.iter().all(fifth), "{wrong:?}");
    assert_eq!((under(&theirs, 0x203), passed(third)), (0, wrong.len()));
    let wrong = wrong.len() as u64;

    let summary = bench.place.summary();
    summary.all_were_due(CELLS as u64, &ended.stderr);
    let of = |pointer: &str| summary.of_bus(pointer);
    assert_eq!((summary.count("/buses/0/events", "wrong CRC"), summary.odd(0)), (wrong, wrong));
    // According to the bus, this number of cell 3's never came, and cell 5 never sent as many.
    let (rejected, surplus, unknown) = (of("/uplink/rejected"), of("/uplink/surplus"), of("/uplink/unknown"));
    assert_eq!((rejected, surplus, unknown), (wrong, wrong, wrong), "{:#}", summary.0);
    assert_eq!((of("/replies/lost"), of("/replies/unknown")), (wrong, 0), "{:#}", summary.0);
    let used =
        of("/replies/in_time") + of("/replies/late") + summary.count("/buses/0/events", "stale torque");
    assert_eq!(used, torques(&Log::from_frames(theirs, Format::Fd)), "{:#}", summary.0);
    assert!(summary.count("/buses/0/cells", "active") < CELLS as u64, "{:#}", summary.0);
    assert!(summary.figure("/accuracy/single/max_nm") < 0.002, "{:#}", summary.0["accuracy"]);
}
