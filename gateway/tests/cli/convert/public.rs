//! Published captures of other programs: the parts that are read, and the reports on the rest.

use std::fs;
use std::io::{BufRead, BufReader, Write as _};
use std::path::PathBuf;
use std::process::{Output, Stdio};
use std::time::{Duration, Instant};

use trace::capture::{CaptureEntry, Reader};

use super::Folder;

/// A limit that only a hanging program reaches.
const LIMIT: Duration = Duration::from_secs(120);

fn data(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data/captures").join(name)
}

/// A directory with copies of published files.
fn folder(names: &[&str]) -> Folder {
    let folder = Folder::new(&[]);
    for name in names {
        fs::copy(data(name), folder.path(name.rsplit('/').next().unwrap())).unwrap();
    }
    folder
}

/// Exit code, standard output and standard error.
fn run(folder: &Folder, arguments: &str) -> (Option<i32>, String, String) {
    let Output { status, stdout, stderr } = folder.gateway(arguments).stdin(Stdio::null()).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.code(), text(stdout), text(stderr))
}

/// Lines of a capture as a log.
fn lines(folder: &Folder, name: &str) -> Vec<String> {
    let (code, out, said) = run(folder, &format!("convert {name} -"));
    assert_eq!(code, Some(0), "{said}");
    out.lines().map(str::to_owned).collect()
}

#[test]
fn public_logs_are_read_with_the_values_that_other_programs_read() {
    let folder = folder(&[
        "eff_flag_ids.log",
        "three_digits.log",
        "words_behind.log",
        "journal.txt",
        "ros1_encoding.mcap",
    ]);
    let flags = lines(&folder, "eff_flag_ids.log");
    assert_eq!(flags.len(), 10);
    assert_eq!(flags.first().unwrap(), "(1666984357.091694) can0 18F010FE#35DF859D5056EBA0");
    assert_eq!(flags.last().unwrap(), "(1666984357.106659) can0 1881FEFE#D35C2E95BC14C8BD");
    let three = [
        "(1641234567.123000) can0 180#DEADBEEF",
        "(1641234567.124000) can1 181#CAFE",
        "(1641234567.125000) can2 7FF#",
    ];
    assert_eq!(lines(&folder, "three_digits.log"), three);
    let frames: Vec<_> =
        lines(&folder, "words_behind.log").into_iter().filter(|line| line.starts_with('(')).collect();
    assert_eq!(
        frames,
        [
            "(1682437707.894858) can0 0CF00400#F07D859B0FFFFF85",
            "(1682437707.904858) can0 0CF00400#F07D859B0FFFFF85"
        ]
    );
    let journal = ["(1700000000.123456) can0 123#1122", "(1700000000.123457) can0 123#1122"];
    assert_eq!(lines(&folder, "journal.txt"), journal);
    let ros1 = lines(&folder, "ros1_encoding.mcap");
    assert_eq!(
        (ros1.len(), ros1.first().unwrap().as_str()),
        (5, "(1700000000.000000000) can0 100#0102030405060708")
    );
}

#[test]
fn an_identifier_that_does_not_fit_is_named_and_no_frame() {
    let folder = folder(&["id_needs_29_bits.mcap"]);
    let (code, out, said) = run(&folder, "convert id_needs_29_bits.mcap -");
    assert_eq!((code, out.as_str()), (Some(1), ""));
    assert!(said.contains("18F010FE does not fit an identifier of 11 bits: at most 7FF"), "{said}");
    assert!(said.ends_with("skinbus: id_needs_29_bits.mcap: it contains no CAN frames\n"), "{said}");
}

#[test]
fn topics_with_one_frame_id_are_two_buses() {
    let folder = folder(&["two_buses_one_frame_id.mcap"]);
    let (code, out, said) = run(&folder, "fit two_buses_one_frame_id.mcap --nominal 500k");
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("several topics use the same frame_id: each topic is read as a bus of its own"),
        "{said}"
    );
    for (bus, load) in [("/can0/from_can_bus", "97.8 %: fits"), ("/can1/from_can_bus", "97.0 %: fits")] {
        assert!(out.contains(&format!("{bus} at classic 500k")) && out.contains(load), "{out}");
    }
    // A pipe is read once: the first topic keeps the name, and there are still two buses.
    let mut command = folder.gateway("convert - -");
    command.stdin(fs::File::open(folder.path("two_buses_one_frame_id.mcap")).unwrap());
    let out = String::from_utf8(command.output().unwrap().stdout).unwrap();
    let of = |bus: &str| out.lines().filter(|line| line.split(' ').nth(1) == Some(bus)).count();
    assert_eq!((of("can"), of("/can1/from_can_bus")), (400, 400));
}

