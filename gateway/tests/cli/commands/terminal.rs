//! Terminal output of names that come from files.

use std::fs::File;
use std::io::Read;

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

use super::*;

/// Everything that a command writes to a terminal, on both outputs.
fn on_terminal(arguments: &str) -> String {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).unwrap();
    grantpt(&master).unwrap();
    unlockpt(&master).unwrap();
    let path = ptsname(&master, Vec::new()).unwrap();
    let slave = File::options().read(true).write(true).open(path.to_str().unwrap()).unwrap();
    let mut command = gateway(arguments);
    command.stdin(Stdio::null()).stdout(slave.try_clone().unwrap()).stderr(slave);
    let mut child = command.spawn().unwrap();
    // The command holds the terminal too.
    drop(command);
    let mut said = Vec::new();
    // Reading a terminal that no process holds any more is an error.
    let _ = File::from(master).read_to_end(&mut said);
    child.wait().unwrap();
    String::from_utf8(said).unwrap().replace("\r\n", "\n")
}

fn is_harmless(text: &str) -> bool {
    let obeyed = |letter: char| letter.is_control() && letter != '\n' && letter != '\t';
    !text.contains(obeyed) && !text.contains('\u{202e}')
}

#[test]
fn no_name_that_a_file_chose_is_obeyed() {
    let folder = TempDir::new().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let bus = "c\x1b[2J\x1b]0;x\x07\u{9b}1m\u{202e}\x7f";
    let log = format!(
        "(1.000000) {bus} 123#11\n(2.000000) {bus} 1z\n(3.000000) {bus} 20C##5001000F80100000000000000070175D6\n"
    );
    std::fs::write(path("x.log"), &log).unwrap();
    std::fs::write(path("\x1b[2Jy.log"), &log).unwrap();
    std::fs::write(path("empty\n\x1b[2J.log"), "").unwrap();
    let skin =
        std::fs::read_to_string(format!("{}/examples/ur5-253.toml", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let named =
        skin.lines().map(|line| if line.starts_with("name") { r#"name = "a\u001b[2J\nb""# } else { line });
    let named: Vec<_> = named.collect();
    std::fs::write(path("skin.toml"), named.join("\n")).unwrap();
    std::fs::write(path("unknown.toml"), format!("\"\\u001b[2J\" = 1\n{skin}")).unwrap();
    std::fs::write(path("bus.toml"), skin.replacen("can0", "\\u001b[2J", 1)).unwrap();
    let (x, y, skin) = (path("x.log"), path("\x1b[2Jy.log"), path("skin.toml"));
    for arguments in [
        format!("dump {x}"),
        format!("dump {x} --brief"),
        format!("dump {x} --json"),
        format!("dump {x} --stats"),
        format!("convert {x} -"),
        format!("dump {x} --stats --json"),
        format!("dump {y} --strict"),
        format!("dump {y} --stats"),
        format!("dump {}", path("empty\n\x1b[2J.log")),
        format!("fit {x}"),
        format!("fit {x} --json"),
        format!("explain {x} --skin {skin} --epoch 7"),
        format!("replay {x}"),
        format!("check {skin} --list"),
        format!("check {}", path("unknown.toml")),
        format!("check {}", path("bus.toml")),
        format!("fit {skin}"),
        format!("skin dbc {skin}"),
        format!("run {}", path("unknown.toml")),
    ] {
        let said = on_terminal(&arguments);
        assert!(is_harmless(&said) && !said.trim().is_empty(), "{arguments}: {said:?}");
    }
    // People read standard error wherever it leads; a name must not start a second line.
    let Output { stderr, .. } = gateway(&format!("dump {}", path("empty\n\x1b[2J.log"))).output().unwrap();
    let said = text(&stderr);
    assert!(said.ends_with("empty\\u{a}\\u{1b}[2J.log: the file is empty\n"), "{said}");
    assert_eq!(said.matches('\n').count(), 1, "{said}");
    // The output of a pipe may reach a terminal.
    let shown = gateway(&format!("dump {x}")).output().unwrap();
    assert!(text(&shown.stdout).starts_with(r"(1.000000) c\u{1b}[2J"), "{shown:?}");
}
