//! Files that commands write: a log can be read while it grows, a summary is written at every end, and no file is
//! overwritten without --overwrite.
#![allow(clippy::unwrap_used, clippy::panic, clippy::indexing_slicing, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;
use std::io::Read;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use process::log::Log;
use process::{Running, Summary, TestDir, names, skin, until};
use protocol::can::Format;
use protocol::fixed::Q1_14;
use protocol::message::{Joints, Message};
use protocol::packet::pad_with_defaults;
use protocol::packet::{Epoch, WORDS};
use rand::{RngExt, SeedableRng};
use rustix::fs::{CWD, FileType, Mode, mknodat};
use rustix::io::ioctl_fionread;
use rustix::process::Signal;
use trace::capture::{CaptureEntry, Reader};

const RUN: &str = "run skin.toml --bus-kind embedded --scenario scenario.toml";

/// Returns the times in ns of a log of whole lines, each a frame, and checks them with our reader.
fn times(path: &Path) -> Vec<u64> {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.is_empty() || text.ends_with('\n'), "not whole: {:?}", text.lines().last());
    let frames = Log::read(&text, Format::Fd).frames.len();
    let mut times = Vec::new();
    if frames > 0 {
        let mut reader = Reader::open(path).unwrap();
        while let Some(entry) = reader.next().unwrap() {
            let CaptureEntry::Frame(record) = entry else { panic!("{entry:?}") };
            times.push(record.time.nanos);
        }
    }
    assert_eq!(times.len(), frames);
    times
}

/// Kills a gateway that writes a log several times, each at a random moment. Returns the age of the last line at each
/// kill, in ms.
fn kill_again_and_again(seed: u64, times_killed: u32) -> Vec<f64> {
    let place = TestDir::new();
    place.pressed();
    let mut random = rand_pcg::Pcg32::seed_from_u64(seed);
    let mut older = Vec::new();
    for number in 0..times_killed {
        let log = place.path(&format!("{number}.log"));
        let bench = place.start("skinbus", &format!("{RUN} --duration 600 --candump {number}.log"));
        until("the first line", || fs::metadata(&log).is_ok_and(|log| log.len() > 0).then_some(()));
        std::thread::sleep(Duration::from_millis(random.random_range(0..2_000)));
        let wall = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos();
        bench.signal(Signal::KILL);
        assert_eq!(bench.end().signal(), Some(Signal::KILL.as_raw()));
        until("the cells' end", || place.processes().is_empty().then_some(()));
        let last = *times(&log).last().unwrap();
        older.push(wall.saturating_sub(last.into()) as f64 / 1e6);
    }
    older
}

/// `SKINBUS_KILLS=50` kills more often.
#[test]
fn a_log_survives_its_writer_being_killed_at_any_moment() {
    let kills: u32 = std::env::var("SKINBUS_KILLS").map_or(6, |kills| kills.parse().unwrap());
    let threads: Vec<_> = [kills / 2, kills.div_ceil(2)]
        .into_iter()
        .zip(0..)
        .map(|(kills, seed)| std::thread::spawn(move || kill_again_and_again(seed, kills)))
        .collect();
    let mut older: Vec<_> = threads.into_iter().flat_map(|thread| thread.join().unwrap()).collect();
    older.sort_by(f64::total_cmp);
    let [median, max] = [older[older.len() / 2], older[older.len() - 1]];
    println!("{} kills: the last line is {median:.0} ms older (median), at most {max:.0} ms", older.len());
}

#[test]
fn a_log_can_be_followed_while_it_grows_and_has_one_writer() {
    let place = TestDir::new();
    place.pressed();
    place.write("run.log", "of yesterday\n");
    let follow = |name: &str| {
        let log = place.path(name);
        let mut seen = 0;
        // Each time there are more whole lines, all of them frames.
        for _ in 0..5 {
            seen = until("more lines", || {
                let text = fs::read_to_string(&log).unwrap();
                let whole = text.strip_suffix('\n').map_or(0, |text| text.lines().count());
                (whole > seen).then_some(whole)
            });
        }
        assert!(Log::read(&place.read(name), Format::Fd).frames.len() >= seen);
    };
    for (name, force) in [("new.log", ""), ("run.log", "--overwrite")] {
        let words = format!("{RUN} --duration 600 --summary {name}.json --candump {name} {force}");
        let bench = place.start("skinbus", &words);
        bench.wait_for_loop();
        follow(name);
        let options = ["", "--overwrite"];
        for option in options {
            let words = format!("run skin.toml --bus-kind embedded --candump {name} {option}");
            let why = "another run is writing this file: name another file, or wait until that run has ended";
            let said = place.start("skinbus", &words).end();
            assert_eq!(said.refusal(2), format!("skinbus: --candump {name}: {why}"));
        }
        bench.signal(Signal::INT);
        bench.end().succeeded();
        place.is_left_clean();
        let summary: serde_json::Value = serde_json::from_str(&place.read(&format!("{name}.json"))).unwrap();
        let frames = Log::read(&place.read(name), Format::Fd).frames.len() as u64;
        assert_eq!(Summary(summary).number("/recording/frames"), frames);
    }
}

