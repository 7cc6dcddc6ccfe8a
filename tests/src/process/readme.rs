//! The commands of README.md, run as written.

use std::fmt::Write as _;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

use super::{Ended, Running, TestDir, program};

/// The text of README.md.
pub const README: &str = include_str!("../../../README.md");
/// The programs that `cargo build --release` builds for the user. They are built already, so the build is replaced.
pub const PROGRAMS: [&str; 3] = ["skinbus", "cell-node", "vcan-setup"];
/// The other programs that the commands may use; no others are on the path.
const TOOLS: [&str; 6] = ["ln", "mkdir", "python3", "sed", "sleep", "tac"];
/// The time limit for all commands; a shared machine takes a tenth of it.
const LIMIT: Duration = Duration::from_secs(900);

/// Returns the fenced blocks of a page, each with its language.
pub fn blocks(text: &str) -> Vec<(&str, &str)> {
    let fenced = text.split("```").skip(1).step_by(2);
    fenced.map(|block| block.split_once('\n').unwrap()).collect()
}

/// Returns the lines of all blocks for a shell.
pub fn commands(text: &str) -> Vec<&str> {
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

/// Returns true for a command that starts a background process.
fn in_background(command: &str) -> bool {
    let command = command.split(" #").next().unwrap().trim_end();
    command.ends_with(" &") || command.contains(" & ")
}

/// Returns a script of these commands. It ends with the first one that fails, also in the background, where only `kill`
/// may end processes that do not end by themselves.
fn script(commands: &[&str]) -> String {
    let programs = PROGRAMS.map(|name| quoted(&program(name).display().to_string())).join(" ");
    let tools = TOOLS.join(" ");
    // `tests/run` runs this test, so here its script is only parsed.
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
         [ \"$*\" = 'build --release' ] || {{ echo \"cargo $*: only build --release is replaced\" >&2; return 1; }}\n\
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

/// Returns the folder of the workspace.
fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap()
}

/// Runs commands in one shell.
pub fn run(place: &TestDir, commands: &[&str]) -> Ended {
    symlink(root().join("gateway"), place.path("gateway")).unwrap();
    place.write("readme.sh", &script(commands));
    let words = format!("{} bash readme.sh", LIMIT.as_secs());
    Running::start(place.command_of(Path::new("timeout"), &words)).end_after(LIMIT)
}

/// Returns the output of the first command that begins with this text.
pub fn printed<'a>(ended: &'a Ended, command: &str) -> &'a str {
    let mut all = ended.stdout.split("\n+ ").map(|part| part.strip_prefix("+ ").unwrap_or(part));
    all.find(|part| part.starts_with(command)).unwrap_or_else(|| panic!("{command} was not run"))
}
