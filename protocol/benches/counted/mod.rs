//! How benches that count instructions begin: what they need is looked for before it is used.

use std::process::{Command, Stdio, exit};

/// The workspace's manifest, which says which version of gungraun this is.
const MANIFEST: &str = include_str!("../../../Cargo.toml");

/// Counts what `counted` does. Without `--bench`, which `cargo bench` says and `cargo test` does not, and with `--test`,
/// everything is run `once` instead, which needs nothing that Rust does not bring.
pub(crate) fn main(once: impl Fn(), counted: impl Fn()) {
    let said = |word: &str| std::env::args_os().any(|said| said == word);
    // The runner starts this program again for each benchmark, under valgrind.
    if said("--gungraun-run") {
        return counted();
    }
    if said("--test") || !said("--bench") {
        return once();
    }
    let version = MANIFEST.lines().find_map(|line| line.strip_prefix("gungraun = \"="));
    let version = version.map_or("*", |version| version.trim_end_matches('"'));
    let runner = std::env::var("GUNGRAUN_RUNNER").unwrap_or_else(|_| "gungraun-runner".to_owned());
    for (program, hint) in [
        ("valgrind", "apt-get install valgrind".to_owned()),
        (&runner, format!("cargo install gungraun-runner --version {version}")),
    ] {
        let mut command = Command::new(program);
        command.arg("--version").stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        if command.status().is_err() {
            eprintln!("instructions are not counted, for there is no {program} here: {hint}");
            exit(1);
        }
    }
    counted();
}