/// Every option of every command that writes a file, with NAME in the place of its name; the files that the command
/// reads exist.
const WRITERS: [(&str, &str, &str); 13] = [
    ("--candump ", "run skin.toml --bus-kind embedded --duration 0.1 --candump NAME", "new.log"),
    ("--summary ", "run skin.toml --bus-kind embedded --duration 0.1 --summary NAME", "new.json"),
    ("--record ", "run skin.toml --bus-kind embedded --duration 0.1 --record NAME", "new.mcap"),
    ("--candump ", "demo --duration 0.1 --candump NAME", "new.log"),
    ("--summary ", "demo --duration 0.1 --summary NAME", "new.json"),
    ("--record ", "demo --duration 0.1 --record NAME", "new.mcap"),
    ("--summary ", "replay in.log --bus-kind embedded --summary NAME", "new.json"),
    ("", "convert in.log NAME", "new.mcap"),
    ("-o ", "recover in.mcap -o NAME", "new.mcap"),
    ("-o ", "report in.mcap -o NAME", "new.html"),
    ("-o ", "skin generate --cells 3 -o NAME", "new.toml"),
    ("-o ", "skin dbc skin.toml -o NAME", "new.dbc"),
    ("--node-ids ", "commission skin.toml --bus-kind embedded --node-ids NAME", "new.toml"),
];

#[test]
fn no_option_of_any_command_overwrites_a_file_or_follows_a_symlink_to_one() {
    let place = TestDir::new();
    place.skin(3);
    place.write("in.log", "(1.000000) vcan0 123#11\n");
    place.start("skinbus", "convert in.log in.mcap").end().succeeded();
    place.write("mine", "mine\n");
    for (option, words, name) in WRITERS {
        let path = place.path(name);
        for (make, why) in [
            ("file", "exists: name another file, or add --overwrite"),
            ("link", "name another file"),
            ("dangling", "name another file"),
            ("directory", "name a file in a folder that can be written"),
        ] {
            match make {
                "file" => fs::write(&path, "mine\n").unwrap(),
                "link" => symlink("mine", &path).unwrap(),
                "dangling" => symlink("nowhere", &path).unwrap(),
                _ => fs::create_dir(&path).unwrap(),
            }
            let before = place.files();
            let options = ["", " --overwrite"];
            for overwrite in options {
                if make == "file" && !overwrite.is_empty() {
                    continue;
                }
                let words = words.replace("NAME", name) + overwrite;
                let ended = place.start("skinbus", &words).end();
                assert_eq!(ended.code(), Some(2), "{make}, {words}: {ended:#?}");
                let said = ended.stderr.lines().last().unwrap();
                assert!(said.starts_with(&format!("skinbus: {option}{name}: ")), "{words}: {said}");
                let elsewhere = why.replace("name another file", "or another file");
                assert!(said.ends_with(why) || said.ends_with(&elsewhere), "{make}, {words}: {said}");
                assert!(place.files() == before && !place.path("nowhere").exists(), "{words}");
                assert_eq!(place.read("mine"), "mine\n", "{words}");
            }
            match make {
                "file" => assert_eq!(place.read(name), "mine\n", "{words}"),
                "directory" => fs::remove_dir(&path).unwrap(),
                _ => {}
            }
            if make != "directory" {
                fs::remove_file(&path).unwrap();
            }
        }
    }
    // Whole folders: one that is not empty.
    fs::create_dir(place.path("results")).unwrap();
    place.write("results/notes.txt", "mine\n");
    let said = place.start("skinbus", "experiment fig10 --quick -o results").end();
    assert_eq!(
        said.refusal(2),
        "skinbus: -o results: the folder is not empty: name another folder, or overwrite files in it with --overwrite"
    );
    assert_eq!(names(&place.path("results")), ["notes.txt"]);
}

