//! `skinbus shadow`.

mod show;

use std::io::{self, BufWriter, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use analysis::fit::rates::Requested;
use analysis::shadow::{self, Shadow};
use clap::Args;
use protocol::bus::{BusError, Options};
use protocol::skin::Skin;
use protocol::stop::{self, Stoppable};
use protocol::usage::{Failure, print, written};
use protocol::wire_time::{BitRates, bit_rate};
use trace::capture::{Entry, NoteKind, Reader};

use self::show::write_frames;
use super::arguments::{BusKind, nanos};
use super::input::{
    self, LOOK, Missing, ReceiveEnd, captures, is_file, no_frame, place, remark_another, skin_beside, stopped,
};
use super::output;
use super::print::list;

/// Bytes for frames that wait while others are worked on.
const RECEIVE_BUFFER: usize = 8 << 20;

/// Compute the timing of some traffic on a real bus: its load, the delay of each frame, late answers, queues
///
/// vcan and the embedded bus have no bit rate: everything fits them. This takes the traffic of a capture (a candump
/// log or an MCAP recording, of any CAN bus), or of live buses until Ctrl-C, through a model of a bus with bit rates:
/// exact stuff bits, arbitration by identifier, no frame interrupted. A frame's time stamp counts as the time at
/// which it was to be sent. What only a bench sends is left out, start-up stands apart, and where the skin is known (attached
/// to a recording, or --skin) its worst case stands beside the run. docs/reference/bus-timing.md explains the figures and what the model
/// leaves out.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus shadow run.mcap
  skinbus shadow run.mcap run-*.mcap
  skinbus shadow run.log --nominal 500k --data 2M
  skinbus shadow run.mcap --rates vcan0=1M/8M --rates vcan1=500k
  skinbus shadow run.log --skin skin.toml
  skinbus shadow run.log --json | jq -c 'select(.end_s and .end_s - .time > 0.016)'
  skinbus shadow vcan0 vcan1 --duration 10")]
pub(crate) struct ShadowCommand {
    /// A candump log or MCAP recording when there is a file of this name, all parts of a split recording in any order,
    /// - for standard input, else buses
    #[arg(value_name = "FILE|BUS", required = true)]
    sources: Vec<PathBuf>,
    /// The bit rate of identifiers, and of all of classic frames: bit/s, as 500k or 1M; else the skin's, else 1M
    #[arg(long, value_name = "RATE", value_parser = bit_rate)]
    nominal: Option<u32>,
    /// The bit rate of the data of CAN FD frames that switch; else the skin's, else 5M
    #[arg(long, value_name = "RATE", value_parser = bit_rate)]
    data: Option<u32>,
    /// Other bit rates of one bus, as often as there are buses: can0=500k/2M, can1=1M
    #[arg(long, value_name = "BUS=RATES", value_parser = rates_of_bus)]
    rates: Vec<(String, BitRates)>,
    /// The skin's description, for bit rates and the worst case; else the one attached to the recording
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Count what only a bench sends too: stimuli, sync and report with their answers, simulated wires
    #[arg(long)]
    bench_traffic: bool,
    /// The share of bits that arrive damaged, 0 to 0.01: each costs an error frame, and its frame is sent again
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_negative_numbers = true)]
    ber: f64,
    /// What damaged bits are drawn from: the same seed, the same bits
    #[arg(long, value_name = "N", default_value_t = 1)]
    seed: u64,
    /// One JSON object a frame instead of tables, in the order of the file
    ///
    /// Keys: time, start_s, end_s (s on the clock of the capture), bus, id (as candump prints it), nominal_bits and data_bits
    /// (stuff bits and intermission included). What is left out has null bits and null times; what never went out has null times.
    #[arg(long)]
    json: bool,
    /// End a live shadow after so many seconds
    #[arg(long, value_name = "S", value_parser = nanos, allow_negative_numbers = true)]
    duration: Option<u64>,
    #[command(flatten)]
    kind: BusKind,
}