#[test]
fn times_that_are_none_get_a_remark_and_no_verdict() {
    let line = |at: u32, time: &str| {
        format!(" ({time})  can0  {:03X}   [8]  {at:02X} 5A 00 5A 23 00 64 05\n", at % 0x700)
    };
    let zero: String = (0..300).map(|at| line(at % 256, "0000000000.000000")).collect();
    let constant: String = (0..300).map(|at| line(at % 256, "1700000000.500000")).collect();
    let none: String = (0..300).map(|at| format!("  can0  {:03X}   [1]  11\n", at % 0x700)).collect();
    let folder = Folder::new(&[
        ("zero.txt", zero.as_bytes()),
        ("one.txt", constant.as_bytes()),
        ("none.txt", none.as_bytes()),
    ]);
    for (name, remark) in [
        (
            "zero.txt",
            "all 300 frames of can0 have the same time, 0.000000000: rates, gaps and bus loads are meaningless",
        ),
        (
            "one.txt",
            "all 300 frames of can0 have the same time, 1700000000.500000000: rates, gaps and bus loads are \
             meaningless",
        ),
        ("none.txt", "rates, gaps and bus loads are meaningless"),
    ] {
        let (code, out, said) = run(&folder, &format!("fit {name} --nominal 500k"));
        assert!(code == Some(0) && said.contains(remark), "{said}");
        assert!(!out.contains('%') && !out.contains("fit"), "{out}");
        let (_, out, said) = run(&folder, &format!("dump --stats {name}"));
        assert!(said.contains(remark) && !out.contains("per second"), "{said}{out}");
        let (_, out, _) = run(&folder, &format!("dump --stats --json {name}"));
        let stats: serde_json::Value = serde_json::from_str(&out).unwrap();
        let bus = &stats["buses"][0];
        assert!(bus["frames_per_s"].is_null(), "{bus}");
        assert!(
            bus["foreign"]["identifiers"].as_array().unwrap().iter().all(|id| id["frames_per_s"].is_null())
        );
        let (_, _, said) = run(&folder, &format!("convert {name} -"));
        assert!(said.contains(remark), "{said}");
    }
}

#[test]
fn a_rate_stands_beside_its_span_of_a_millisecond_or_more() {
    let log = "(1.000000) can0 123#\n(1.000001) can0 123#\n(9.000000) can0 456#\n(9.000000) can1 456#\n";
    let folder = Folder::new(&[("run.log", log.as_bytes())]);
    let (_, out, _) = run(&folder, "dump --stats run.log");
    let mut rows = out.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let row = rows.find(|words| words.get(1) == Some(&"123")).unwrap();
    assert_eq!(row, ["│", "123", "2", "0.000", "0", "│"], "no rate over a microsecond");
    assert!(out.contains("0.4 per s over 8.000 s"), "{out}");
    let can1 = out.lines().find(|line| line.contains("│ can1 ")).unwrap();
    assert!(!can1.contains("per s "), "one frame has no rate: {can1}");
}

#[test]
fn no_control_of_a_foreign_name_comes_out() {
    let folder = folder(&["names_with_escapes.mcap"]);
    let is_plain =
        |text: &str| !text.chars().any(|letter| letter.is_control() && !matches!(letter, '\n' | '\t'));
    for command in ["dump", "dump --brief", "dump --stats", "dump --json", "convert", "fit", "fit --json"] {
        let to = if command == "convert" { " -" } else { "" };
        let (code, out, said) = run(&folder, &format!("{command} names_with_escapes.mcap{to}"));
        assert!(code == Some(0) && is_plain(&out) && is_plain(&said), "{command}: {out:?} {said:?}");
    }
    // Two buses never become one.
    let buses = |out: &str| {
        let mut all: Vec<_> =
            out.lines().filter_map(|line| line.split(' ').nth(1)).map(str::to_owned).collect();
        all.sort();
        all.dedup();
        all.len()
    };
    let (_, out, _) = run(&folder, "convert names_with_escapes.mcap -");
    assert_eq!(buses(&out), out.lines().count(), "{out}");
}

#[test]
fn a_name_that_was_changed_is_what_is_said() {
    let folder = folder(&["topic_with_blank.mcap"]);
    let (code, out, said) = run(&folder, "convert topic_with_blank.mcap -");
    assert_eq!(
        (code, out.as_str()),
        (Some(0), "(1700000000.000000000) _/robot_one/can 123#0102030405060708\n")
    );
    assert!(said.contains("1 frame is from a bus whose name was changed"), "{said}");
    assert!(!said.contains("direction"), "{said}");
}

