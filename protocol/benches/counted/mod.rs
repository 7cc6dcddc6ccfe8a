//! The entry point of the benches that count instructions. It first checks that valgrind and the runner of gungraun are
//! installed.

use std::process::{Command, Stdio, exit};

/// The workspace's manifest, which pins the version of gungraun.
const WORKSPACE_MANIFEST: &str = include_str!("../../../Cargo.toml");

/// Runs the benches: under valgrind (`counted`) when `cargo bench` starts the program with `--bench`, else once each
/// (`once`), which needs no other programs. `--test` also selects `once`.
pub(crate) fn main(once: impl Fn(), counted: impl Fn()) {
    let said = |word: &str| std::env::args_os().any(|said| said == word);
    // The runner starts this program again for each benchmark, under valgrind.
    if said("--gungraun-run") {
        return counted();
    }
    if said("--test") || !said("--bench") {
        return once();
    }
    let version = WORKSPACE_MANIFEST.lines().find_map(|line| line.strip_prefix("gungraun = \"="));
    let version = version.map_or("*", |version| version.trim_end_matches('"'));
    let runner = std::env::var("GUNGRAUN_RUNNER").unwrap_or_else(|_| "gungraun-runner".to_owned());
    for (program, hint) in [
        ("valgrind", "apt-get install valgrind".to_owned()),
        (&runner, format!("cargo install gungraun-runner --version {version}")),
    ] {
        let mut command = Command::new(program);
        command.arg("--version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        if command.status().is_err() {
            eprintln!("cannot count instructions: {program} is not installed: {hint}");
            exit(1);
        }
    }
    counted();
}
