//! Recordings of benches of real processes: they are complete, or the missing part is counted.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;
use skinbus_tests::process::recorded;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use analysis::dbc;
use model::generate::Format;
use process::{PRESSED, Summary, TestDir, example, skin_of, until};
use protocol::skin::Skin;
use rand::{RngExt, SeedableRng};
use recorded::Recorded;
use rustix::process::Signal;
use serde_json::Value;

/// Checks that a run's frames are the same in both formats, and as many as the gateway counted.
fn frames_are_whole(lines: &[String], place: &TestDir, summary: &Summary, frames_a_packet: u64) {
    let log = place.read("run.log");
    let first = log.lines().zip(lines).position(|(log, line)| log != line);
    assert_eq!(first, None, "the first line that differs");
    let packets = ["received", "sent"].map(|route| summary.total(&format!("/buses/0/{route}")));
    let counted = packets.iter().sum::<u64>() * frames_a_packet;
    assert_eq!((log.lines().count() as u64, lines.len() as u64), (counted, counted));
    let recorded = ["frames", "lost"].map(|key| summary.number(&format!("/recording/{key}")));
    assert_eq!(recorded, [counted, 0], "{:#}", summary.0);
    assert_eq!(summary.0["recording"]["errors"], Value::Array(vec![]));
}

/// Returns the number of messages on each topic.
fn counts(recorded: &Recorded) -> BTreeMap<&str, u64> {
    let mut counts = BTreeMap::new();
    for message in &recorded.messages {
        *counts.entry(message.topic.as_str()).or_default() += 1;
    }
    counts
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|value| value.as_f64().unwrap_or(f64::NAN)).collect()
}

#[test]
fn everything_that_a_run_knows_is_in_its_recording() {
    let place = TestDir::new();
    place.pressed();
    place.bench(2.0, "--record run.mcap").end().succeeded();
    assert_eq!(place.files(), ["run.json", "run.log", "run.mcap", "scenario.toml", "skin.toml"]);
    let (summary, recorded) = (place.summary(), Recorded::read(&place.path("run.mcap")));
    frames_are_whole(&recorded.lines("/can/vcan0"), &place, &summary, 1);

    let text = place.read("skin.toml");
    let skin = Skin::parse("skin.toml", &text).unwrap();
    let attached: BTreeMap<_, _> = [("skin.toml", text), ("scenario.toml", PRESSED.to_owned())]
        .map(|(name, text)| (name.to_owned(), text.into_bytes()))
        .into();
    assert_eq!(recorded.attachments, attached);
    let names: Vec<_> = recorded.metadata.keys().map(String::as_str).collect();
    assert_eq!(
        names,
        ["configuration", "configuration_hashes", "machine", "part", "program", "recorder", "run"]
    );
    assert!(recorded.metadata["program"]["command_line"].contains("--record run.mcap"));
    assert!(recorded.metadata["configuration"]["bus/vcan0"].starts_with("embedded, fd, receive buffer "));

    // The gateway's own frames are distinguished, and each cell has sent its hash before the first joints.
    let frames: Vec<_> = recorded.on("/can/vcan0").map(|message| &message.value).collect();
    let id = |frame: &Value| frame["id"].as_u64().unwrap();
    let joints = frames.iter().position(|frame| id(frame) == 0x001 && frame["direction"] == 2).unwrap();
    for cell in &skin.cells {
        let heartbeat = 0x400 | u64::from(cell.node.get());
        let said = frames[..joints].iter().find(|frame| id(frame) == heartbeat).unwrap();
        assert_eq!(said["direction"], 1);
        let bytes: Vec<_> =
            said["data"].as_array().unwrap().iter().map(|byte| byte.as_u64().unwrap()).collect();
        let hash = format!("{:04X}", skin.parameters(cell).hash());
        assert_eq!(recorded.metadata["configuration_hashes"][&format!("vcan0/{}", cell.node)], hash);
        let claimed = format!("{:02X}{:02X}", bytes[5], bytes[4]);
        assert!(claimed == hash || claimed == "0000" || claimed == "FFFF", "{claimed} {hash}");
    }

    let counts = counts(&recorded);
    let ticks = summary.number("/loop/ticks");
    let robot = format!("/{}", skin.robot.name);
    for topic in ["joint_states", "joint_commands", "torques"] {
        assert_eq!(counts[format!("{robot}/{topic}").as_str()], ticks, "{counts:?}");
    }
    assert_eq!(counts["/gateway/timing"], ticks);
    assert!(counts["/diagnostics"] >= 1, "{counts:?}");
    assert!(!counts.contains_key("/can/notes") && !counts.contains_key("/state/vcan0"), "{counts:?}");
    let messages: u64 = counts.values().sum();
    assert_eq!(summary.0["recording"]["files"][0]["messages"], messages, "{:#}", summary.0);

    // Every cell is in one patch, with the force of its stimulus and its position on the arm.
    let mut cells = 0;
    for (patch, _) in
        counts.iter().filter(|(topic, _)| topic.starts_with("/skin/") && !topic.ends_with("/points"))
    {
        let last = &recorded.on(patch).last().unwrap().value;
        let (force, status) = (numbers(&last["force"]), numbers(&last["status"]));
        assert!(force.iter().all(|force| (force - 1.5).abs() < 0.01), "{last}");
        // In contact; on a busy machine its last reply may be stale.
        assert!(status.iter().all(|status| (2.0..=3.0).contains(status)), "{last}");
        cells += last["node"].as_array().unwrap().len();
        let points = format!("{patch}/points");
        let cloud = &recorded.on(&points).last().unwrap().value;
        assert_eq!(cloud["width"], force.len(), "{cloud}");
        assert!((1..=counts[patch]).contains(&counts[points.as_str()]), "{counts:?}");
    }
    assert_eq!(cells, skin.cells.len());

    // The arm stands, so at the end the received torque equals the expected one.
    let torques =
        recorded.on(&format!("{robot}/torques")).last().map(|message| message.value.clone()).unwrap();
    let (central, difference) = (numbers(&torques["central"]), numbers(&torques["difference"]));
    assert!(central.iter().any(|torque| torque.abs() > 0.05), "{torques}");
    assert!(difference.iter().all(|nm| nm.abs() < 8.0 * 1e-3), "{torques}");
    let names = format!("{robot}/joint_states");
    let state = &recorded.on(&names).last().unwrap().value;
    assert_eq!(numbers(&state["effort"]), numbers(&torques["distributed"]));
    assert_eq!(state["name"].as_array().unwrap().len(), skin.robot.joints.len());
    assert_eq!(state["position"][1], -1.2);
}

