//! `gateway dump`, `frame`, `ack` and `skin` as processes.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use protocol::bus::{Bus, BusKind, Choice, Inbox, Options};
use protocol::can::{Format, Frame};
use protocol::candump::{self, Line};
use protocol::message::Message;
use protocol::packet::{Half, Packet, Paired, data_id};
use protocol::time::Micros;
use rustix::process::{Pid, Signal, kill_process};
use tempfile::TempDir;
use vcan_setup::embedded::Served;

const DOCUMENT: &str = include_str!("../../docs/protocol.md");
const FD: &str = include_str!("../../protocol/tests/golden/fd.log");

fn gateway(arguments: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gateway"));
    command.args(arguments.split(' ').filter(|word| !word.is_empty()));
    command.env("NO_COLOR", "1").env("SKINBUS_DIR", "/nowhere/skinbus");
    command
}

fn golden(name: &str) -> String {
    format!("{}/../protocol/tests/golden/{name}", env!("CARGO_MANIFEST_DIR"))
}

fn text(bytes: &[u8]) -> &str {
    std::str::from_utf8(bytes).unwrap()
}

/// Standard output of a command that is done well and has nothing to complain of.
fn output(mut command: Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""), "{command:?}");
    text(&stdout).to_owned()
}

/// What a command says that ends with this code and prints nothing: one line.
fn refusal(arguments: &str, code: i32) -> String {
    let Output { status, stdout, stderr } = gateway(arguments).output().unwrap();
    let said = text(&stderr);
    assert_eq!((status.code(), text(&stdout)), (Some(code), ""), "{arguments}: {said}");
    assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
    said.trim_end().to_owned()
}

/// The decoded part of each line.
fn decoded(shown: &str) -> Vec<&str> {
    shown.lines().map(|line| line.split_once('\t').unwrap().1).collect()
}

#[test]
fn a_log_is_shown_as_it_is_with_its_meaning_beside_it() {
    for name in ["fd.log", "classic.log", "bad.log", "session.log"] {
        let log = std::fs::read_to_string(golden(name)).unwrap();
        let frames: Vec<&str> = log.lines().filter(|line| line.starts_with('(')).collect();
        let shown = output(gateway(&format!("dump {}", golden(name))));
        let raw: Vec<&str> = shown.lines().map(|line| line.split_once('\t').unwrap().0).collect();
        assert_eq!(raw, frames, "{name}");
    }
    let shown = output(gateway(&format!("dump {} --max 5", golden("document.log"))));
    let expected = "(1700000000.001000) vcan0 20C##5001000F80100000000000000070175D6\t\
                    ok      torque 12 epoch 7: 1.0000 -0.5000 0.0002 0.0000 0.0000 0.0000 Nm";
    assert_eq!((shown.lines().count(), shown.lines().next()), (5, Some(expected)));
}

#[test]
fn times_names_and_directions_are_those_of_the_log() {
    let mut child = gateway("dump -").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let log = "(0000000012.000034567)   can0  123#11.22 T\r\n# more\n\n(1.000000) slcan0 20c##1 R";
    child.stdin.take().unwrap().write_all(log.as_bytes()).unwrap();
    let Output { status, stdout, .. } = child.wait_with_output().unwrap();
    let expected = "(12.000034567) can0 123#1122 T\tforeign no packet: 2 data bytes, not 8\n\
                    (1.000000) slcan0 20C##1 R\tforeign no packet: 0 data bytes, not 16\n";
    assert_eq!((status.code(), text(&stdout)), (Some(0), expected));
}

#[test]
fn filters_pick_by_kind_node_and_time() {
    let dump = |filters: &str| {
        let shown = output(gateway(&format!("dump {} {filters}", golden("session.log"))));
        decoded(&shown).into_iter().map(str::to_owned).collect::<Vec<_>>()
    };
    let torques = [
        "ok      torque 12 epoch 7: -0.2625 0.7800 0.0000 0.0000 0.0000 0.0000 Nm",
        "ok      torque 12 epoch 8: 0.0000 0.0000 0.0000 0.0000 0.0000 0.0000 Nm",
    ];
    assert_eq!(dump("--kind torque"), torques);
    assert_eq!(dump("--kind torque --max 1"), torques[..1]);
    assert_eq!(dump("--kind sync,report --node gateway"), ["ok      sync", "ok      report"]);
    assert_eq!(dump("--kind torque --node 13"), [""; 0]);
    assert_eq!(dump("--node 12,gateway").len(), dump("").len());
    // Frames come 1 ms apart.
    assert_eq!(dump("--from 0.002 --to 0.005"), dump("")[2..5]);
    let classic = output(gateway(&format!("dump {} --from 0.0005 --max 2", golden("classic.log"))));
    let pair =
        ["half    joints", "ok      joints epoch 255: -3.1416 3.1415 -0.0001 0.0001 1.5708 -1.5708 rad"];
    assert_eq!(decoded(&classic), pair);
    let only_fd = output(gateway(&format!("dump {} --format fd --max 1", golden("classic.log"))));
    assert_eq!(decoded(&only_fd), ["foreign no packet: 8 data bytes, not 16"]);
}

