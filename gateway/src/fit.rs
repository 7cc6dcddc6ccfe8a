//! `skinbus fit`.

mod skin;
mod skin_text;
mod traffic;

use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use protocol::can::Format;
use protocol::input::can_be_read_again;
use protocol::usage::Failure;
use protocol::wire_time::{BitRates, parse_bit_rate};
use trace::capture::{CaptureFormat, Reader};

use super::arguments::{BusKinds, FORMATS, one_of_values, parse_duration};
use super::input::{is_file, read_skin};
use super::print::comma_separated;

/// Headings in the help of options that need the one or the other kind of source.
const FOR_SKIN: &str = "Options for a skin";
const FOR_TRAFFIC: &str = "Options for traffic";

/// Compute whether a skin, or the traffic of a capture or a live bus, fits on real buses
///
/// For a skin, computes the worst case: load, time from a joints message to the last answer, cells and buses, with the
/// longest frames that bit stuffing allows, all cells answering, and no errors. Heartbeats count; commands and
/// bench-only frames do not. Default bit rates: those of the skin if it has them for all buses, else a table of common
/// ones.
///
/// For a capture (a candump log or an MCAP recording, of any CAN bus), or for live buses until Ctrl-C, computes when
/// each frame would be sent on a bus with bit rates: exact stuff bits, arbitration by identifier, no frame interrupted.
/// A frame's time stamp counts as the time of the request to send it. Leaves out bench-only frames, reports start-up
/// separately, and adds the worst case when the skin is known. docs/how-to/size-a-bus.md explains both.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus fit gateway/examples/ur5-253.toml
  skinbus fit gateway/examples/ur5-253.toml --nominal 1M --data 5M
  skinbus skin generate --buses 3 | skinbus fit - --nominal 500k --format classic
  skinbus fit run.mcap run-*.mcap
  skinbus fit run.mcap --rates vcan0=1M/8M --rates vcan1=500k
  skinbus fit run.log --skin skin.toml --json | jq -c 'select(.end_s and .end_s - .time > 0.016)'
  skinbus fit vcan0 vcan1 --duration 10")]
pub(crate) struct FitCommand {
    /// Skin file, for its load when all cells answer; or recorded frames, in a candump log or an MCAP recording (all
    /// parts of a split one); or live buses. `-` is standard input: a skin if --table, --format or --computation is
    /// given, else frames
    #[arg(value_name = "SKIN|FILE|BUS", required = true)]
    sources: Vec<PathBuf>,
    /// Nominal bit rate in bit/s, used for identifiers and for whole classic frames, such as 1000000, 500k or 1M
    #[arg(long, value_name = "RATE", value_parser = parse_bit_rate)]
    nominal: Option<u32>,
    /// Bit rate of the data in CAN FD frames with bit-rate switch
    #[arg(long, value_name = "RATE", value_parser = parse_bit_rate)]
    data: Option<u32>,
    /// Print a table for common bit rates instead of using the skin's rates
    #[arg(help_heading = FOR_SKIN, long, conflicts_with = "nominal")]
    table: bool,
    /// Assume this frame format on all buses, instead of the skin's formats
    #[arg(help_heading = FOR_SKIN, long, value_parser = one_of_values(FORMATS))]
    format: Option<Format>,
    /// Longest time in µs that a cell needs to compute its answer [default: 68.5, as in the paper of docs/explanation/paper.md]
    #[arg(help_heading = FOR_SKIN, long, value_name = "US", value_parser = parse_computation_ns)]
    computation: Option<u64>,
    /// Assumed bit rates of a bus, such as can0=500k/2M or can1=1M; repeat the option for further buses
    #[arg(help_heading = FOR_TRAFFIC, long, value_name = "BUS=RATES", value_parser = rates_of_bus)]
    rates: Vec<(String, BitRates)>,
    /// Skin file, for its bit rates and worst case (all cells answer) [default: the skin in the recording]
    #[arg(help_heading = FOR_TRAFFIC, long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Also count frames that only a test bench sends (stimuli, sync, report, their answers, simulated
    /// wires)
    #[arg(help_heading = FOR_TRAFFIC, long)]
    bench_traffic: bool,
    /// Meaning of the time stamps of frames [default: end on embedded buses whose frames take time and in their
    /// recordings, else request]
    #[arg(help_heading = FOR_TRAFFIC, long, value_enum, value_name = "MEANING")]
    time_stamps: Option<TimeStamps>,
    /// Assumed bit error rate, 0 to 0.01 [default: 0]; each damaged frame causes an error frame and a
    /// retransmission
    #[arg(help_heading = FOR_TRAFFIC, long, value_name = "SHARE", allow_negative_numbers = true)]
    ber: Option<f64>,
    /// Random seed for bit errors [default: 1]
    #[arg(help_heading = FOR_TRAFFIC, long, value_name = "N", requires = "ber")]
    seed: Option<u64>,
    /// Duration of the measurement on live buses [default: until Ctrl-C]
    #[arg(help_heading = FOR_TRAFFIC, long, value_name = "TIME", value_parser = parse_duration, allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Print JSON instead of tables: one object for a skin, one for each frame of traffic
    ///
    /// Keys of a frame: bus; id, as candump prints it; time, its time stamp; start_s and end_s, its computed start and
    /// end (all in s, on the clock of the capture); nominal_bits and data_bits, including stuff bits and intermission;
    /// time_is, which is "end" if the time stamp is the end of the frame, and absent otherwise. For frames
    /// that could not be sent, start_s and end_s are null; for uncounted frames, nominal_bits and data_bits too.
    #[arg(long, short)]
    json: bool,
    #[command(flatten)]
    kinds: BusKinds,
}