#[test]
fn two_hundred_and_fifty_three_cells_are_recorded_without_a_gap() {
    let place = TestDir::new();
    fs::copy(example("ur5-253.toml"), place.path("skin.toml")).unwrap();
    fs::copy(example("all-active.toml"), place.path("scenario.toml")).unwrap();
    place.bench(3.0, "--record run.mcap").end().succeeded();
    let (summary, recorded) = (place.summary(), Recorded::read(&place.path("run.mcap")));
    frames_are_whole(&recorded.lines("/can/vcan0"), &place, &summary, 1);
    assert!(recorded.on("/can/notes").next().is_none());
    // The part before the first message is small: a recording of little more than that has messages.
    let file = fs::read(place.path("run.mcap")).unwrap();
    fs::write(place.path("cut.mcap"), &file[..300_000]).unwrap();
    place.start("skinbus", "recover cut.mcap").end().succeeded();
    assert!(Recorded::read(&place.path("cut-recovered.mcap")).messages.len() > 1_000);
}

#[test]
fn two_buses_of_classic_frames_have_a_topic_each() {
    let place = TestDir::new();
    place.write("skin.toml", &skin_of(8, 2, Format::Classic));
    place.scenario(PRESSED);
    place.bench(1.0, "--record run.mcap").end().succeeded();
    let recorded = Recorded::read(&place.path("run.mcap"));
    // The log has both buses' frames in the recorder's order, each bus in its own order.
    for bus in ["vcan0", "vcan1"] {
        let lines = recorded.lines(&format!("/can/{bus}"));
        let log = place.read("run.log");
        let log: Vec<_> = log.lines().filter(|line| line.split(' ').nth(1) == Some(bus)).collect();
        assert!(!log.is_empty() && log == lines, "{bus}");
    }
    let described = place.start("skinbus", "skin dbc run.mcap --bus vcan1 --joined").end().succeeded();
    assert_eq!(
        described.stdout,
        dbc::dbc_text(&Skin::parse("skin.toml", &skin_of(8, 2, Format::Classic)).unwrap(), 1)
    );
}

