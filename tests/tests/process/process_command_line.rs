//! `docs/reference/command-line.md` lists every command and option of the programs, as their `-h` does.
//!
//! The lists are between `<!-- program: NAME -->` and `<!-- end -->`. With `SKINBUS_TAKE_OVER=yes` this test
//! writes it instead of comparing.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use std::fmt::Write;
use std::process::Command;

use process::program;

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/reference/command-line.md");
const PROGRAMS: [&str; 3] = ["skinbus", "cell-node", "vcan-setup"];

/// What a command prints for `-h`.
fn help(command: &[&str]) -> String {
    let [name, words @ ..] = command else { panic!("no program") };
    let output = Command::new(program(name)).args(words).arg("-h").env_remove("COLUMNS").output().unwrap();
    assert!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// Name and meaning of each entry below a heading of a help.
fn entries(help: &str, heading: &str) -> Vec<(String, String)> {
    let mut found: Vec<(String, String)> = Vec::new();
    let below = help.lines().skip_while(|line| *line != heading).skip(1);
    for line in below.take_while(|line| line.starts_with(' ')) {
        let text = line.trim_start();
        // Names start in column 2, or 6 without a short one; other lines continue a meaning.
        let (name, meaning) = match line.len() - text.len() {
            2 | 6 => text.split_once("  ").unwrap_or((text, "")),
            _ => ("", text),
        };
        if !name.is_empty() {
            found.push((name.to_owned(), meaning.trim_start().to_owned()));
        } else if let Some((_, more)) = found.last_mut() {
            more.push_str(if more.is_empty() { "" } else { " " });
            more.push_str(text);
        }
    }
    found
}

/// A table of a command's arguments and options, without those of the command above it; and the same of the commands
/// below it.
fn tables(command: &[&str], above: &[String], out: &mut String) {
    let help = help(command);
    let about = help.lines().take_while(|line| !line.is_empty()).collect::<Vec<_>>().join(" ");
    writeln!(out, "\n{} `{}`\n\n{about}.", "#".repeat(command.len() + 1), command.join(" ")).unwrap();
    let mut known = above.to_vec();
    let mut head = "\n| argument | meaning |\n|---|---|\n";
    for (name, meaning) in [entries(&help, "Arguments:"), entries(&help, "Options:")].concat() {
        if !known.contains(&name) {
            let (name, meaning) = (name.replace('|', "\\|"), meaning.replace('|', "\\|"));
            writeln!(out, "{head}| `{name}` | {meaning} |").unwrap();
            head = "";
        }
        known.push(name);
    }
    for (name, _) in entries(&help, "Commands:").into_iter().filter(|(name, _)| name != "help") {
        tables(&[command, &[name.as_str()]].concat(), &known, out);
    }
}

#[test]
fn the_document_lists_every_command_and_option_of_the_programs() {
    let mut document = std::fs::read_to_string(PATH).unwrap();
    let take_over = std::env::var_os("SKINBUS_TAKE_OVER").is_some();
    for name in PROGRAMS {
        let begin = format!("<!-- program: {name} -->\n");
        let from = document.find(&begin).unwrap_or_else(|| panic!("no {begin}")) + begin.len();
        let to =
            from + document[from..].find("\n<!-- end -->").unwrap_or_else(|| panic!("{name} has no end"));
        let mut listed = String::new();
        tables(&[name], &["-h, --help", "-V, --version"].map(str::to_owned), &mut listed);
        assert!(listed.contains("\n| `--"), "{name}: {listed}");
        if take_over {
            document.replace_range(from..to, &listed);
        } else {
            let written: Vec<_> = document[from..to].lines().collect();
            let listed: Vec<_> = listed.lines().collect();
            let same = written.iter().zip(&listed).take_while(|(a, b)| a == b).count();
            let (written, listed) = (written.get(same), listed.get(same));
            assert_eq!(written, listed, "line {same} of {name}; SKINBUS_TAKE_OVER=yes writes it again");
        }
    }
    if take_over {
        std::fs::write(PATH, document).unwrap();
    }
}