fn rates_of_bus(text: &str) -> Result<(String, BitRates), String> {
    let (bus, rates) = text.split_once('=').unwrap_or_default();
    if bus.is_empty() {
        return Err("a bus and its bit rates are needed, as can0=1M/5M or can0=500k".to_owned());
    }
    let rates = rates.parse().map_err(|error| format!("{bus}: {error}"))?;
    Ok((bus.to_owned(), rates))
}

/// What was taken in, beside the frames.
struct Taken {
    /// What it was read from.
    what: &'static str,
    /// Frames that the recorder lost.
    missing: u64,
    /// Why there is no more, if not because that was all.
    ended: Result<(), Failure>,
}

impl ShadowCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let skin = self.skin.as_deref().map(Skin::read).transpose().map_err(Failure::usage)?;
        if let (Some(path), Some(skin)) = (&self.skin, &skin) {
            remark_another(&self.sources, path, skin);
        }
        let mut out = BufWriter::new(Stoppable::new(io::stdout()));
        let name = list(self.sources.iter().map(|source| source.display()));
        let mut title = name.clone();
        let (mut shadow, taken) = if self.are_captures(&name)? {
            let reader = captures(&self.sources, |file| Box::new(file))?;
            reader.name().clone_into(&mut title);
            let mut shadow = self.shadow(skin.or_else(|| skin_beside(&reader, "name one with --skin")))?;
            for before in &reader.extras().latched {
                shadow.latched(&before.bus, before.nanos, &before.frame);
            }
            let taken = captured(reader, &mut shadow, &mut out)?;
            (shadow, taken)
        } else {
            let stopped = stopped()?;
            let mut shadow = self.shadow(skin)?;
            let taken = self.live(&mut shadow, &mut out, &stopped)?;
            (shadow, taken)
        };
        shadow.finish();
        written(write_frames(&mut shadow, &mut out).and_then(|()| out.flush()))?;
        drop(out);
        let report = shadow.report();
        for (bus, _) in &self.rates {
            if report.buses.iter().all(|it| it.bus != *bus) {
                output::note(format_args!("--rates {bus}=…: {name} has no frame of {bus}"));
            }
        }
        if !self.json && report.frames > 0 {
            print(&show::text(&title, taken.what, taken.missing, &report))?;
        }
        taken.ended
    }

    /// Whether the arguments are captures, and not buses.
    fn are_captures(&self, name: &str) -> Result<bool, Failure> {
        match self.sources.iter().filter(|source| is_file(source)).count() {
            0 => return Ok(false),
            files if files < self.sources.len() => {
                return Err(Failure::usage(format!(
                    "{name}: one file, the parts of one recording, or buses without a file"
                )));
            }
            _ => {}
        }
        if self.duration.is_some() {
            return Err(Failure::usage(format!("--duration is for live buses, and {name} is a file")));
        }
        self.sources.iter().find(|source| source.is_dir()).map_or(Ok(true), |folder| {
            Err(Failure::usage(format!(
                "{} is a directory: name a candump log, an MCAP recording or a bus",
                folder.display()
            )))
        })
    }

    /// With the rates of the command line, else of the skin, else common ones.
    fn shadow(&self, skin: Option<Skin>) -> Result<Shadow, Failure> {
        let requested = Requested { nominal: self.nominal, data: self.data };
        let mut of_bus = self.rates.clone();
        for bus in skin.iter().flat_map(|skin| &skin.buses) {
            let rates = requested.of_bus(bus);
            let rates = rates.map_err(|error| Failure::usage(format!("bus {}: {error}", bus.name)))?.rates;
            of_bus.push((bus.name.clone(), rates));
        }
        let options = shadow::Options {
            of_bus,
            bit_errors: self.ber,
            seed: self.seed,
            each_frame: self.json,
            bench_traffic: self.bench_traffic,
            skin,
            ..shadow::Options::new(requested.rates().map_err(Failure::usage)?)
        };
        Shadow::new(options).map_err(|error| Failure::usage(format!("--ber: {error}")))
    }

    /// Receives from buses until a signal.
    fn live(
        &self,
        shadow: &mut Shadow,
        out: &mut impl Write,
        stopped: &AtomicBool,
    ) -> Result<Taken, Failure> {
        let open = |source: &PathBuf| {
            let options = Options { receive_buffer: RECEIVE_BUFFER, ..Options::default() };
            ReceiveEnd::open(&source.display().to_string(), self.kind.bus_kind, None, options)
        };
        let mut receive_ends = self.sources.iter().map(open).collect::<Result<Vec<_>, _>>()?;
        let end = self.duration.map(|nanos| Instant::now() + Duration::from_nanos(nanos));
        let mut ended = Ok(());
        while ended.is_ok() && !stopped.load(Ordering::Relaxed) && end.is_none_or(|end| Instant::now() < end)
        {
            wait(&receive_ends)?;
            for receive_end in &mut receive_ends {
                if let Err(error) = take(receive_end, shadow) {
                    ended = Err(Failure::run(error));
                }
            }
            if let Err(error) = write_frames(shadow, out).and_then(|()| out.flush()) {
                written(Err(error))?;
                break;
            }
        }
        let mut missing = 0;
        for receive_end in &receive_ends {
            let lost = receive_end.missing("read");
            shadow.missing(receive_end.bus().name(), lost);
            missing += lost;
        }
        Ok(Taken { what: "live", missing, ended })
    }
}

