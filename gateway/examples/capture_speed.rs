//! Speed and memory use of the conversion of captures. `cargo bench -p gateway --bench captures` measures the reading
//! of text.
//!
//! ```text
//!   cargo build --release -p gateway && cargo run --release -p gateway --example capture_speed [LINES [FOLDER]]
//! ```
//!
//! Half of the lines are classic frames of 8 bytes, half FD frames of 16. The files of LINES lines (default: 10
//! million) are created in FOLDER, and removed afterwards.
#![expect(clippy::unwrap_used, reason = "a measurement may stop")]
#![expect(clippy::print_stdout, reason = "the figures are its output")]
#![expect(clippy::cast_precision_loss, reason = "counts far below 2^53")]

use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

mod watched;

/// Writes a line as `candump -L` does.
fn write_line(log: &mut String, line: u64) {
    let micros = 1_700_000_000_000_000 + line * 63;
    let (sec, micro, id) = (micros / 1_000_000, micros % 1_000_000, 0x200 + line % 253);
    let word = line.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    if line.is_multiple_of(2) {
        writeln!(log, "({sec}.{micro:06}) vcan0 {id:03X}#{word:016X}").unwrap();
    } else {
        let other = word ^ line;
        writeln!(log, "({sec}.{micro:06}) vcan0 {id:03X}##5{word:016X}{other:016X}").unwrap();
    }
}

/// Converts a file. Returns million lines per second, and the peak memory of the process in MB.
fn measure_conversion(gateway: &Path, from: &Path, to: &Path, lines: u64) -> (f64, f64) {
    let mut command = Command::new(gateway);
    command.arg("convert").arg(from).arg(to).arg("--overwrite").stderr(Stdio::null());
    let (seconds, memory) = watched::run_measured(&mut command);
    (lines as f64 / seconds / 1e6, memory)
}

fn main() {
    let mut arguments = protocol::usage::command_line().into_iter().skip(1);
    let lines: u64 = arguments.next().map_or(10_000_000, |lines| lines.parse().expect("LINES is a number"));
    let folder = arguments.next().map_or_else(std::env::temp_dir, PathBuf::from);

    let gateway = watched::gateway_program();
    let place = tempfile::tempdir_in(folder).unwrap();
    let [log, mcap, back] = ["run.log", "run.mcap", "back.log"].map(|name| place.path().join(name));
    let mut out = BufWriter::new(File::create(&log).unwrap());
    let mut line = String::new();
    for number in 0..lines {
        line.clear();
        write_line(&mut line, number);
        out.write_all(line.as_bytes()).unwrap();
    }
    out.flush().unwrap();
    drop(out);
    for _ in 0..3 {
        let (into, memory) = measure_conversion(&gateway, &log, &mcap, lines);
        println!("log to MCAP, million lines/s   {into:.2}, {memory:.0} MB");
        let (out, memory) = measure_conversion(&gateway, &mcap, &back, lines);
        println!("MCAP to log, million lines/s   {out:.2}, {memory:.0} MB");
    }
    let size = |path: &Path| std::fs::metadata(path).unwrap().len() as f64 / lines as f64;
    println!(
        "bytes per frame                {:.1} in the log, {:.1} in the recording",
        size(&log),
        size(&mcap)
    );
    let same = std::fs::read(&log).unwrap() == std::fs::read(&back).unwrap();
    println!("round trip                     {}", if same { "the same bytes" } else { "NOT the same bytes" });
}