#[test]
fn a_log_into_a_pipe_whose_reader_stops_does_not_keep_a_run_from_ending() {
    let place = TestDir::new();
    place.pressed();
    let fifo = place.path("log.fifo");
    mknodat(CWD, &fifo, FileType::Fifo, Mode::from_raw_mode(0o600), 0).unwrap();
    let reader = fs::OpenOptions::new().read(true).write(true).open(&fifo).unwrap();
    for (signal, summary) in [(Signal::INT, "int.json"), (Signal::TERM, "term.json")] {
        let words = format!("{RUN} --duration 600 --quiet --candump log.fifo --summary {summary}");
        let bench = place.start("skinbus", &words);
        // The pipe is full: no data was added for a second.
        let (mut there, mut same) = (0, 0);
        until("a full pipe", || {
            let now = ioctl_fionread(&reader).unwrap();
            same = if now == there && now > 20_000 { same + 1 } else { 0 };
            there = now;
            (same > 200).then_some(())
        });
        bench.signal(signal);
        let ended = bench.end();
        assert_eq!(ended.code(), Some(1), "{ended:#?}");
        place.is_left_clean();
        assert!(place.path(summary).exists());
        let mut taken = vec![0; ioctl_fionread(&reader).unwrap().try_into().unwrap()];
        (&reader).read_exact(&mut taken).unwrap();
    }
}

#[test]
fn no_command_overwrites_what_it_reads_even_with_force() {
    let place = TestDir::new();
    place.pressed();
    place.write("in.log", "(1.000000) vcan0 123#11\n");
    place.start("skinbus", "convert in.log in.mcap").end().succeeded();
    let read = |name| fs::read(place.path(name)).unwrap();
    let names = ["skin.toml", "scenario.toml", "in.log", "in.mcap"];
    let before = names.map(read);
    let run = "run skin.toml --scenario scenario.toml --bus-kind embedded --duration 0.1";
    for (option, words, name) in [
        ("--summary ", format!("{run} --summary"), "skin.toml"),
        ("--candump ", format!("{run} --candump"), "./scenario.toml"),
        ("--summary ", "replay in.mcap --bus-kind embedded --summary".to_owned(), "in.mcap"),
        ("--summary ", "replay in.mcap --expect --spawn --skin skin.toml --summary".to_owned(), "skin.toml"),
        ("", "convert in.log".to_owned(), "in.log"),
        ("-o ", "recover in.mcap -o".to_owned(), "in.mcap"),
        ("-o ", "report in.mcap -o".to_owned(), "in.mcap"),
        ("-o ", "skin dbc skin.toml -o".to_owned(), "skin.toml"),
    ] {
        let ended = place.start("skinbus", &format!("{words} {name} --overwrite")).end();
        let why = "is also an input of this command: name another file for the output";
        assert_eq!(ended.refusal(2), format!("skinbus: {option}{name} {why}"), "{words}");
    }
    assert!(names.map(read) == before);
}

#[test]
fn a_symlink_to_a_terminal_or_a_pipe_is_written_to() {
    let place = TestDir::new();
    place.pressed();
    let run = format!("{RUN} --duration 0.3 --quiet --summary /dev/null --candump /dev/stdout");
    let ended = place.start("skinbus", &run).end().succeeded();
    let (frames, table): (Vec<_>, Vec<_>) = ended.stdout.lines().partition(|line| line.starts_with('('));
    assert!(frames.len() > 16 && table.len() > 10, "{ended:#?}");
    // A file that the shell has opened is not truncated, whatever its content is.
    let mut command = place.command_of(Path::new("/bin/sh"), "");
    let gateway = process::program("skinbus");
    let script = format!(
        "echo before > both; {} {RUN} --duration 0.3 --quiet --candump /dev/stdout >> both",
        gateway.display()
    );
    command.args(["-c", &script]);
    Running::start(command).end().succeeded();
    let both = place.read("both");
    assert!(both.starts_with("before\n(") && both.lines().count() > 26, "{both}");
    assert!(both.lines().last().unwrap().starts_with('└'), "the table comes after the frames: {both}");
    place.is_left_clean();
}

/// Checks that a run has failed, and that its summary and its last line give the reason.
fn failed(place: &TestDir, ended: &process::Ended) -> Summary {
    assert_eq!(ended.code(), Some(1), "{ended:#?}");
    let summary = place.summary();
    assert_eq!(summary.0["outcome"], "failed");
    let why = ended.stderr.lines().last().unwrap().strip_prefix("skinbus: ").unwrap();
    assert_eq!(summary.0["failure"], why);
    summary.adds_up();
    summary
}

