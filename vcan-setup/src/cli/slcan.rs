//! The command `vcan-setup slcan`.

use std::os::unix::net::UnixStream;
use std::time::Duration;

use clap::Args;
use protocol::bus::{BusKind, KindChoice};
use protocol::id::CellId;
use protocol::usage::{Failure, print_text};
use protocol::wire_time::BitRates;
use serde::Serialize;
use signal_hook::consts::{SIGINT, SIGTERM};
use vcan_setup::slcan::options::{ALLOWED_SETTLE_TIMES, parse_settle_time};
use vcan_setup::slcan::{Bridge, BridgeError, BridgeSettings, LineAccount, LineOptions};

use super::{parse_bus_name, to_json};

/// Connect serial lines with the slcan protocol to a bus, until SIGINT or SIGTERM
///
/// A LINE is a terminal (/dev/ttyACM0), unix:PATH or tcp:HOST:PORT, followed by its own options after commas:
/// cell=12 or cell=1-8 (the line gets only frames that these cells receive), filter=100:700 (identifier and mask, as
/// in candump), rates=1M/5M, baud=115200, classic, settle=2. Each line has its own client of the bus. A lost line is
/// reopened when it returns. The bus never waits for a line: frames that a line cannot carry are dropped, and counted
/// by reason. Prints one line when all lines are open, and the counts of all frames at the end.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vcan-setup slcan vcan0 /dev/ttyACM0 --cell 12 --bit-rates 1M/5M
  vcan-setup slcan vcan0 unix:/tmp/12.sock,cell=12 unix:/tmp/13.sock,cell=13 --wait
  vcan-setup slcan vcan0 /dev/ttyUSB0,cell=12,baud=57600,classic --bit-rates 500k

docs/how-to/adapters.md lists adapters that support slcan.")]
pub(crate) struct SlcanOptions {
    /// Name of the bus
    #[arg(value_parser = parse_bus_name)]
    bus: String,
    /// Serial lines to the adapters: PATH, unix:PATH or tcp:HOST:PORT. Options of one line follow after commas, such as
    /// PATH,cell=12 for --cell 12
    #[arg(value_name = "LINE", required = true)]
    lines: Vec<LineOptions>,
    /// Node id of the cell on each LINE; repeat the option in the order of the lines
    #[arg(long, value_name = "N", value_parser = parse_cell_id)]
    cell: Vec<CellId>,
    /// Bit rates to set in the adapters, such as 500k or 1M/5M [default: unchanged]
    #[arg(long, value_name = "RATES")]
    bit_rates: Option<BitRates>,
    /// Baud rate of the serial ports in bit/s [default: unchanged]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    baud: Option<u32>,
    /// The adapters support classic CAN only: FD frames from the bus are dropped
    #[arg(long)]
    classic: bool,
    /// Seconds to wait after opening a line, for boards that it resets (Arduino, ESP32) [default: 0]
    #[arg(long, value_name = "SECONDS", value_parser = parse_settle)]
    settle: Option<Duration>,
    /// Start even if lines cannot be opened yet, and open them when they appear
    #[arg(long)]
    wait: bool,
    #[arg(long, value_name = "KIND", default_value_t = KindChoice::Auto, help = BusKind::help())]
    bus_kind: KindChoice,
    /// At the end, print the counts of all frames as JSON
    #[arg(long)]
    json: bool,
}

fn parse_cell_id(word: &str) -> Result<CellId, String> {
    let number = word.parse().map_err(|_| "it must be a node id, 1 to 254".to_owned())?;
    CellId::new(number).map_err(|error| error.to_string())
}

fn parse_settle(word: &str) -> Result<Duration, String> {
    parse_settle_time(word).ok_or_else(|| ALLOWED_SETTLE_TIMES.to_owned())
}

#[derive(Serialize)]
struct SlcanReport<'a> {
    bus: &'a str,
    bus_kind: &'static str,
    lines: &'a [LineAccount],
}

impl SlcanOptions {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let lines = self.line_options()?;
        let (stop, stopped) = UnixStream::pair().map_err(signal_error)?;
        for signal in [SIGINT, SIGTERM] {
            let stop = stop.try_clone().map_err(signal_error)?;
            signal_hook::low_level::pipe::register(signal, stop).map_err(signal_error)?;
        }
        let settings =
            BridgeSettings { bus: self.bus.clone(), choice: self.bus_kind, directory: None, wait: self.wait };
        let count = lines.len();
        let bridge = Bridge::open(settings, lines).map_err(|error| {
            if matches!(error, BridgeError::Twice(_)) {
                Failure::usage_error(error)
            } else {
                Failure::run_error(error)
            }
        })?;
        let (bus, kind, away) = (&self.bus, bridge.kind(), bridge.unavailable_lines());
        let noun = if count == 1 { "line" } else { "lines" };
        let mut ready = format!("{count} {noun} on {bus} ({kind})");
        if !away.is_empty() {
            ready += &format!(", not open yet: {}", away.join(", "));
        }
        // With `--json`, standard output contains only the JSON.
        if self.json {
            print_to_stderr(&ready)
        } else {
            print_text(&format!("{ready}\n"))?
        }
        let accounts = bridge.run(stopped, |line, event| print_to_stderr(&format!("{line}: {event}")));
        let accounts = accounts.map_err(Failure::run_error)?;
        if self.json {
            return print_text(&to_json(&SlcanReport { bus, bus_kind: kind.name(), lines: &accounts })?);
        }
        print_text(&accounts.iter().map(|account| format!("{account}\n")).collect::<String>())
    }

    /// Returns the lines of the command line. The general options are added to those of each line.
    fn line_options(&self) -> Result<Vec<LineOptions>, Failure> {
        let mut lines = self.lines.clone();
        if !self.cell.is_empty() && self.cell.len() != lines.len() {
            return Err(Failure::usage_error(format!(
                "there are {} --cell options for {} lines: give one for each line, or write \
                 /dev/ttyACM0,cell=12",
                self.cell.len(),
                lines.len()
            )));
        }
        for (line, cell) in lines.iter_mut().zip(&self.cell) {
            line.add_cell(*cell);
        }
        for line in &mut lines {
            line.classic |= self.classic;
            line.baud = line.baud.or(self.baud);
            line.settle = if line.settle.is_zero() { self.settle.unwrap_or_default() } else { line.settle };
            if let Some(rates) = self.bit_rates.filter(|_| line.bit_rates.is_none()) {
                line.set_bit_rates(rates)
                    .map_err(|error| Failure::usage_error(format!("--bit-rates {rates}: {error}")))?;
            }
        }
        Ok(lines)
    }
}

fn signal_error(error: std::io::Error) -> Failure {
    Failure::run_error(format!("cannot catch signals: {error}"))
}

fn print_to_stderr(text: &str) {
    protocol::usage::eprint_line(&format!("vcan-setup: {text}"));
}