/// Meaning of the time stamps of frames.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum TimeStamps {
    /// Time of the request, as on a bus where frames take no time: computes when each frame would be sent
    Request,
    /// Time of the frame's end, as in a capture of a real bus: computes the load, but no queueing
    End,
}

impl FitCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let Some(skin) = self.skin_file()? else { return self.print_traffic_fit() };
        let of_traffic = [
            ("--rates", !self.rates.is_empty()),
            ("--skin", self.skin.is_some()),
            ("--bench-traffic", self.bench_traffic),
            ("--time-stamps", self.time_stamps.is_some()),
            ("--ber", self.ber.is_some()),
            ("--duration", self.duration.is_some()),
        ];
        let file = skin.display();
        if let Some((option, _)) = of_traffic.iter().find(|(_, given)| *given) {
            return Err(Failure::usage_error(format!(
                "{option} is only for frames of a log, recording or bus, but {file} is a skin: leave the \
                 option out"
            )));
        }
        if self.data.is_some() && self.nominal.is_none() {
            return Err(Failure::usage_error("--data needs --nominal if a skin is given: add --nominal"));
        }
        let skin = read_skin(skin)?;
        self.print_skin_fit(&skin)
    }

    /// Returns the path of the skin's file, if the sources name one.
    fn skin_file(&self) -> Result<Option<&Path>, Failure> {
        let [source] = self.sources.as_slice() else { return Ok(None) };
        let is_text = source.extension().is_some_and(|end| end == "toml");
        let of_skin = [
            ("--table", self.table),
            ("--format", self.format.is_some()),
            ("--computation", self.computation.is_some()),
        ];
        let given = of_skin.iter().find(|(_, given)| *given).map(|(option, _)| *option);
        let is_skin = is_file(source) && (is_text || given.is_some() || !is_capture(source));
        match given {
            Some(option) if !is_skin => {
                let names = comma_separated(self.sources.iter().map(|source| source.display()));
                Err(Failure::usage_error(format!(
                    "{option} is only for a skin, but {names} is not a skin: leave the option out"
                )))
            }
            _ => Ok(is_skin.then_some(source)),
        }
    }
}

/// Returns true if the file is a capture. A file that cannot be identified, or that can be read only once, counts as a
/// capture.
fn is_capture(file: &Path) -> bool {
    if !can_be_read_again(file) {
        return true;
    }
    let Ok(mut reader) = Reader::open(file) else { return true };
    reader.format() == CaptureFormat::Mcap || reader.has_frame().unwrap_or(true)
}

fn rates_of_bus(text: &str) -> Result<(String, BitRates), String> {
    let (bus, rates) = text.split_once('=').unwrap_or_default();
    if bus.is_empty() {
        return Err("use a bus and its bit rates, such as can0=1M/5M or can0=500k".to_owned());
    }
    let rates = rates.parse().map_err(|error| format!("{bus}: {error}"))?;
    Ok((bus.to_owned(), rates))
}

/// Parses a time in µs with up to three decimals, and returns it in ns.
fn parse_computation_ns(text: &str) -> Result<u64, String> {
    let allowed = "0 to 65000 µs";
    let us: f64 = text.parse().map_err(|_| format!("not a number: use {allowed}"))?;
    if !(0.0..=65_000.0).contains(&us) {
        return Err(format!("out of range: use {allowed}"));
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 65 000 000")]
    let ns = (us * 1e3).ceil() as u64;
    Ok(ns)
}