#[test]
fn files_of_one_capture_are_read_in_the_order_of_their_frames() {
    let folder = folder(&["split_0.mcap", "split_1.mcap", "three_digits.log"]);
    for names in ["split_0.mcap split_1.mcap", "split_1.mcap split_0.mcap"] {
        let ids: Vec<_> = lines(&folder, names)
            .iter()
            .map(|line| line.split([' ', '#']).nth(2).unwrap().to_owned())
            .collect();
        assert_eq!(ids, ["100", "101", "102", "103", "104", "105", "106", "107", "108", "109"]);
    }
    let (code, _, said) = run(&folder, "convert split_1.mcap split_0.mcap one.mcap");
    assert!(code == Some(0) && said.ends_with("one.mcap: 10 frames, 0 notes\n"), "{said}");
    assert_eq!(lines(&folder, "one.mcap"), lines(&folder, "split_0.mcap split_1.mcap"));
    assert!(
        folder
            .refuses("convert one.mcap again.mcap", 2)
            .ends_with("is already an MCAP recording: copy it instead")
    );
    let said = folder.refuses("convert split_0.mcap split_0.mcap x.log", 2);
    assert_eq!(said, "skinbus: the file split_0.mcap is named twice: name it once");
    let said = folder.refuses("convert split_0.mcap three_digits.log x.log", 2);
    assert!(
        said.starts_with("skinbus: three_digits.log is a candump log, but split_0.mcap is an MCAP recording"),
        "{said}"
    );
}

#[test]
fn logs_that_overlap_are_read_one_after_the_other_and_that_is_said() {
    let (a, b) =
        ("(1.000000) can0 001#\n(5.000000) can0 005#\n", "(2.000000) can0 002#\n(6.000000) can0 006#");
    let folder = Folder::new(&[
        ("a.log", a.as_bytes()),
        ("b.log", b.as_bytes()),
        ("c.log", b"(7.000000) can0 007#\n"),
    ]);
    let (code, out, said) = run(&folder, "convert c.log b.log a.log -");
    assert_eq!((code, out.as_str()), (Some(0), format!("{a}{b}\n(7.000000) can0 007#\n").as_str()));
    assert!(
        said.contains("b.log begins before a.log ends: the files are read one after the other"),
        "{said}"
    );
    assert!(
        said.contains(
            "the time stamps go backwards 1 times, first at frame 3; the order of the frames is kept"
        ),
        "{said}"
    );
    let (_, _, said) = run(&folder, "convert a.log c.log -");
    assert_eq!(said, "a.log to c.log (2 parts) -> -: 3 frames, 0 notes\n");
    let (_, _, said) = run(&folder, "dump b.log c.log a.log");
    assert!(said.contains("the time stamps go backwards 1 times"), "{said}");
}

#[test]
fn texts_of_other_programs_are_named_with_what_to_do() {
    for (file, what, hint) in [
        ("kinds/a.dbc", "a DBC file", "it describes signals"),
        ("kinds/asc_comment_first.asc", "a Vector ASC log", "asc2log -I FILE"),
        ("kinds/busmaster.log", "a BUSMASTER log", "export it as a candump log"),
        ("kinds/canhacker.trc", "a CANHacker trace", "export it as a candump log"),
        ("kinds/cansend_frames.log", "a list of frames for cansend", "its frames have no times"),
        ("kinds/cansend_script.log", "a list of frames for cansend", "its frames have no times"),
        ("kinds/clx000.txt", "a CSS Electronics CLX000 log", "export it as a candump log"),
        ("kinds/python_can_printer.txt", "output of python-can", "can_logger -f"),
        ("kinds/socketcand.txt", "output of socketcand", "export it as a candump log"),
    ] {
        let folder = folder(&[file]);
        let name = file.strip_prefix("kinds/").unwrap();
        let begin = format!("skinbus: {name} is {what}, not a candump log or MCAP recording: ");
        for command in
            ["dump NAME", "convert NAME -", "convert NAME out.log", "fit NAME", "view NAME", "skin dbc NAME"]
        {
            let said = folder.refuses(&command.replace("NAME", name), 2);
            assert!(said.starts_with(&begin) && said.contains(hint), "{command}: {said}");
        }
    }
}