/// Takes what has come.
fn take(receive_end: &mut ReceiveEnd, shadow: &mut Shadow) -> Result<(), BusError> {
    while receive_end.hear(Duration::ZERO)? {
        for received in receive_end.frames() {
            shadow.frame(receive_end.bus().name(), received.at_nanos, &received.frame);
        }
    }
    Ok(())
}

/// Waits until a frame comes, or it is time to look at other things.
fn wait(receive_ends: &[ReceiveEnd]) -> Result<(), Failure> {
    use rustix::event::{PollFd, PollFlags, Timespec, poll};
    let mut fds: Vec<_> =
        receive_ends.iter().map(|receive_end| PollFd::new(receive_end.bus(), PollFlags::IN)).collect();
    match poll(&mut fds, Timespec::try_from(LOOK).ok().as_ref()) {
        Ok(_) | Err(rustix::io::Errno::INTR) => Ok(()),
        Err(errno) => Err(Failure::run(io::Error::from(errno))),
    }
}

/// Takes in a capture, and reports what is missing of it.
fn captured(mut reader: Reader, shadow: &mut Shadow, out: &mut impl Write) -> Result<Taken, Failure> {
    let name = reader.name().to_owned();
    let what = input::format(&reader);
    let (mut frames, mut missing) = (0_u64, Missing::default());
    let mut ended = loop {
        match reader.next() {
            Ok(None) => break Ok(()),
            Err(error) => break Err(Failure::run(error)),
            Ok(Some(Entry::Frame(record))) => {
                frames += 1;
                shadow.frame(record.interface, record.time.nanos, &record.frame);
                if let Err(error) = write_frames(shadow, out) {
                    written(Err(error))?;
                    return Ok(Taken { what, missing: missing.frames, ended: Ok(()) });
                }
            }
            Ok(Some(Entry::Note(note))) => {
                missing.take(&note);
                match note.kind {
                    NoteKind::Dropped(lost) if !note.interface.is_empty() => {
                        shadow.missing(note.interface, lost);
                    }
                    NoteKind::Unreadable(why) if missing.unreadable() == 1 => {
                        output::note(format_args!("{}: {why}", place(&name, note.line)));
                    }
                    NoteKind::Text | NoteKind::CanXl | NoteKind::Dropped(_) | NoteKind::Unreadable(_) => {}
                }
            }
        }
    };
    if !reader.has_times() {
        shadow.without_times();
    }
    missing.tell(&reader, "left out");
    if stop::flag().load(Ordering::Relaxed) {
        output::note(format_args!("{name}: stopped after {frames} frames"));
    } else if frames == 0 && ended.is_ok() {
        ended = Err(no_frame(&reader));
    }
    Ok(Taken { what, missing: missing.frames, ended })
}