/// Returns the files of a recording in their order.
fn parts(summary: &Summary) -> Vec<String> {
    let files = summary.0["recording"]["files"].as_array().unwrap();
    let mcap = files.iter().filter(|file| file["format"] == "mcap");
    mcap.map(|file| file["path"].as_str().unwrap().to_owned()).collect()
}

#[test]
fn a_recording_in_parts_is_one_recording_and_each_part_can_be_read_alone() {
    let place = TestDir::new();
    place.pressed();
    // Files of an earlier and longer recording.
    for name in ["run.mcap", "run-1.mcap", "run-2.mcap", "run-3.mcap", "run-4.mcap"] {
        place.write(name, "old");
    }
    place.bench(3.0, "--record run.mcap --record-split 1s").end().succeeded();
    let summary = place.summary();
    let parts = parts(&summary);
    assert!(parts.len() >= 3 && parts[0] == "run.mcap" && parts[2] == "run-2.mcap", "{parts:?}");
    let there: Vec<_> = place.files().into_iter().filter(|name| name.ends_with(".mcap")).collect();
    assert_eq!(there.len(), parts.len(), "none of an earlier recording is left: {there:?}");
    let read: Vec<_> = parts.iter().map(|name| Recorded::read(&place.path(name))).collect();
    let lines: Vec<_> = read.iter().flat_map(|part| part.lines("/can/vcan0")).collect();
    frames_are_whole(&lines, &place, &summary, 1);
    for (number, part) in read.iter().enumerate() {
        assert_eq!(part.metadata["part"]["number"], number.to_string());
        assert_eq!(part.attachments["skin.toml"], place.read("skin.toml").into_bytes());
        let force = part.lines("/state/vcan0");
        if number == 0 {
            assert_eq!(force, Vec::<String>::new());
            continue;
        }
        // The latched frames come from the files before: of each cell its start, its last heartbeat, its contact state
        // and its stimulus; the joints at which that was latched, the last ones, and a resume.
        let of = |kind: u32| force.iter().filter(|line| line.contains(&format!(" {kind:X}"))).count();
        let before: Vec<_> = read[..number].iter().flat_map(|part| part.lines("/can/vcan0")).collect();
        assert!(force.iter().all(|line| before.contains(line)), "{force:?}");
        assert_eq!((of(7), of(0)), (8, 3), "{force:?}");
        // A cell that has started claims its node id for two heartbeats.
        assert!((16..=24).contains(&of(4)) && of(3) <= 16, "{force:?}");
    }
}

#[test]
fn a_recording_that_exists_or_cannot_be_is_refused_before_anything_happens() {
    let place = TestDir::new();
    place.pressed();
    let run = "run skin.toml --bus-kind embedded --duration 1";
    let refused = |more: &str| {
        let ended = place.start("skinbus", &format!("{run} {more}")).end();
        ended.refusal(2).to_owned()
    };
    place.write("old.mcap", "somebody's");
    let said = refused("--record old.mcap");
    assert_eq!(said, "skinbus: --record old.mcap: the file exists: name another file, or add --overwrite");
    place.write("late-1.mcap", "somebody's");
    assert!(refused("--record late.mcap").contains("late-1.mcap exists"));
    place.write("old.log", "somebody's");
    let said = refused("--candump old.log");
    assert_eq!(said, "skinbus: --candump old.log: the file exists: name another file, or add --overwrite");
    assert_eq!(
        refused("--record run.log"),
        "skinbus: --record run.log: the name of a recording must end in .mcap"
    );
    fs::create_dir(place.path("dir.mcap")).unwrap();
    assert!(refused("--record dir.mcap").contains("is a directory; name a file"));
    let gone = refused("--record gone/run.mcap");
    let why = "No such file or directory (os error 2); name a file in a folder that can be written";
    assert_eq!(gone, format!("skinbus: --record gone/run.mcap: {why}"));
    assert!(refused("--record run.mcap --record-split 10").contains("use a size of at least 1MB"));
    assert!(
        refused("--record same.mcap --summary same.mcap")
            .contains("--summary and --record name the same file")
    );
    // A run that cannot begin for another reason leaves no file.
    assert!(refused("--record run.mcap SKINBUS_CELL_NODE=/nowhere").contains("/nowhere"));
    assert_eq!(
        place.files(),
        ["dir.mcap", "late-1.mcap", "old.log", "old.mcap", "scenario.toml", "skin.toml"]
    );
    assert_eq!(place.read("old.mcap"), "somebody's");
}