#[test]
fn a_capture_is_shown_and_another_text_is_named_as_dump_names_it() {
    let words = "hello this is console noise of a login shell\n".repeat(1_000);
    let log = format!("{words}(1.000000) vcan0 123#00\n");
    let skin = fs::read(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("examples/ur5-253.toml")).unwrap();
    let files = [("words.txt", words.as_bytes()), ("late.log", log.as_bytes()), ("skin.toml", &skin)];
    let folder = Folder::new(&files);
    for command in [
        "dump words.txt",
        "view words.txt",
        "view words.txt --skin skin.toml",
        "view words.txt --at 1",
        "skin dbc words.txt",
    ] {
        let said = folder.refuses(command, 1);
        assert!(
            said.starts_with("skinbus: words.txt: no frame in 1000 lines; expected the output of candump"),
            "{command}: {said}"
        );
    }
    assert!(folder.refuses("view skin.toml --at 1", 2).contains("but this file is a skin"));
    assert!(
        folder.refuses("skin dbc late.log", 2).ends_with(
            "late.log is a capture (candump log), but this command needs a skin: name a skin file"
        )
    );
    let mut view = folder.gateway("view late.log --skin skin.toml").stderr(Stdio::piped()).spawn().unwrap();
    let said = BufReader::new(view.stderr.take().unwrap()).lines().next().unwrap().unwrap();
    view.kill().unwrap();
    view.wait().unwrap();
    assert!(said.starts_with("view: http://127.0.0.1:"), "{said}");
}

/// Number of frames in a file now.
fn frames(path: &std::path::Path) -> usize {
    let Ok(mut reader) = Reader::open(path) else { return 0 };
    let mut frames = 0;
    while let Ok(Some(entry)) = reader.next() {
        frames += usize::from(matches!(entry, CaptureEntry::Frame(_)));
    }
    frames
}

#[test]
fn what_came_through_a_pipe_outlives_a_killed_convert() {
    const LINES: usize = 5_000;
    for (to, grows) in [("run.log", "run.log"), ("run.mcap", "run.mcap.part")] {
        let folder = Folder::new(&[]);
        let mut command = folder.gateway(&format!("convert - {to}"));
        let mut convert = command.stdin(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut input = convert.stdin.take().unwrap();
        let text: String = (0..LINES).map(|at| format!("(1.{at:06}) can0 123#{at:08X}\n")).collect();
        // A line is cut, and no more input comes.
        input.write_all(format!("{text}(2.0000").as_bytes()).unwrap();
        let began = Instant::now();
        while frames(&folder.path(grows)) < LINES {
            assert!(began.elapsed() < LIMIT, "{to}: {} frames", frames(&folder.path(grows)));
            std::thread::sleep(Duration::from_millis(10));
        }
        convert.kill().unwrap();
        convert.wait().unwrap();
        assert_eq!(frames(&folder.path(grows)), LINES);
        if to == grows {
            assert_eq!(folder.text(to), text);
            continue;
        }
        assert!(!folder.path(to).exists());
        let said = folder.refuses("convert - run.mcap", 2);
        assert!(
            said.contains(
                "run.mcap.part was left by a conversion that was killed: recover it with `skinbus recover"
            ),
            "{said}"
        );
        let (code, said, _) = run(&folder, "recover run.mcap.part -o run.mcap");
        assert!(code == Some(0) && said.contains("5000 messages"), "{said}");
        assert_eq!(frames(&folder.path(to)), LINES);
    }
}

#[test]
fn of_a_pipe_that_ends_the_output_is_whole_and_of_a_refused_one_nothing_is_left() {
    for (to, input, options, code) in [
        ("run.log", "(1.000000) can0 123#11\n# why\n", "", 0),
        ("run.mcap", "(1.000000) can0 123#11\n# why\n", "", 0),
        ("run.log", "# why\n", "", 1),
        ("run.mcap", "# why\n", "", 1),
        ("run.log", "(1.000000) can0 123#11\n(1\n", "--strict", 1),
        ("run.mcap", "(1.000000) can0 123#11\n(1\n", "--strict", 1),
    ] {
        let folder = Folder::new(&[]);
        let mut command = folder.gateway(&format!("convert - {to} {options}"));
        let mut convert = command.stdin(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        convert.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        assert_eq!(convert.wait().unwrap().code(), Some(code), "{to} {options}");
        let left: Vec<_> = folder.all().into_iter().map(|(name, _)| name).collect();
        assert_eq!(left, if code == 0 { vec![to.to_owned()] } else { Vec::new() });
        if code == 0 {
            assert_eq!(lines(&folder, to), ["(1.000000) can0 123#11", "# why"]);
        }
    }
}

#[test]
fn carriage_returns_end_lines() {
    let folder = Folder::new(&[("mac.log", b"(1.000000) can0 123#11\r(2.000000) can0 123#\r# words\r")]);
    assert_eq!(lines(&folder, "mac.log"), ["(1.000000) can0 123#11", "(2.000000) can0 123#", "# words"]);
}

#[test]
fn a_ros_1_bag_and_a_database_are_named_with_a_converter() {
    let folder = Folder::new(&[("x.bag", b"#ROSBAG V2.0\n"), ("x.db3", b"SQLite format 3\0")]);
    for name in ["x.bag", "x.db3"] {
        assert!(folder.refuses(&format!("dump {name}"), 2).contains("rosbags-convert --src "));
    }
}
