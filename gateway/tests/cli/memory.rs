//! Memory use for any file is bounded.
#![allow(clippy::unwrap_used, reason = "a test may stop")]

use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

/// Limit of a command's address space in bytes; docs/reference/skin.md promises 0.5 GB.
const BOUND: &str = "--as=700000000";

fn bounded(folder: &Path, line: &str) -> Output {
    let mut command = Command::new("prlimit");
    command.args([BOUND, "--", env!("CARGO_BIN_EXE_skinbus")]).args(line.split(' '));
    command.current_dir(folder).output().unwrap()
}

/// Files with as many keys and tables as are read, in the most expensive forms.
fn hostile() -> [(&'static str, String); 4] {
    let mut tables = String::new();
    for at in 0..120_000 {
        writeln!(tables, "[a{at:x}.b.c.d]").unwrap();
    }
    [
        ("tables.toml", tables),
        ("dotted.toml", format!("x=[{}]", "{a.b.c.d.e.f=1},".repeat(62_000))),
        ("inline.toml", format!("x=[{}]", "{a=1},".repeat(166_000))),
        ("values.toml", format!("x=[{}]", "1,".repeat(490_000))),
    ]
}

#[test]
fn files_of_people_cost_at_most_what_the_documents_say() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    let skin = bounded(folder.path(), "skin generate --cells 10000 --buses 40");
    assert!(skin.status.success(), "{}", String::from_utf8_lossy(&skin.stderr));
    fs::write(folder.path().join("skin.toml"), skin.stdout).unwrap();
    let checked = bounded(folder.path(), "check skin.toml");
    assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr));

    for (name, text) in hostile() {
        write(name, &text);
        for line in [format!("check {name}"), format!("check {name} --skin skin.toml")] {
            let ended = bounded(folder.path(), &line);
            let said = String::from_utf8_lossy(&ended.stderr);
            assert_eq!(ended.status.code(), Some(2), "{line}: {said}");
            assert_eq!(said.lines().count(), 1, "{line}: {said}");
        }
        write(name, &text.repeat(5));
        let ended = bounded(folder.path(), &format!("check {name}"));
        let said = String::from_utf8_lossy(&ended.stderr);
        assert_eq!(ended.status.code(), Some(2), "{name}: {said}");
        assert!(said.contains("at most 500000 are allowed"), "{name}: {said}");
    }
    write("long.toml", &"# \n".repeat(6 << 20));
    let said = bounded(folder.path(), "check long.toml").stderr;
    assert!(String::from_utf8_lossy(&said).contains("longer than 16777216 bytes"), "{said:?}");
}