#[test]
fn a_file_that_another_program_moves_while_it_is_written_counts_as_lost_and_the_next_one_begins() {
    let place = TestDir::new();
    place.pressed();
    let bench = place.running_bench(4.0, "--record run.mcap");
    place.test_client().waits_for_joints(20);
    fs::rename(place.path("run.mcap.part"), place.path("elsewhere.mcap")).unwrap();
    let ended = bench.end();
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let summary = place.summary();
    assert_eq!(parts(&summary), ["run-1.mcap"]);
    let frames = |name: &str| Recorded::read(&place.path(name)).lines("/can/vcan0").len() as u64;
    let (moved, kept) = (frames("elsewhere.mcap"), frames("run-1.mcap"));
    assert!(moved > 20 && kept > 20, "{moved} {kept}");
    let of = |key: &str| summary.number(&format!("/recording/{key}"));
    assert_eq!((of("lost_write"), of("frames")), (moved, kept), "{:#}", summary.0);
    let why = summary.0["recording"]["errors"][0].as_str().unwrap();
    assert!(
        why.starts_with("run.mcap.part: another program renamed, removed or replaced this file"),
        "{why}"
    );
    assert!(!place.path("run.mcap").exists());
}

/// Runs a bench in a shell that first runs a command.
fn in_shell(place: &TestDir, before: &str, run: &str, after: &str) -> process::Ended {
    let gateway = process::program("skinbus");
    let script = format!("{before} && {{ {} {run}; code=$?; {after}; exit $code; }}", gateway.display());
    let mut command = place.command_of(Path::new("/bin/sh"), "");
    command.args(["-c", &script]);
    until_it_broke_off(place, process::Running::start(command))
}

/// Ends a bench in a shell some broadcasts after its recording broke off.
fn until_it_broke_off(place: &TestDir, shell: process::Running) -> process::Ended {
    shell.wait_for_stderr("the run continues without recording");
    place.test_client().waits_for_joints(20);
    // The shell's own command line contains the name as well.
    let is_it = |line: &str| line.split(' ').next().is_some_and(|program| program.ends_with("/skinbus"));
    let gateway = place.processes().into_iter().find(|(_, line)| is_it(line));
    let (gateway, _) = gateway.expect("the gateway goes on");
    process::signal(gateway, Signal::TERM);
    shell.end()
}

/// Checks that a run whose recording broke off came to its end, and that everything is in the file or counted.
fn broke_off(place: &TestDir, ended: &process::Ended, why: &str) {
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    assert!(ended.stdout.contains("8 cells"), "the table is complete: {ended:#?}");
    let said: Vec<_> =
        ended.stderr.lines().filter(|line| line.contains("the run continues without recording")).collect();
    assert!(said.iter().all(|line| line.contains(why)), "{ended:#?}");
    assert!(said.first().is_some_and(|line| line.starts_with("run.mcap: ")), "{ended:#?}");
    assert!(
        ended.stderr.lines().last().unwrap().starts_with("skinbus: the recording is incomplete: "),
        "{ended:#?}"
    );
    let summary = place.summary();
    let files = summary.0["recording"]["files"].as_array().unwrap();
    let recordings =
        files.iter().filter_map(|file| file["path"].as_str().filter(|path| path.ends_with(".mcap")));
    // They are listed in the order of their ends; one that broke off may be listed after the next.
    let mut recordings: Vec<_> = recordings.collect();
    recordings.sort_by_key(|path| (path.len(), *path));
    let lines = recordings.into_iter().flat_map(|path| Recorded::read(&place.path(path)).lines("/can/vcan0"));
    let lines: Vec<_> = lines.collect();
    let packets =
        ["received", "sent"].map(|route| summary.total(&format!("/buses/0/{route}"))).iter().sum::<u64>();
    let [frames, lost, unwritten] =
        ["frames", "lost", "lost_write"].map(|key| summary.number(&format!("/recording/{key}")));
    assert_eq!((frames, frames + lost, lost), (lines.len() as u64, packets, unwritten), "{:#}", summary.0);
    assert!(frames > 100 && lost > 0, "{:#}", summary.0);
    assert!(summary.number("/recording/messages_lost/unwritten") > 0, "{:#}", summary.0);
    // The log is on another disk and complete; a part that follows begins after the lost frames.
    let log = place.read("run.log");
    let mut logged = log.lines();
    let absent = lines.iter().find(|line| !logged.any(|logged| logged == *line));
    assert_eq!(absent, None, "it is not in the log, or not in this order");
    assert_eq!(log.lines().count() as u64, packets);
}

