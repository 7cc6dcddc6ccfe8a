//! The micro:bit's firmware against every requirement of its documents, resets included.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop")]

use skinbus_tests::process;

use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::Duration;

use bench::emulate::Firmware;
use process::{Running, TestDir};
use protocol::can::Format;
use protocol::factory::FactoryRecord;
use protocol::id::CellId;

/// A script that starts or restarts the emulator.
const RESTART: &str = r#"#!/bin/sh
[ -f pid ] && kill -9 $(cat pid)
rm -f line
qemu-system-arm -M microbit -display none -monitor none -serial chardev:line -kernel cell.elf \
    -chardev socket,id=line,path=line,server=on,wait=on \
    -semihosting-config enable=on,target=native,arg=flash </dev/null >/dev/null 2>&1 &
echo $! > pid
"#;

/// Ends the emulator with the test.
struct Emulator<'a>(&'a TestDir);

impl Emulator<'_> {
    fn sh(&self, script: &str) {
        let mut command = self.0.command_of(Path::new("sh"), "");
        let status = command.arg("-c").arg(script).stdout(Stdio::null()).status().unwrap();
        assert!(status.success(), "{script}");
    }
}

impl Drop for Emulator<'_> {
    fn drop(&mut self) {
        let _ = Command::new("sh").arg("-c").arg("kill -9 $(cat pid)").current_dir(self.0.path("")).status();
    }
}

/// Attempts to meet a requirement after the first one.
const ATTEMPTS: u64 = 9;

fn conforms(format: Format) {
    let place = TestDir::new();
    let path = std::env::var_os("SKINBUS_FIRMWARE").expect("tests/firmware/run names it");
    let factory = FactoryRecord {
        node: CellId::new(12).ok(),
        serial: 100_012,
        format,
        hosted: true,
        link_ids: [None; 5],
    };
    fs::write(place.path("cell.elf"), Firmware::read(Path::new(&path)).unwrap().image_for_cell(&factory))
        .unwrap();
    place.write("restart.sh", RESTART);
    let server = place.start("vcan-setup", "serve vcan0");
    server.wait_for_stdout("serving vcan0 at ");
    let emulator = Emulator(&place);
    emulator.sh("sh restart.sh");
    let line = place.path("line");
    let slcan = place.start("vcan-setup", &format!("slcan vcan0 unix:{},cell=12 --wait", line.display()));
    place.test_client_of(format).waits_for("a heartbeat of the cell", |_| true);
    let words = format!("conformance --bus vcan0 --bus-kind embedded --cell 12 --format {}", format.name());
    // Returns the failed requirements; `None` if the test could not begin, because the cell was silent.
    let failed = |only: &[&str]| -> Option<Vec<String>> {
        let mut command = place.command("skinbus", &words);
        command.args(["--restart", "sh restart.sh", "--overwrite"]).args(only);
        let ended = Running::start(command).end_after(Duration::from_secs(120));
        if ended.stderr.contains("cell 12 sends nothing on vcan0") {
            return None;
        }
        assert!(ended.stdout.contains(" passed, "), "{ended:#?}");
        let all = ended.stdout.lines().filter(|line| line.contains("FAILED"));
        Some(all.filter_map(|line| Some(line.split_whitespace().nth(1)?.to_owned())).collect())
    };
    // A busy machine may stop the emulator for longer than the few milliseconds that the documents allow a cell, or
    // than the survey before the test, and packets of a killed one may still be on their way. A requirement therefore
    // has to be met in one of a few attempts, between which the machine may become less busy.
    for requirement in failed(&[]).expect("the cell has sent a heartbeat") {
        let meets = |attempt| {
            thread::sleep(Duration::from_secs(attempt));
            failed(&["--requirement", &requirement]).is_some_and(|failed| failed.is_empty())
        };
        assert!((0..ATTEMPTS).any(meets), "{requirement}, {ATTEMPTS} times more");
    }
    drop((slcan, server));
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn the_firmware_conforms_on_an_fd_bus() {
    conforms(Format::Fd);
}

#[test]
#[ignore = "needs tests/firmware/run"]
fn the_firmware_conforms_on_a_classic_bus() {
    conforms(Format::Classic);
}