#[test]
fn lines_that_cannot_be_read_are_named_and_the_others_shown() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("odd.log");
    let log = b"(1.000000) vcan0 000##500000000000000000000000000000A6A\n\
                (1.000000) vcan0 12#11\n\
                DROPCOUNT: dropped 12 CAN frames on 'vcan0' socket (total drops 40)\n\
                (1.000000) vcan0 \xff\n\
                (1.000000) vcan0 00242###81000000000011.\n\
                (1.000000) vcan0 1F334455#R4\n";
    std::fs::write(&file, log).unwrap();
    let Output { status, stdout, stderr } = gateway("dump").arg(&file).output().unwrap();
    assert_eq!(status.code(), Some(0));
    assert_eq!(decoded(text(&stdout)), ["ok      halt", "foreign remote frame"]);
    let name = file.display();
    let expected = format!(
        "{name}:2: column 18: an identifier of 3 or 8 hexadecimal digits\n\
         {name}:3: 12 frames are missing here: candump lost them\n\
         {name}:4: column 18: an identifier of 3 or 8 hexadecimal digits\n\
         {name}: 2 of 6 lines could not be read\n\
         {name}: CAN XL frames are not shown: 1\n"
    );
    assert_eq!(text(&stderr), expected);
}

#[test]
fn a_reader_that_leaves_ends_it_quietly() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("long.log");
    std::fs::write(&file, FD.repeat(200)).unwrap();
    let mut child = gateway("dump").arg(&file).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    BufReader::with_capacity(16, child.stdout.take().unwrap()).read_line(&mut line).unwrap();
    assert!(line.ends_with("\tok      halt\n"), "{line}");
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
}

#[test]
fn frames_are_those_of_the_document() {
    let pose = "0.1 0.05 0.06 0 0.8 0.6";
    let half_pi = "1.5707963267948966";
    for (arguments, tag) in [
        ("halt".to_owned(), None),
        ("sync".to_owned(), None),
        ("resume".to_owned(), None),
        ("joints --epoch 7 --rad 0 -1.2 1.0 -1.4 -1.57 0".to_owned(), None),
        ("joints --epoch 7 --words 0 0xCF1C 0x28BE 0xC6F5 0xC008 0".to_owned(), None),
        ("configure --node 12 --write mount 2 6".to_owned(), Some(1)),
        (format!("configure --node 12 --write pose {pose}"), Some(2)),
        ("configure --node 12 --write contact 1 0 0.1 0.05 0.1".to_owned(), Some(3)),
        ("configure --node 12 --write timing 16000".to_owned(), Some(4)),
        (format!("configure --node 12 --write row1 0 0.089159 {half_pi} 0"), Some(5)),
        ("configure --node 12 --write row2 -0.425 0 0 0".to_owned(), Some(6)),
        ("configure --node 12 --write row3 -0.39225 0 0 0".to_owned(), Some(7)),
        (format!("configure --node 12 --write row4 0 0.10915 {half_pi} 0"), Some(8)),
        (format!("configure --node 12 --write row5 0 0.09465 -{half_pi} 0"), Some(9)),
        ("configure --node 12 --write row6 0 0.0823 0 0".to_owned(), Some(10)),
        ("configure --node 12 --write commit 266D".to_owned(), Some(11)),
        ("configure --node 12 --write mode 1".to_owned(), Some(12)),
        ("stimulus --node 12 --force 3.0".to_owned(), None),
        ("stimulus --node 12".to_owned(), None),
    ] {
        let tag = tag.map(|tag| format!(" --tag {tag}")).unwrap_or_default();
        let line = output(gateway(&format!("frame {arguments}{tag}")));
        let (id, data) = line.trim_end().split_once("##1").unwrap();
        let there = [1, 5].iter().any(|flags| DOCUMENT.contains(&format!("{id}##{flags}{data}")));
        assert!(there, "{arguments}: {line}is not in the document");
    }
    // The document writes these with the very flags.
    let line = output(gateway("frame stimulus --node 12 --force 3.0"));
    assert!(DOCUMENT.contains(&format!("cansend vcan0 {}", line.trim_end())), "{line}");
}