const RUN: &str =
    "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 600 --summary run.json";

#[test]
fn a_limit_on_the_size_of_files_ends_the_recording_and_not_the_run() {
    let place = TestDir::new();
    place.pressed();
    // In blocks of 512 bytes; a pipe has no size.
    let run = format!("{RUN} --record run.mcap --candump /dev/stderr");
    let ended = in_shell(&place, "ulimit -f 270", &run, "true");
    let is_frame = |line: &&str| line.starts_with('(');
    let log: String = ended.stderr.lines().filter(is_frame).flat_map(|line| [line, "\n"]).collect();
    place.write("run.log", &log);
    let rest: Vec<_> = ended.stderr.lines().filter(|line| !is_frame(line)).collect();
    let ended = process::Ended { stderr: rest.join("\n"), ..ended };
    broke_off(&place, &ended, "File too large");
    assert!(!place.files().iter().any(|name| name.ends_with(".part")), "{:?}", place.files());
}

#[test]
fn a_full_disk_ends_the_recording_and_not_the_run() {
    let place = TestDir::new();
    place.pressed();
    fs::create_dir(place.path("disk")).unwrap();
    fs::create_dir(place.path("saved")).unwrap();
    // A small disk that only this run sees.
    let enter = "cd disk && mount -t tmpfs -o size=640k none . && cd ../disk && ln -s ../skin.toml ../scenario.toml .";
    let run = format!("{RUN} --record run.mcap --candump ../run.log");
    let save = "cp run.json run.mcap ../; ls > ../left";
    let script = format!(
        "{enter} && {{ {} {run}; code=$?; {save}; exit $code; }}",
        process::program("skinbus").display()
    );
    let mut command = place.command_of(Path::new("unshare"), "--user --map-root-user --mount sh -c");
    command.arg(script);
    let ended = until_it_broke_off(&place, process::Running::start(command));
    broke_off(&place, &ended, "No space left on device");
    assert_eq!(place.read("left"), "run.json\nrun.mcap\nscenario.toml\nskin.toml\n");
    assert_eq!(place.summary().0["recording"]["files"].as_array().unwrap().len(), 2);
}

/// The frames of a bus, with their times.
type ReceivedFrames = std::sync::Arc<std::sync::Mutex<Vec<(u64, protocol::can::Frame)>>>;

/// Listens on a place's bus until it is gone.
fn listen(place: &TestDir) -> (ReceivedFrames, std::thread::JoinHandle<()>) {
    let (heard, test_client) = (ReceivedFrames::default(), place.test_client());
    let into = std::sync::Arc::clone(&heard);
    let listen = move || {
        let mut inbox = protocol::bus::Inbox::new();
        while test_client.bus.wait(None).and_then(|_| test_client.bus.receive(&mut inbox)).is_ok() {
            let frames = inbox.frames().map(|received| (received.at_nanos, received.frame));
            into.lock().unwrap().extend(frames);
        }
    };
    (heard, std::thread::spawn(listen))
}

