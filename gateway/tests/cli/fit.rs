//! `skinbus fit` as a process: its output as in the documents, and its errors.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::Value;

const BUS_MD: &str = include_str!("../../../docs/how-to/size-a-bus.md");

fn gateway(arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    command.args(arguments.split_whitespace()).current_dir(root).env("NO_COLOR", "1").output().unwrap()
}

fn output(arguments: &str) -> String {
    let Output { status, stdout, stderr } = gateway(arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), said.as_str()), (Some(0), ""), "{arguments}");
    String::from_utf8(stdout).unwrap()
}

/// The one-line error of a command that ends with 2 and prints nothing else.
fn refusal(arguments: &str) -> String {
    let Output { status, stdout, stderr } = gateway(arguments);
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!((status.code(), stdout.as_slice()), (Some(2), b"".as_slice()), "{arguments}: {said}");
    assert_eq!(said.matches('\n').count(), 1, "{arguments}: {said}");
    said.trim_end().to_owned()
}

#[test]
fn the_documents_show_what_is_printed() {
    let table = output("fit gateway/examples/ur5-253.toml");
    assert!(BUS_MD.contains(&table), "docs/how-to/size-a-bus.md has another table than\n{table}");
    let one = output("fit gateway/examples/ur5-253.toml --nominal 1M --data 5M");
    assert!(BUS_MD.contains(&one), "docs/how-to/size-a-bus.md has another page than\n{one}");
}

#[test]
fn rates_are_those_of_the_command_line_or_of_the_description_or_common_ones() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    let plain = output("skin generate --cells 90 --buses 2");
    let with_rates =
        plain.replace("format = \"fd\"", "format = \"fd\"\nbitrate = 500000\ndata_bitrate = 2000000");
    let mixed = with_rates.replacen("\nbitrate = 500000\ndata_bitrate = 2000000", "", 1);
    for (name, text) in [("plain", &plain), ("rates", &with_rates), ("mixed", &mixed)] {
        std::fs::write(path(name), text).unwrap();
    }
    let json = |arguments: &str| -> Value { serde_json::from_str(&output(arguments)).unwrap() };
    let names = |json: &Value, list: &str| -> Vec<String> {
        let list = json[list].as_array().unwrap();
        list.iter().map(|it| it["name"].as_str().unwrap().to_owned()).collect()
    };
    let described = json(&format!("fit {} --json", path("rates")));
    assert_eq!(names(&described, "buses"), ["500k/2M", "500k/2M"]);
    assert_eq!(described["whole"]["cells"], 90);
    let given = json(&format!("fit {} --nominal 1M --data 8M --json", path("rates")));
    assert_eq!(names(&given, "buses"), ["1M/8M", "1M/8M"]);
    let classic = json(&format!("fit {} --nominal 1M --format classic --json", path("plain")));
    assert_eq!(names(&classic, "buses"), ["classic 1M", "classic 1M"]);
    let all = ["classic 500k", "classic 1M", "500k/2M", "500k/5M", "1M/2M", "1M/5M", "1M/8M"];
    for arguments in [path("plain"), path("mixed"), format!("{} --table", path("rates"))] {
        assert_eq!(names(&json(&format!("fit {arguments} --json")), "table"), all);
    }
    let said = |name: &str| String::from_utf8(gateway(&format!("fit {}", path(name))).stderr).unwrap();
    assert_eq!(
        said("mixed"),
        "the skin ur5-90 gives no bitrate for vcan0, so the table lists common bit rates\n"
    );
    assert_eq!(said("plain") + &said("rates"), "");
    let only = json(&format!("fit {} --format classic --json", path("plain")));
    assert_eq!(names(&only, "table"), all[..2]);
    // A cell that computes longer answers later by the difference.
    let last = |arguments: &str| {
        let json = json(&format!("fit {} {arguments} --json", path("rates")));
        json["buses"][0]["last_answer_us"].as_f64().unwrap()
    };
    assert!((last("--computation 168.5") - last("") - 100.0).abs() < 1e-6);
}

