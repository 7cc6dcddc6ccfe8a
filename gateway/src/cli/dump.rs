//! `gateway dump`.

use std::fmt::Write as _;
use std::fs::File;
use std::io::{self, BufWriter, IsTerminal, Read, Write};
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use clap::{Args, ValueEnum};
use gateway::decode::lines::Lines;
use gateway::decode::pick::{self, Pick, Wanted};
use gateway::decode::{Decoded, Decoder};
use protocol::bus::{Bus, BusError, Choice, Inbox, Options};
use protocol::can::{self, EXTENDED_MASK, Frame};
use protocol::candump::{self, Direction, Line, Record, Timestamp};
use protocol::id::Node;
use protocol::time::Micros;
use protocol::usage::{Failure, written};
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use super::output;

/// How long a signal to end may wait, when nothing comes.
const LOOK: Duration = Duration::from_millis(200);

/// Show what is on a bus, or in a candump log, in words beside the raw frames
///
/// One line a frame: the frame as `candump -L` prints it, a tab, a verdict (ok; half, the first frame of two on
/// a classic bus; foreign, length, CRC or meaning when it is refused), and what the frame says. So `cut -f1`
/// gives the log back. Lines of a log that cannot be read are named on standard error, and the rest is shown.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway dump vcan0 --kind torque --node 12
  gateway dump run.log --kind joints,sync --from 2 --to 2.5
  candump -L can0 | gateway dump - --max 100")]
pub(crate) struct Dump {
    /// A candump log when there is a file of this name, - for standard input, else a bus
    #[arg(value_name = "BUS|FILE")]
    source: PathBuf,
    /// Only these kinds: command, sum, torque, sensors, network, configure, configured, stimulus; also halt,
    /// joints, sync, resume, report alone, and foreign
    #[arg(long, value_name = "KIND", value_delimiter = ',')]
    kind: Vec<Wanted>,
    /// Only packets from or to these: a cell's number, gateway, everyone
    #[arg(long, value_name = "NODE", value_delimiter = ',', value_parser = pick::node)]
    node: Vec<Node>,
    /// Only from so many seconds after the first frame on
    #[arg(long, value_name = "S", value_parser = nanos, allow_negative_numbers = true)]
    from: Option<u64>,
    /// Only up to, and without, so many seconds after the first frame; ends a live dump
    #[arg(long, value_name = "S", value_parser = nanos, allow_negative_numbers = true)]
    to: Option<u64>,
    /// End after N lines
    #[arg(long, value_name = "N")]
    max: Option<u64>,
    /// What packets travel in; auto takes each frame for what it is
    #[arg(long, value_enum, default_value = "auto")]
    format: Format,
    /// socketcan or embedded; else SocketCAN where the kernel has CAN, the embedded bus where not
    #[arg(long, value_name = "KIND", default_value_t = Choice::Auto)]
    bus_kind: Choice,
}

/// What packets travel in.
#[derive(Clone, Copy, Debug, Eq, PartialEq, ValueEnum)]
enum Format {
    /// Each frame as it is
    Auto,
    /// One CAN FD frame
    Fd,
    /// Two classic frames
    Classic,
}

#[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 1e18: checked")]
fn nanos(text: &str) -> Result<u64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=1e9).contains(&seconds) => Ok((seconds * 1e9).round() as u64),
        _ => Err("a number of seconds from 0 to 1e9".to_owned()),
    }
}

impl Dump {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name = self.source.display().to_string();
        let file = if self.source.as_os_str() == "-" {
            let input = io::stdin().as_fd().try_clone_to_owned();
            Some(input.map_err(|error| Failure::run(format!("standard input: {error}")))?.into())
        } else if self.source.exists() {
            if self.source.is_dir() {
                return Err(Failure::usage(format!("{name} is a directory: name a candump log or a bus")));
            }
            Some(File::open(&self.source).map_err(|error| Failure::usage(format!("{name}: {error}")))?)
        } else {
            None
        };
        let out = io::stdout();
        let no_color = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        let colour = out.is_terminal() && !no_color;
        let printer = Printer::new(BufWriter::new(out.lock()), &self, colour);
        let stopped = stopped()?;
        match file {
            Some(file) => log(&name, file, printer, &stopped),
            None => {
                let bus = open(&name, self.bus_kind, self.format).map_err(|error| {
                    Failure::usage(format!("there is no file {name}, and as a bus: {error}"))
                })?;
                live(&bus, printer, self.to, &stopped)
            }
        }
    }
}

