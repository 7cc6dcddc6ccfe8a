//! Every command of README.md works as README.md describes, in its order, as written, in one shell.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use std::fmt::Write as _;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

use process::{Ended, Place, Running, program};

const README: &str = include_str!("../../../README.md");
/// Programs that `cargo build --release` makes for the user. They are built already, so the build is replaced.
const PROGRAMS: [&str; 3] = ["skinbus", "cell-node", "vcan-setup"];
/// The other programs that the commands may use. Nothing else is found.
const TOOLS: [&str; 6] = ["ln", "mkdir", "python3", "sed", "sleep", "tac"];
/// For all commands; a machine that others use too takes a tenth of it.
const LIMIT: Duration = Duration::from_secs(900);

/// The fenced blocks, each with its language.
fn blocks(text: &str) -> Vec<(&str, &str)> {
    let fenced = text.split("```").skip(1).step_by(2);
    fenced.map(|block| block.split_once('\n').unwrap()).collect()
}

/// The lines of all blocks for a shell.
fn commands(text: &str) -> Vec<&str> {
    let blocks = blocks(text);
    for (language, block) in &blocks {
        assert!(["", "sh"].contains(language), "a block of {language:?} is neither run nor output:\n{block}");
    }
    let shell = blocks.iter().filter(|(language, _)| *language == "sh");
    shell.flat_map(|(_, block)| block.lines()).filter(|line| !line.trim().is_empty()).collect()
}

fn quoted(text: &str) -> String {
    format!("'{}'", text.replace('\'', r"'\''"))
}

/// Whether a command leaves something behind it that runs.
fn in_background(command: &str) -> bool {
    let command = command.split(" #").next().unwrap().trim_end();
    command.ends_with(" &") || command.contains(" & ")
}

/// A script of these commands. It ends with the first one that fails, also in the background, where only `kill` may end
/// what does not end by itself.
fn script(commands: &[&str]) -> String {
    let programs = PROGRAMS.map(|name| quoted(&program(name).display().to_string())).join(" ");
    let tools = TOOLS.join(" ");
    // `tests/run` runs this test: here its script is only parsed.
    let tests_run = quoted(&root().join("tests/run").display().to_string());
    let mut script = format!(
        "set -eu -o pipefail\n\
         trap 'kill $(jobs -p) 2>/dev/null || true' EXIT\n\
         mkdir tools tests\n\
         for tool in {tools}; do\n\
         printf '#!/bin/sh\\nPATH=%q exec %q \"$@\"\\n' \"$PATH\" \"$(type -P $tool)\" > tools/$tool\n\
         done\n\
         test -x {tests_run}\n\
         printf '#!/bin/sh\\n%q -n %q\\n' \"$BASH\" {tests_run} > tests/run\n\
         chmod +x tools/* tests/run\n\
         PATH=$PWD/tools background=()\n\
         cargo() {{\n\
         [ \"$*\" = 'build --release' ] || {{ echo \"cargo $*: not known how to replace\" >&2; return 1; }}\n\
         mkdir -p target/release; ln -s {programs} target/release\n\
         }}\n"
    );
    for command in commands {
        writeln!(script, "echo {0}; echo {0} >&2\n{command}", quoted(&format!("+ {command}"))).unwrap();
        if in_background(command) {
            script.push_str("background+=($!)\n");
        } else if *command == "wait $!" {
            script.push_str("unset 'background[-1]'\n");
        }
    }
    script.push_str(
        "for id in \"${background[@]}\"; do\n\
         status=0; wait $id || status=$?\n\
         [ $status = 0 ] || [ $status = 143 ] || { echo \"in the background: exit code $status\" >&2; exit 1; }\n\
         done\n",
    );
    script
}

/// The folder of the workspace.
fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap()
}

fn run(place: &Place, commands: &[&str]) -> Ended {
    symlink(root().join("gateway"), place.path("gateway")).unwrap();
    place.write("readme.sh", &script(commands));
    let words = format!("{} bash readme.sh", LIMIT.as_secs());
    Running::start(place.command_of(Path::new("timeout"), &words)).end_after(LIMIT)
}

/// What was printed by the first command that begins so.
fn printed<'a>(ended: &'a Ended, command: &str) -> &'a str {
    let mut all = ended.stdout.split("\n+ ").map(|part| part.strip_prefix("+ ").unwrap_or(part));
    all.find(|part| part.starts_with(command)).unwrap_or_else(|| panic!("{command} was not run"))
}

#[test]
fn every_command_does_what_it_should() {
    let place = Place::new();
    let commands = commands(README);
    assert!(commands.iter().any(|command| command.starts_with("cargo build --release && ")), "{commands:?}");
    assert!(commands.contains(&"tests/run"), "{commands:?}");
    let ended = run(&place, &commands).well();
    place.is_left_clean();

    // Each line of the quoted output begins as a line of the demo's output.
    let quoted = blocks(README).into_iter().find_map(|(_, block)| block.split_once("\nur5-253 ")).unwrap();
    let (verdict, table) = (quoted.0, format!("ur5-253 {}", quoted.1));
    let demo = printed(&ended, "cargo build --release && target/release/skinbus demo");
    let said = demo.lines().nth(1).unwrap();
    // What is good and what is not depends on the machine.
    let is_verdict = |line: &str| line.starts_with("all well: 253 cells, 575 of 575 epochs complete, ");
    assert!(is_verdict(verdict) && (is_verdict(said) || said.starts_with("look at: ")), "{verdict}\n{said}");
    let mut rest = demo;
    for line in table.lines().filter(|line| *line != "...") {
        let rank = line.trim_start().split("  ").next().unwrap();
        let found = rest.split_once(&format!(" {rank} "));
        rest = found.unwrap_or_else(|| panic!("{rank:?} comes not, or earlier, in\n{demo}")).1;
    }
}

#[test]
fn commands_in_the_text_are_run_too() {
    let commands = commands(README);
    let parts = README.split("```").step_by(2);
    let spans = parts.flat_map(|part| part.split('`').skip(1).step_by(2));
    let named = spans.filter(|span| PROGRAMS.iter().any(|name| span.starts_with(&format!("{name} "))));
    let named: Vec<_> = named.collect();
    assert!(named.len() > 2, "{named:?}");
    for span in named {
        assert!(commands.iter().any(|command| command.contains(span)), "no block has `{span}`");
    }
}

#[test]
fn failing_and_unknown_commands_fail_here() {
    let build = "cargo build --release";
    let path = "export PATH=$PWD/target/release:$PATH";
    let version = "skinbus --version";
    assert!(
        run(&Place::new(), &[build, path, version]).well().stdout.contains("+ skinbus --version\nskinbus ")
    );
    for commands in [
        vec![version],
        vec!["cargo build"],
        vec![build, path, "skinbus check nothing.toml", version],
        vec![build, path, "skinbus check nothing.toml & sleep 0", version],
        vec![build, path, "nothing.toml & sleep 0"],
        vec![build, path, "tests/nothing"],
        vec![build, path, "sudo vcan-setup status"],
        vec![build, path, "skinbus skin generate | nothing"],
    ] {
        let ended = run(&Place::new(), &commands);
        assert!(ended.code().is_some_and(|code| code != 0), "{commands:?}: {ended:#?}");
    }
}