#[test]
fn frames_mean_what_was_asked_for() {
    for (arguments, meaning) in [
        ("report", "report"),
        (
            "stimulus --node everyone --epoch 7 --force 1 --proximity 0.5 --temperature 25 -40",
            "stimulus everyone from epoch 7 on: force 1.000 N (0.334 0.333 0.333), proximity 0.5000, temperature 25.00 -40.00 °C",
        ),
        (
            "stimulus --node 254 --acceleration 0 -1 0.5",
            "stimulus 254 from the next joints on: acceleration 0.0000 -1.0000 0.5000 g",
        ),
        ("configure --node everyone --read identity --tag 255", "configure everyone tag 255: read identity"),
        (
            "configure --node 1 --write 99 1 -1 0x7FFF",
            "configure 1 tag 0: write parameter 99: words 1 -1 32767 0 0 0",
        ),
    ] {
        for format in [Format::Fd, Format::Classic] {
            let name = if format == Format::Fd { "fd" } else { "classic" };
            let lines = output(gateway(&format!("frame {arguments} --format {name}")));
            let frames: Vec<_> = lines.lines().map(|line| candump::parse_frame(line).unwrap()).collect();
            Message::decode(&packet(&frames, format)).unwrap();
            let log: String = lines.lines().map(|line| format!("(1.000000) vcan0 {line}\n")).collect();
            let directory = TempDir::new().unwrap();
            let file = directory.path().join("frames.log");
            std::fs::write(&file, log).unwrap();
            let shown = output(gateway(&format!("dump {}", file.display())));
            assert_eq!(*decoded(&shown).last().unwrap(), format!("ok      {meaning}"), "{arguments}");
        }
    }
}

/// The packet in one FD frame or two classic ones.
fn packet(frames: &[Frame], format: Format) -> Packet {
    match (format, frames) {
        (Format::Fd, [frame]) => Packet::from_fd(frame).unwrap(),
        (Format::Classic, [first, second]) => {
            let mut half = Half::NONE;
            let mut push =
                |frame: &Frame| half.push(Micros(0), data_id(frame).unwrap(), frame.data()).unwrap();
            assert_eq!(push(first), Paired::Waiting);
            let Paired::Whole(packet) = push(second) else { panic!("{frames:?}") };
            packet
        }
        (Format::Fd | Format::Classic, _) => panic!("{frames:?}"),
    }
}

#[test]
fn wrong_use_is_one_line_and_exit_code_2() {
    for (arguments, expected) in [
        ("frame stimulus --node 300", "--node 300: a cell's number, 1 to 254, or everyone is possible"),
        ("frame stimulus --node 12 --force 100", "--force 100: three contact words say -96 to 95.997 N"),
        ("frame stimulus", "the following required arguments were not provided: --node <NODE>; try '--help'"),
        (
            "frame joints --epoch 256 --rad 0",
            "invalid value '256' for '--epoch <E>': 256 is not in 0..=255; try '--help'",
        ),
        ("frame configure --node 12 --write mode 2", "mode = 2: 0 measures, 1 obeys stimuli"),
        (
            "dump run.log --from -1",
            "invalid value '-1' for '--from <S>': a number of seconds from 0 to 1e9; try '--help'",
        ),
        ("dump / ", "/ is a directory: name a candump log or a bus"),
        (
            "skin generate --cells 255",
            "255 cells do not fit on one bus: a bus has numbers for 254; say --buses 2",
        ),
        ("skin check /nowhere.toml", "/nowhere.toml: No such file or directory (os error 2)"),
        ("xyzzy", "unrecognized subcommand 'xyzzy'; try '--help'"),
    ] {
        assert_eq!(refusal(arguments, 2), format!("gateway: {expected}"), "{arguments}");
    }
    for command in ["dump", "ack"] {
        let said = refusal(&format!("{command} nosuch --bus-kind embedded"), 2);
        let expected = "gateway: there is no file nosuch, and as a bus: no embedded bus nosuch is served in ";
        assert!(said.starts_with(expected), "{said}");
    }
    let said = refusal("dump a/b.log", 2);
    assert!(
        said.starts_with("gateway: there is no file a/b.log, and as a bus: \"a/b.log\" is no bus name"),
        "{said}"
    );
    let skin = format!("{}/Cargo.toml", env!("CARGO_MANIFEST_DIR"));
    let said = refusal(&format!("dump {skin}"), 1);
    assert!(said.contains("there is no frame in "), "{said}");
}

