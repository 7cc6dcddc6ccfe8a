//! Every command of README.md works as README.md describes, in its order, as written, in one shell.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use process::TestDir;
use process::readme::{PROGRAMS, README, blocks, commands, printed, run};

#[test]
fn every_command_does_what_it_should() {
    let place = TestDir::new();
    let commands = commands(README);
    assert!(commands.iter().any(|command| command.starts_with("cargo build --release && ")), "{commands:?}");
    assert!(commands.contains(&"tests/run"), "{commands:?}");
    let ended = run(&place, &commands).succeeded();
    place.is_left_clean();

    // Each line of the quoted output begins like a line of the demo's output.
    let quoted = blocks(README).into_iter().find_map(|(_, block)| block.split_once("\nur5-253 ")).unwrap();
    let (verdict, table) = (quoted.0, format!("ur5-253 {}", quoted.1));
    let demo = printed(&ended, "cargo build --release && target/release/skinbus demo");
    let said = demo.lines().nth(1).unwrap();
    // The verdict depends on the machine.
    let is_verdict = |line: &str| line.starts_with("all well: 253 cells, 575 of 575 epochs complete, ");
    assert!(is_verdict(verdict) && (is_verdict(said) || said.starts_with("problems: ")), "{verdict}\n{said}");
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
        run(&TestDir::new(), &[build, path, version])
            .succeeded()
            .stdout
            .contains("+ skinbus --version\nskinbus ")
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
        let ended = run(&TestDir::new(), &commands);
        assert!(ended.code().is_some_and(|code| code != 0), "{commands:?}: {ended:#?}");
    }
}