/// A flag that SIGINT and SIGTERM set.
fn stopped() -> Result<Arc<AtomicBool>, Failure> {
    let stopped = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        signal_hook::flag::register(signal, Arc::clone(&stopped))
            .map_err(|error| Failure::run(format!("cannot catch signal {signal}: {error}")))?;
    }
    Ok(stopped)
}

/// Opens a bus to hear all of it; a classic interface too, unless FD is asked for.
fn open(name: &str, kind: Choice, format: Format) -> Result<Bus, BusError> {
    let options = |fd| Options { fd, error_mask: EXTENDED_MASK, ..Options::default() };
    match Bus::open(name, kind, &options(format != Format::Classic)) {
        Err(BusError::ClassicOnly { .. }) if format == Format::Auto => Bus::open(name, kind, &options(false)),
        opened => opened,
    }
}

/// Whether there is more to be shown.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum Flow {
    More,
    Enough,
}

/// Shows a log.
fn log(
    name: &str,
    file: File,
    mut printer: Printer<impl Write>,
    stopped: &AtomicBool,
) -> Result<(), Failure> {
    let mut lines = Lines::new(Interruptible { file, stopped });
    let (mut seen, mut frames, mut bad, mut xl) = (0_u64, 0_u64, 0_u64, 0_u64);
    let done = loop {
        if lines.is_drained()
            && let Err(error) = printer.out.flush()
        {
            break Err(error);
        }
        let next = lines.next_line().map_err(|error| Failure::run(format!("{name}: {error}")))?;
        let Some((number, line)) = next else { break Ok(()) };
        seen = number;
        let complaint = match line.map_err(|fault| fault.to_string()).map(|line| (line, candump::parse(line)))
        {
            Ok((line, Ok(Line::Frame(record)))) => {
                frames += 1;
                match printer.recorded(line, &record) {
                    Ok(Flow::More) => continue,
                    Ok(Flow::Enough) => break Ok(()),
                    Err(error) => break Err(error),
                }
            }
            Ok((_, Ok(Line::Other))) => continue,
            Ok((_, Ok(Line::CanXl))) => {
                xl += 1;
                continue;
            }
            Ok((_, Ok(Line::Dropped { frames }))) => {
                format!("{frames} frames are missing here: candump lost them")
            }
            Ok((_, Err(error))) => {
                bad += 1;
                error.to_string()
            }
            Err(fault) => {
                bad += 1;
                fault
            }
        };
        output::note(format_args!("{name}:{number}: {complaint}"));
    };
    written(done.and_then(|()| printer.out.flush()))?;
    if bad > 0 {
        output::note(format_args!("{name}: {bad} of {seen} lines could not be read"));
    }
    if xl > 0 {
        output::note(format_args!("{name}: CAN XL frames are not shown: {xl}"));
    }
    if frames == 0 && seen > 0 && !stopped.load(Ordering::Relaxed) {
        let like = "its lines are like `(1700000000.123456) vcan0 123#00`";
        return Err(Failure::run(format!(
            "{name}: there is no frame in {seen} lines; a candump log is read: {like}"
        )));
    }
    Ok(())
}

/// Shows a bus until somebody says stop, or it is closed.
fn live(
    bus: &Bus,
    mut printer: Printer<impl Write>,
    to: Option<u64>,
    stopped: &AtomicBool,
) -> Result<(), Failure> {
    output::note(format_args!("{} is {}", bus.name(), bus.kind()));
    let mut inbox = Inbox::new();
    let (mut down, mut end) = (false, None);
    let done = loop {
        if stopped.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end) {
            break Ok(());
        }
        match bus.wait(Some(LOOK)).and_then(|ready| if ready { bus.receive(&mut inbox) } else { Ok(0) }) {
            Ok(0) => continue,
            Ok(_) => down = false,
            Err(error) if error.may_pass() => {
                if !std::mem::replace(&mut down, true) {
                    output::note(format_args!("gateway: {error}; waiting"));
                }
                std::thread::sleep(LOOK);
                continue;
            }
            Err(error) => return Err(Failure::run(error)),
        }
        // When nothing more comes, the end comes all the same.
        end = end.or_else(|| Some(Instant::now() + Duration::from_nanos(to?)));
        let mut received = inbox.frames();
        let flow = received.try_fold(Flow::More, |flow, received| match flow {
            Flow::More => printer.received(bus.name(), received.at_nanos, &received.frame),
            Flow::Enough => Ok(Flow::Enough),
        });
        match flow.and_then(|flow| printer.out.flush().map(|()| flow)) {
            Ok(Flow::More) => {}
            Ok(Flow::Enough) => break Ok(()),
            Err(error) => break Err(error),
        }
    };
    if inbox.dropped() > 0 {
        let (name, dropped) = (bus.name(), inbox.dropped());
        output::note(format_args!(
            "{name}: {dropped} frames are missing: they came faster than they were shown"
        ));
    }
    written(done)
}