/// A bus of its own for a test.
struct Bench {
    parent: TempDir,
    _served: Served,
}

impl Bench {
    fn new() -> Self {
        let parent = TempDir::new().unwrap();
        let served = Served::start_in(&parent.path().join("skinbus"), "vcan0").unwrap();
        Self { parent, _served: served }
    }

    fn directory(&self) -> PathBuf {
        self.parent.path().join("skinbus")
    }

    fn gateway(&self, arguments: &str) -> Command {
        let mut command = gateway(&format!("{arguments} --bus-kind embedded"));
        command.env("SKINBUS_DIR", self.directory());
        command
    }

    /// A dump that listens already.
    fn dump(&self, arguments: &str) -> Child {
        let mut command = self.gateway(&format!("dump vcan0 {arguments}"));
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        let mut line = [0; 18];
        child.stderr.as_mut().unwrap().read_exact(&mut line).unwrap();
        assert_eq!(text(&line), "vcan0 is embedded\n");
        child
    }

    fn send(&self, arguments: &str) {
        let Output { status, stdout, stderr } = self.gateway(arguments).output().unwrap();
        let said = (status.code(), text(&stdout), text(&stderr));
        assert_eq!(said, (Some(0), "", "sent on vcan0 (embedded)\n"), "{arguments}");
    }

    fn open(&self) -> Bus {
        let (directory, send_patience) = (Some(self.directory()), Duration::from_secs(10));
        let options = Options { directory, send_patience, ..Options::default() };
        Bus::open("vcan0", Choice::Only(BusKind::Embedded), &options).unwrap()
    }
}

#[test]
fn what_is_sent_on_an_embedded_bus_is_shown() {
    let bench = Bench::new();
    let dump = bench.dump("--max 4");
    bench.send("frame stimulus --node 12 --force 3.0 --bus vcan0");
    bench.send("frame sync --bus vcan0 --format classic");
    bench.send("ack vcan0");
    let Output { status, stdout, stderr } = dump.wait_with_output().unwrap();
    let skin = "force 3.000 N (1.000 1.000 1.000), proximity 0.0000, temperature 0.00 0.00 °C";
    let expected = [
        &format!("ok      stimulus 12 from the next joints on: {skin}"),
        "half    sync",
        "ok      sync",
        "ok      resume",
    ];
    assert_eq!(decoded(text(&stdout)), expected);
    assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
    for line in text(&stdout).lines() {
        let raw = line.split_once('\t').unwrap().0;
        let Ok(Line::Frame(record)) = candump::parse(raw) else { panic!("{line}") };
        assert!(record.interface == "vcan0" && record.time.nanos > 0, "{line}");
    }
}

#[test]
fn a_foreign_classic_frame_is_shown_though_nothing_comes_after_it() {
    let bench = Bench::new();
    let mut dump = bench.dump("");
    bench.open().send(&[Frame::classic(0x20C, &[7; 8]).unwrap()]).unwrap();
    // It might be half of a packet, and nobody says so but the time.
    let mut line = String::new();
    BufReader::new(dump.stdout.as_mut().unwrap()).read_line(&mut line).unwrap();
    assert!(line.ends_with("20C#0707070707070707\tforeign no packet: no other half\n"), "{line}");
    kill_process(Pid::from_child(&dump), Signal::INT).unwrap();
    assert_eq!(dump.wait().unwrap().code(), Some(0));
}