#[test]
fn what_can_does_not_allow_is_refused_in_one_line() {
    let skin = "gateway/examples/ur5-253.toml";
    for (arguments, said) in [
        ("--nominal 0", "nominal bit rate 0 bit/s: CAN allows 10000 to 1000000 (10k to 1M)"),
        ("--nominal 2M --data 5M", "nominal bit rate 2000000 bit/s: CAN allows 10000 to 1000000 (10k to 1M)"),
        (
            "--nominal 1M --data 9M",
            "data bit rate 9000000 bit/s: CAN FD allows 1000000 (the nominal one) to 8000000 (8M)",
        ),
        (
            "--nominal 1M",
            "CAN FD needs a data bit rate: add --data with 1000000 to 8000000 bit/s, or --format classic",
        ),
        (
            "--nominal 1M --data 5M --format classic",
            "--data is only for CAN FD, but all buses are classic: leave it out, or add --format fd",
        ),
    ] {
        assert_eq!(refusal(&format!("fit {skin} {arguments}")), format!("skinbus: {said}"));
    }
    for arguments in ["--nominal fast --data 5M", "--table --nominal 1M", "--computation nan"] {
        assert!(refusal(&format!("fit {skin} {arguments}")).ends_with("try '--help'"));
    }
    let alone = refusal(&format!("fit {skin} --data 5M"));
    assert_eq!(alone, "skinbus: --data needs --nominal if a skin is given: add --nominal");
    assert!(refusal("fit nothing.toml").contains("nothing.toml"));
    for option in ["--rates vcan0=1M/5M", "--skin x.toml", "--bench-traffic", "--ber 0.001", "--duration 3"] {
        let (name, file) = (option.split(' ').next().unwrap(), skin);
        let expected = format!(
            "skinbus: {name} is only for frames of a log, recording or bus, but {file} is a skin: \
                     leave the option out"
        );
        assert_eq!(refusal(&format!("fit {skin} {option}")), expected);
    }
}

/// The output with a file as standard input through a pipe.
fn piped(text: &str, arguments: &str) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_skinbus"));
    command.args(arguments.split_whitespace()).env("NO_COLOR", "1");
    let mut child =
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut stdin = child.stdin.take().unwrap();
    let writing = std::thread::spawn({
        let text = text.to_owned();
        // A command that fails early closes the pipe.
        move || drop(std::io::Write::write_all(&mut stdin, text.as_bytes()))
    });
    let output = child.wait_with_output().unwrap();
    writing.join().unwrap();
    output
}

#[test]
fn a_pipe_gives_what_a_file_gives() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).display().to_string();
    // More than a reader reads at once.
    let log: String = (0..3_000).map(|at| format!("({at}.000000) can0 123#00\n")).collect();
    let skin = output("skin generate --cells 90");
    let scenario = "duration_s = 4.0\n[[touch]]\nat_s = 1.0\nfor_s = 1.0\ncells = [3]\nforce_n = 1.0\n";
    for (name, text) in [("run.log", log.as_str()), ("skin", &skin), ("touches", scenario)] {
        std::fs::write(path(name), text).unwrap();
    }
    for (name, text, command) in [
        ("run.log", log.as_str(), "fit FILE --json"),
        ("skin", &skin, "fit FILE --table --json"),
        ("skin", &skin, "check FILE --json"),
        ("touches", scenario, &format!("check FILE --skin {} --json", path("skin"))),
    ] {
        let of_file = output(&command.replace("FILE", &path(name)));
        for input in ["-", "/dev/stdin"] {
            let command = command.replace("FILE", input);
            let Output { status, stdout, stderr } = piped(text, &command);
            let said = String::from_utf8(stderr).unwrap();
            assert_eq!((status.code(), said.as_str()), (Some(0), ""), "{command}");
            let is_equal = String::from_utf8(stdout).unwrap() == of_file.replace(&path(name), input);
            assert!(is_equal, "{command}");
        }
    }
}

#[test]
fn standard_input_is_read_for_one_thing() {
    let skin = output("skin generate --cells 3");
    for command in
        ["check - -", "check - /dev/stdin", "run - --scenario -", "run /dev/stdin --scenario - --duration 1"]
    {
        let Output { status, stderr, .. } = piped(&skin, command);
        let said = String::from_utf8(stderr).unwrap();
        let expected =
            "two arguments name this input, but it can be read only once: use a file for one of them\n";
        assert_eq!((status.code(), said.contains(expected)), (Some(2), true), "{command}: {said}");
    }
    let Output { status, stderr, .. } = piped(&skin, "fit -");
    let said = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(2), "{said}");
    assert!(said.starts_with("skinbus: standard input is a skin or a scenario, "), "{said}");
}

#[test]
fn what_is_wrong_with_a_skin_is_said_whatever_its_name_is() {
    let folder = tempfile::tempdir().unwrap();
    let wrong = output("skin generate --cells 3").replace("[timing]", "[timing]\nfast = true");
    for name in ["skin.toml", "skin.txt"] {
        let path = folder.path().join(name).display().to_string();
        std::fs::write(&path, &wrong).unwrap();
        let said = refusal(&format!("fit {path} --table"));
        assert!(said.starts_with(&format!("skinbus: {path}:")) && said.contains("fast"), "{said}");
    }
}