/// A file whose reader can be told to stop: then it is at its end.
struct Interruptible<'a> {
    file: File,
    stopped: &'a AtomicBool,
}

impl Read for Interruptible<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let timeout = Timespec::try_from(LOOK).ok();
        while !self.stopped.load(Ordering::Relaxed) {
            match poll(&mut [PollFd::new(&self.file, PollFlags::IN)], timeout.as_ref()) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return self.file.read(buffer),
                Err(errno) => return Err(errno.into()),
            }
        }
        Ok(0)
    }
}

/// Colours of a terminal.
const DIM: &str = "\x1b[2m";
const RED: &str = "\x1b[31m";
const YELLOW: &str = "\x1b[33m";
const PLAIN: &str = "\x1b[0m";

/// Decodes, picks and prints frames.
struct Printer<W> {
    out: W,
    decoder: Decoder,
    pick: Pick,
    colour: bool,
    /// Lines that may still be shown.
    left: u64,
    /// When the first frame came.
    first: Option<u64>,
    raw: String,
}

impl<W: Write> Printer<W> {
    fn new(out: W, dump: &Dump, colour: bool) -> Self {
        let format = match dump.format {
            Format::Auto => None,
            Format::Fd => Some(can::Format::Fd),
            Format::Classic => Some(can::Format::Classic),
        };
        let pick = Pick { kinds: dump.kind.clone(), nodes: dump.node.clone(), from: dump.from, to: dump.to };
        let left = dump.max.unwrap_or(u64::MAX);
        Self { out, decoder: Decoder::new(format), pick, colour, left, first: None, raw: String::new() }
    }

    /// Shows a frame of a log, its time as it stands there.
    fn recorded(&mut self, line: &str, record: &Record<'_>) -> io::Result<Flow> {
        self.raw.clear();
        let time = line.split_inclusive(')').next().unwrap_or_default();
        let way = match record.direction {
            None => "",
            Some(Direction::Sent) => " T",
            Some(Direction::Received) => " R",
        };
        // A string takes everything.
        let _ = write!(self.raw, "{time} {} {}{way}", record.interface, record.frame);
        self.show(record.interface, record.time.nanos, &record.frame)
    }

    /// Shows a frame that has just come.
    fn received(&mut self, interface: &str, at_nanos: u64, frame: &Frame) -> io::Result<Flow> {
        self.raw.clear();
        let time = Timestamp { nanos: at_nanos, nine_digits: false };
        let record = Record { time, interface, frame: *frame, direction: None };
        let _ = write!(self.raw, "{record}");
        self.show(interface, at_nanos, frame)
    }

    fn show(&mut self, bus: &str, nanos: u64, frame: &Frame) -> io::Result<Flow> {
        if self.left == 0 {
            return Ok(Flow::Enough);
        }
        let first = *self.first.get_or_insert(nanos);
        let decoded = self.decoder.decode(Micros(nanos / 1_000), bus, frame);
        if !self.pick.takes(first, nanos, frame) {
            return Ok(Flow::More);
        }
        let raw = &self.raw;
        if self.colour {
            let colour = match decoded {
                Decoded::Foreign(_) | Decoded::Half { .. } => DIM,
                Decoded::Refused { .. } | Decoded::Meaningless { .. } => RED,
                Decoded::Message(_) if decoded.is_saturated() => YELLOW,
                Decoded::Message(_) => PLAIN,
            };
            writeln!(self.out, "{DIM}{raw}{PLAIN}\t{colour}{decoded}{PLAIN}")?;
        } else {
            writeln!(self.out, "{raw}\t{decoded}")?;
        }
        self.left -= 1;
        Ok(if self.left == 0 { Flow::Enough } else { Flow::More })
    }
}