#[test]
fn cells_on_a_bus_of_other_people_says_that_frames_came_and_none_was_of_a_cell() {
    let bench = Bench::new();
    let bus = bench.open();
    let mut command = bench.gateway("cells vcan0 --for 1");
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut sent = 0_u64;
    while child.try_wait().unwrap().is_none() {
        // A frame that is not taken, because nobody listens any more, is no matter.
        let _ = bus.send(&[Frame::classic(0x20C, &sent.to_le_bytes()).unwrap()]);
        sent += 1;
        std::thread::sleep(Duration::from_millis(5));
    }
    let Output { status, stderr, .. } = child.wait_with_output().unwrap();
    let said = text(&stderr);
    assert_eq!(status.code(), Some(1), "{said}");
    assert!(said.contains(" frames are none of a cell; `gateway dump` shows them): start them"), "{said}");
}

#[test]
fn a_signal_ends_a_dump_cleanly() {
    let bench = Bench::new();
    let interrupted = |child: Child| {
        kill_process(Pid::from_child(&child), Signal::INT).unwrap();
        let Output { status, stdout, stderr } = child.wait_with_output().unwrap();
        (status.code(), text(&stdout).to_owned(), text(&stderr).to_owned())
    };
    assert_eq!(interrupted(bench.dump("")), (Some(0), String::new(), String::new()));

    let mut child = gateway("dump -").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    let mut input = child.stdin.take().unwrap();
    input.write_all(b"(1.000000) vcan0 003##500000000000000000000000000004782\n").unwrap();
    // It is shown at once, though more may come.
    let mut line = String::new();
    let mut shown = BufReader::new(child.stdout.as_mut().unwrap());
    shown.read_line(&mut line).unwrap();
    assert!(line.ends_with("\tok      resume\n"), "{line}");
    assert_eq!(interrupted(child), (Some(0), String::new(), String::new()));
}

#[test]
fn a_live_bus_is_counted_until_the_end_that_was_asked_for_or_a_signal() {
    let bench = Bench::new();
    let counted = |child: Child| {
        let Output { status, stdout, stderr } = child.wait_with_output().unwrap();
        assert_eq!((status.code(), text(&stderr)), (Some(0), ""));
        let report: serde_json::Value = serde_json::from_slice(&stdout).unwrap();
        (report["format"].clone(), report["frames"].clone())
    };
    let child = bench.dump("--stats --json --max 2");
    (0..2).for_each(|_| bench.send("frame sync --bus vcan0"));
    assert_eq!(counted(child), ("live".into(), 2.into()));

    let child = bench.dump("--stats --json");
    kill_process(Pid::from_child(&child), Signal::INT).unwrap();
    assert_eq!(counted(child), ("live".into(), 0.into()));
}

#[test]
fn a_bus_that_ends_ends_its_dump_with_an_error() {
    let bench = Bench::new();
    let dump = bench.dump("");
    drop(bench);
    let Output { status, stderr, .. } = dump.wait_with_output().unwrap();
    let said = "gateway: the embedded bus vcan0 was closed: its server ended\n";
    assert_eq!((status.code(), text(&stderr)), (Some(1), said));
}

#[test]
fn a_dump_says_what_it_missed_though_its_bus_has_ended() {
    const FLOOD: u32 = 10_000;
    let bench = Bench::new();
    let mut dump = bench.dump("");
    let bus = bench.open();
    // Nobody reads what it shows: the pipe is full, then its socket, then its queue, and the rest is dropped.
    let flood = [Frame::classic(0x123, &[0; 8]).unwrap(); 50];
    (0..FLOOD / 50).for_each(|_| bus.send(&flood).unwrap());
    let mut shown = BufReader::new(dump.stdout.take().unwrap()).lines().map(Result::unwrap);
    // A frame that is shown after all of them brings how many are missing; it may be dropped as well.
    let (after, enough) = (Frame::classic(0x7FF, &[]).unwrap(), AtomicBool::new(false));
    let (heard, sent) = std::thread::scope(|scope| {
        let sender = scope.spawn(|| {
            let mut sent = 0;
            while !enough.load(Ordering::Relaxed) {
                bus.send(&[after]).unwrap();
                sent += 1;
                std::thread::sleep(Duration::from_millis(10));
            }
            sent
        });
        let heard = shown.by_ref().take_while(|line| !line.contains(" 7FF#")).count();
        enough.store(true, Ordering::Relaxed);
        (u32::try_from(heard).unwrap(), sender.join().unwrap())
    });
    drop(bench);
    let Output { status, stderr, .. } = dump.wait_with_output().unwrap();
    let said = text(&stderr);
    let missing = said.strip_prefix("vcan0: ").and_then(|said| {
        said.strip_suffix(
            " frames are missing: they came faster than they were shown\n\
             gateway: the embedded bus vcan0 was closed: its server ended\n",
        )
    });
    let missing: u32 = missing.unwrap_or_else(|| panic!("{said}")).parse().unwrap();
    assert!(heard < FLOOD && (FLOOD - heard..=FLOOD - heard + sent).contains(&missing), "{heard}, {missing}");
    assert_eq!(status.code(), Some(1));
}