#[test]
fn a_failed_run_has_a_summary_with_the_reason() {
    let place = TestDir::new();
    place.pressed();
    // Before its loop begins.
    let ended = place.bench(1.0, "SKINBUS_CELL_NODE=/bin/true").end();
    assert_eq!(failed(&place, &ended).number("/loop/ticks"), 0);

    // While it runs: another gateway.
    let bench = place.running_bench(600.0, "");
    let test_client = place.test_client();
    test_client.waits_for_epoch(10);
    let positions = [Q1_14::ZERO; WORDS];
    // A single packet of this kind may have any sender; a gateway continues.
    for epoch in 77..81 {
        test_client.send(&Message::Joints {
            epoch: Epoch(epoch),
            joints: Joints { positions: pad_with_defaults(&positions), in_use: 6 },
        });
    }
    let ended = bench.end();
    let summary = failed(&place, &ended);
    assert!(summary.number("/loop/ticks") > 0 && ended.stdout.contains(" s, failed "), "{ended:#?}");
    let lines = Log::read(&place.read("run.log"), Format::Fd).frames.len() as u64;
    assert_eq!(summary.number("/recording/frames"), lines);

    // Its log breaks off, and the run continues until it is ended.
    let mut command = place.command_of(Path::new("/bin/sh"), "");
    let run = format!("{RUN} --duration 600 --candump run.log --summary run.json --overwrite");
    command.args(["-c", &format!("ulimit -f 64; exec {} {run}", process::program("skinbus").display())]);
    let bench = Running::start(command);
    bench.wait_for_stderr("run.log: File too large");
    place.test_client().waits_for_joints(20);
    bench.signal(Signal::TERM);
    let summary = failed(&place, &bench.end());
    let frames = times(&place.path("run.log")).len() as u64;
    assert_eq!(summary.number("/recording/frames"), frames);
    assert!(frames > 100 && summary.number("/recording/lost_write") >= 20, "{:#}", summary.0);

    // The summary is also written after several signals.
    let bench = place.running_bench(600.0, "");
    for signal in [Signal::INT, Signal::INT, Signal::TERM] {
        bench.signal(signal);
    }
    bench.end().succeeded();
    assert_eq!(place.summary().0["outcome"], "interrupted");
    assert!(place.summary().0["failure"].is_null());
    place.is_left_clean();
}

#[test]
fn any_number_of_demonstrations_go_on_side_by_side() {
    let place = TestDir::new();
    let run = |quiet: &str| {
        let words = format!("demo --duration 600 SKINBUS_CELLS_PER_PROCESS=64 {quiet}");
        let mut command = place.command("skinbus", &words);
        command.env_remove("SKINBUS_DIR").env("TMPDIR", place.path(""));
        Running::start(command)
    };
    let demos = [run("--quiet"), run(""), run("")];
    for demo in &demos[1..] {
        demo.wait_for_stderr("frames are recorded in skinbus-demo");
        demo.wait_for_loop();
        let said = demo.stderr();
        // The printed command shows its frames.
        let line = said
            .lines()
            .find_map(|line| line.strip_prefix("to see the decoded frames, run in another shell: "))
            .unwrap();
        let (directory, dump) = line.strip_prefix("SKINBUS_DIR=").unwrap().split_once(" skinbus ").unwrap();
        let mut dump = place.command("skinbus", &format!("{dump} --kind torque -n 3"));
        dump.env("SKINBUS_DIR", directory);
        let dumped = Running::start(dump).end().succeeded();
        assert_eq!(dumped.stdout.lines().count(), 3, "{dumped:#?}");
    }
    until("all logs", || {
        let logs: Vec<_> = place.files().into_iter().filter(|name| name.ends_with(".log")).collect();
        (logs == ["skinbus-demo-1.log", "skinbus-demo-2.log", "skinbus-demo.log"]).then_some(())
    });
    for demo in demos {
        demo.signal(Signal::INT);
        let ended = demo.end().succeeded();
        assert!(ended.stdout.contains("253 cells"), "{ended:#?}");
    }
    let files = place.files();
    assert!(files.iter().all(|name| name.ends_with(".log")), "{files:?}");
    // A killed run leaves only its log.
    let killed = run("");
    killed.wait_for_loop();
    killed.signal(Signal::KILL);
    killed.end();
    until("its buses' end", || place.files().iter().all(|name| name.ends_with(".log")).then_some(()));
    assert!(!times(&place.path("skinbus-demo-3.log")).is_empty());
}

#[test]
fn a_demonstration_that_is_refused_announces_nothing() {
    let place = TestDir::new();
    fs::create_dir(place.buses()).unwrap();
    fs::set_permissions(place.buses(), fs::Permissions::from_mode(0o755)).unwrap();
    let refused = place.start("skinbus", "demo --duration 1").end();
    let said = refused.refusal(2);
    assert!(said.contains("buses") && said.contains("0755"), "{said}");
    assert_eq!(place.files(), ["buses"]);
}

#[test]
fn a_skin_that_a_test_makes_is_one_that_generate_makes() {
    let place = TestDir::new();
    place.start("skinbus", "skin generate --cells 8 -o skin.toml").end().succeeded();
    assert_eq!(place.read("skin.toml"), skin(8));
    place.start("skinbus", "skin generate --cells 9 -o skin.toml --overwrite").end().succeeded();
    assert_eq!(place.read("skin.toml"), skin(9));
}