/// Returns the frames of a recording.
fn frames_of(path: &Path) -> Vec<(u64, String)> {
    let recorded = Recorded::read(path);
    let lines = recorded.on("/can/vcan0").zip(recorded.lines("/can/vcan0"));
    lines.map(|(message, line)| (message.nanos, line.rsplit(' ').next().unwrap().to_owned())).collect()
}

/// Kills a gateway that records several times, each at a random moment; returns the time that each kill lost, in ms.
/// Every other `.part` is repaired by the next run, the others by hand.
fn kill_again_and_again(seed: u64, times: u32) -> Vec<f64> {
    let place = TestDir::new();
    place.pressed();
    let mut random = rand_pcg::Pcg32::seed_from_u64(seed);
    let mut lost = Vec::new();
    for number in 0..times {
        let bench = place.start(
            "skinbus",
            "run skin.toml --bus-kind embedded --scenario scenario.toml --duration 600 --record run.mcap",
        );
        let (heard, listener) = listen(&place);
        until("the first frame", || (!heard.lock().unwrap().is_empty()).then_some(()));
        // The recorder has written it long before; the loop begins half a second later.
        std::thread::sleep(Duration::from_millis(random.random_range(300..2_300)));
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos();
        bench.signal(Signal::KILL);
        let said = bench.end();
        assert_eq!(said.signal(), Some(Signal::KILL.as_raw()), "{said:#?}");
        until("the cells' end", || place.processes().is_empty().then_some(()));
        listener.join().unwrap();
        let part = place.path("run.mcap.part");
        assert!(part.exists() && !place.path("run.mcap").exists());
        let repaired = place.path("run-recovered.mcap");
        if number % 2 == 0 {
            let ended = place.start("skinbus", "recover run.mcap.part").end().succeeded();
            assert!(
                ended.stdout.starts_with("run-recovered.mcap, ")
                    && ended.stdout.contains(" messages recovered, "),
                "{ended:#?}"
            );
            fs::remove_file(part).unwrap();
        } else {
            // Any run that records in the same folder.
            let run = "run skin.toml --bus-kind embedded --duration 0.01 --record other.mcap --quiet";
            let ended = place.start("skinbus", run).end().succeeded();
            let says =
                "run.mcap.part was left by a run that was killed; it was repaired as run-recovered.mcap: ";
            assert!(ended.stderr.lines().any(|line| line.starts_with(says)), "{ended:#?}");
            assert!(!part.exists(), "{ended:#?}");
            fs::remove_file(place.path("other.mcap")).unwrap();
        }
        let recorded = frames_of(&repaired);
        fs::remove_file(repaired).unwrap();
        let heard = heard.lock().unwrap();
        let heard: Vec<_> = heard.iter().map(|(at, frame)| (*at, frame.to_string())).collect();
        // No frame is sent before both listen.
        let same = recorded.iter().zip(&heard).take_while(|((_, ours), (_, theirs))| ours == theirs).count();
        assert_eq!(same, recorded.len(), "the frames are the first ones that the other has received");
        assert!(same > 0, "cells had sent");
        let last = recorded.last().unwrap();
        let before = heard.iter().rfind(|(at, _)| u128::from(*at) <= wall).unwrap();
        lost.push((before.0.saturating_sub(last.0)) as f64 / 1e6);
    }
    lost
}

#[test]
fn a_recording_survives_its_writer_being_killed_at_any_moment() {
    // `SKINBUS_KILLS=50` kills more often.
    let kills: u64 = std::env::var("SKINBUS_KILLS").map_or(6, |kills| kills.parse().unwrap());
    let share = move |seed: u64| u32::try_from(kills / 3 + u64::from(seed < kills % 3)).unwrap();
    let threads: Vec<_> =
        (0..3).map(|seed| std::thread::spawn(move || kill_again_and_again(seed, share(seed)))).collect();
    let mut lost: Vec<_> = threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect();
    lost.sort_by(f64::total_cmp);
    assert_eq!(lost.len() as u64, kills);
    // The recorder writes every 40 to 50 ms; a machine that delays it loses more.
    let (median, most) = (lost[lost.len() / 2], lost[lost.len() - 1]);
    println!("{} kills: {median:.0} ms lost (median), at most {most:.0} ms", lost.len());
}