#[test]
fn a_skin_tells_ack_its_buses_and_formats() {
    let bench = Bench::new();
    let skin = bench.parent.path().join("skin.toml");
    output(gateway(&format!("skin generate --cells 3 --format classic -o {}", skin.display())));
    let bus = bench.open();
    bench.send(&format!("ack {}", skin.display()));
    let mut inbox = Inbox::new();
    let mut frames = Vec::new();
    while frames.len() < 2 {
        assert!(bus.wait(Some(Duration::from_secs(5))).unwrap(), "{frames:?}");
        bus.receive(&mut inbox).unwrap();
        frames.extend(inbox.frames().map(|received| received.frame));
    }
    assert_eq!(Message::decode(&packet(&frames, Format::Classic)), Ok(Message::Resume));
}

#[test]
fn the_example_is_what_the_command_in_its_header_prints() {
    let example = include_str!("../examples/ur5-253.toml");
    let command = example.lines().next().unwrap().strip_prefix("# gateway ").unwrap();
    assert!(output(gateway(command)) == example, "make it anew with gateway {command}");
}

#[test]
fn a_generated_skin_is_a_whole_file_and_checked_in_a_few_lines() {
    let directory = TempDir::new().unwrap();
    let file = directory.path().join("skin.toml");
    let generate = "skin generate --cells 3 --buses 2 --reply sum";
    assert_eq!(output(gateway(&format!("{generate} -o {}", file.display()))), "");
    assert_eq!(std::fs::read_to_string(&file).unwrap(), output(gateway(generate)));
    assert_eq!(names(directory.path()), ["skin.toml"]);
    let nowhere = directory.path().join("none/skin.toml");
    let nowhere = format!("-o {}", nowhere.display());
    let why = "No such file or directory (os error 2); name a file in a folder that can be written";
    assert_eq!(refusal(&format!("{generate} {nowhere}"), 2), format!("gateway: {nowhere}: {why}"));

    let shown = output(gateway(&format!("skin check {}", file.display())));
    let (hash, lines): (Vec<_>, Vec<_>) = shown.lines().partition(|line| line.starts_with("hash: "));
    let expected = [
        "ur5-3: 3 cells, 2 buses",
        "robot: UR5, 6 joints",
        "timing: control loop 500 Hz, joints 62.5 Hz (every 16000 us), kinesthetic controller",
        "bus vcan0 (fd, sum, slots of 6000 us): 2 cells: 2 on joint 2; root 1",
        "bus vcan1 (fd, sum, slots of 12000 us): 1 cell: 1 on joint 3; root 1",
    ];
    assert_eq!((hash.len(), lines), (1, expected.to_vec()));

    let skin = protocol::skin::Skin::read(&file).unwrap();
    let shown = output(gateway(&format!("skin check --cells {}", file.display())));
    let hash = skin.parameters(&skin.cells[2]).hash();
    assert_eq!(shown.lines().last().unwrap(), format!("vcan1 1 joint 3 serial 200001 hash {hash:04X}"));
}

fn names(directory: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(directory).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn every_command_has_help_with_an_example() {
    for command in [
        "dump",
        "frame",
        "frame halt",
        "frame resume",
        "frame sync",
        "frame report",
        "frame joints",
        "frame stimulus",
        "frame configure",
        "ack",
        "skin generate",
        "skin check",
    ] {
        let help = output(gateway(&format!("{command} --help")));
        assert!(
            help.contains("Example") && help.contains(&format!("  gateway {command}")),
            "{command}: {help}"
        );
    }
}

#[test]
fn a_file_without_an_end_is_read_up_to_a_limit() {
    let said = refusal("skin check /dev/zero", 2);
    assert!(
        said.contains("/dev/zero: it is longer than a skin or a scenario may be: at most 16777216 bytes"),
        "{said}"
    );
}
