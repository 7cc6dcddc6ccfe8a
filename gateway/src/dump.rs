//! `gateway dump`.

mod show;
mod table;

use std::io::{self, BufWriter, IsTerminal, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant, SystemTime};

use analysis::stats::Report;
use clap::{Args, ValueEnum};
use model::decode::pick::{self, Pick, Wanted};
use protocol::bus::{Bus, BusError, Choice, Inbox, Options};
use protocol::can::{self, EXTENDED_MASK};
use protocol::candump::{Record, Timestamp};
use protocol::id::Node;
use protocol::stop::{self, Stoppable};
use protocol::time::Micros;
use protocol::usage::{Failure, print, written};
use serde::Serialize;
use trace::capture::{self, Entry, Extras, NoteKind, Reader};

use self::show::{Flow, How, Show};
use super::input::{LOOK, captures, stopped};
use super::output;

/// Show what is on a bus or in a capture, in words beside the raw frames
///
/// One line a frame: the frame as `candump -L` prints it, a tab, a verdict, and what the frame says. The verdict is
/// ok; half, the first frame of two on a classic bus; foreign, no packet of this protocol; length, CRC or incomplete,
/// damaged: no packet, under an identifier that carries packets; or meaning, a packet that says nothing known. So
/// `cut -f1` gives a candump log. A capture is a candump log or an MCAP recording; what cannot be read of it is named on
/// standard error, and the rest is shown. With --json each line is an object, and keys end in their unit; with
/// --stats there are tables at the end instead.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  gateway dump vcan0 --kind torque --node 12
  gateway dump run.log --kind joints,sync --from 2 --to 2.5
  gateway dump run.mcap --contact --json | jq -c 'select(.kind == \"torque\") | [.node, .epoch, .values.torque_nm]'
  gateway dump run.mcap run-*.mcap --stats
  gateway dump can0 --stats --to 10
  candump -L can0 | gateway dump - --max 100")]
pub(crate) struct Dump {
    /// A candump log or MCAP recording when there is a file of this name, - for standard input, else a bus; all parts
    /// of a split recording are one, in any order
    #[arg(required = true, value_name = "BUS|FILE")]
    sources: Vec<PathBuf>,
    /// Only these kinds: command, sum, torque, sensors, network, configure, configured, stimulus; also halt,
    /// joints, sync, resume, report alone, wire, foreign (also what is damaged), and damaged
    #[arg(long, value_name = "KIND", value_delimiter = ',')]
    kind: Vec<Wanted>,
    /// Only packets from or to these: a cell's number, gateway, everyone
    #[arg(long, value_name = "NODE", value_delimiter = ',', value_parser = pick::node)]
    node: Vec<Node>,
    /// Only what tells of a touch: torques and sums that are not all zero, stimuli and sensors with a contact force
    /// or a proximity, heartbeats of active cells
    #[arg(long)]
    contact: bool,
    /// Only from so many seconds after the first frame on
    #[arg(long, value_name = "S", value_parser = nanos, allow_negative_numbers = true)]
    from: Option<u64>,
    /// Only up to, and without, so many seconds after the first frame; ends a live dump
    #[arg(long, value_name = "S", value_parser = nanos, allow_negative_numbers = true)]
    to: Option<u64>,
    /// End after N frames that are shown or counted
    #[arg(long, value_name = "N")]
    max: Option<u64>,
    /// Without the raw frames: the time since the first frame, the bus, and what the frame says
    #[arg(long, conflicts_with_all = ["json", "stats"])]
    brief: bool,
    /// One JSON object a line; with --stats, one in all
    #[arg(long)]
    json: bool,
    /// At the end, instead of lines: frames and rates by kind, gaps, losses, damaged frames, a line for each cell and
    /// for each foreign identifier
    ///
    /// A live bus is counted until --to, --max or Ctrl-C. Frames that the filters leave out are not counted, and
    /// what needs them (what is missed, what is lost) would be wrong; so only --from, --to and --max go with it.
    #[arg(long, conflicts_with_all = ["kind", "node", "contact"])]
    stats: bool,
    /// End at the first line of a log that cannot be read
    #[arg(long)]
    strict: bool,
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
pub(super) fn nanos(text: &str) -> Result<u64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=1e9).contains(&seconds) => Ok((seconds * 1e9).round() as u64),
        _ => Err("a number of seconds from 0 to 1e9".to_owned()),
    }
}

impl Dump {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name =
            self.sources.iter().map(|source| source.display().to_string()).collect::<Vec<_>>().join(", ");
        let is_file = |source: &PathBuf| source.as_os_str() == "-" || source.exists();
        if let Some(bus) = self.sources.iter().find(|source| self.sources.len() > 1 && !is_file(source)) {
            return Err(Failure::usage(format!(
                "there is no file {}: several captures are the parts of one recording, and a bus is dumped alone",
                bus.display()
            )));
        }
        if let Some(folder) = self.sources.iter().find(|source| source.is_dir()) {
            let folder = folder.display();
            return Err(Failure::usage(format!("{folder} is a directory: name a candump log or a bus")));
        }
        let out = io::stdout();
        let no_color = std::env::var_os("NO_COLOR").is_some_and(|value| !value.is_empty());
        let colour = out.is_terminal() && !no_color;
        let how = match (self.stats, self.json, self.brief) {
            (true, _, _) => How::Stats(Box::default()),
            (false, true, _) => How::Json,
            (false, false, true) => How::Brief { colour },
            (false, false, false) => How::Lines { colour },
        };
        let format = match self.format {
            Format::Auto => None,
            Format::Fd => Some(can::Format::Fd),
            Format::Classic => Some(can::Format::Classic),
        };
        let Self { kind: kinds, node: nodes, from, to, contact, .. } = self;
        let pick = Pick { kinds, nodes, from, to };
        let max = self.max.unwrap_or(u64::MAX);
        let mut show = Show::new(BufWriter::new(Stoppable::new(&out)), format, pick, contact, how, max);
        let mut title = name.clone();
        let (what, extras, done) = match self.sources.iter().all(is_file) {
            true => {
                let mut reader = captures(&self.sources, |file| Box::new(file))?;
                reader.name().clone_into(&mut title);
                let done = captured(&mut reader, &mut show, stop::flag(), self.strict);
                let what = match reader.format() {
                    capture::Format::Candump => "candump log",
                    capture::Format::Mcap => "MCAP",
                };
                (what, Some(reader.extras().clone()), done)
            }
            false => {
                let bus = open(&name, self.bus_kind, self.format).map_err(|error| {
                    Failure::usage(format!("there is no file {name}, and as a bus: {error}"))
                })?;
                ("live", None, live(&bus, &mut show, to, &*stopped()?))
            }
        };
        written(show.finish().and_then(|_| show.flush()))?;
        let report = show.report();
        drop(show);
        if let Some(report) = report {
            // What was counted is shown whatever ended it.
            if self.json {
                print(&as_json(&title, what, &report, extras.as_ref())?)?;
            } else {
                print(&table::text(&title, what, &report, extras.as_ref()))?;
            }
        }
        done
    }
}

/// The numbers as JSON.
fn as_json(source: &str, format: &str, report: &Report, extras: Option<&Extras>) -> Result<String, Failure> {
    #[derive(Serialize)]
    struct Whole<'a> {
        source: &'a str,
        format: &'a str,
        #[serde(flatten)]
        report: &'a Report,
        other_topics: Vec<Topic<'a>>,
        attachments: Vec<&'a str>,
    }
    #[derive(Serialize)]
    struct Topic<'a> {
        topic: &'a str,
        schema: &'a str,
        messages: u64,
    }
    let topics = extras.iter().flat_map(|extras| &extras.topics);
    let other_topics =
        topics.map(|topic| Topic { topic: &topic.name, schema: &topic.schema, messages: topic.messages });
    let attachments = extras.iter().flat_map(|extras| &extras.attachments).map(|(name, _)| name.as_str());
    let (other_topics, attachments) = (other_topics.collect(), attachments.collect());
    let whole = Whole { source, format, report, other_topics, attachments };
    let text = serde_json::to_string_pretty(&whole).map_err(Failure::run)?;
    Ok(text + "\n")
}

/// Opens a bus to hear all of it; a classic interface too, unless FD is asked for.
fn open(name: &str, kind: Choice, format: Format) -> Result<Bus, BusError> {
    let options = |fd| Options { fd, error_mask: EXTENDED_MASK, ..Options::default() };
    match Bus::open(name, kind, &options(format != Format::Classic)) {
        Err(BusError::ClassicOnly { .. }) if format == Format::Auto => Bus::open(name, kind, &options(false)),
        opened => opened,
    }
}

/// Shows a capture.
fn captured(
    reader: &mut Reader,
    show: &mut Show<impl Write>,
    stopped: &AtomicBool,
    strict: bool,
) -> Result<(), Failure> {
    let name = reader.name().to_owned();
    let (mut frames, mut bad, mut xl) = (0_u64, 0_u64, 0_u64);
    let done = loop {
        if reader.is_drained()
            && let Err(error) = show.flush()
        {
            break Err(error);
        }
        let Some(entry) = reader.next().map_err(Failure::run)? else { break Ok(()) };
        let note = match entry {
            Entry::Frame(record) => {
                frames += 1;
                match show.frame(&record) {
                    Ok(Flow::More) => continue,
                    Ok(Flow::Enough) => break Ok(()),
                    Err(error) => break Err(error),
                }
            }
            Entry::Note(note) => note,
        };
        let complaint = match note.kind {
            NoteKind::Text => continue,
            NoteKind::CanXl => {
                xl += 1;
                continue;
            }
            NoteKind::Dropped(lost) => {
                show.dropped(note.interface, lost);
                format!("{lost} frames are missing here: candump lost them")
            }
            NoteKind::Unreadable(why) => {
                bad += 1;
                if strict {
                    return Err(Failure::run(format!("{name}:{}: {why}", note.line)));
                }
                why
            }
        };
        if note.line == 0 {
            output::note(format_args!("{name}: {complaint}"));
        } else {
            output::note(format_args!("{name}:{}: {complaint}", note.line));
        }
    };
    written(done)?;
    let seen = reader.lines();
    if bad > 0 {
        output::note(format_args!("{name}: {bad} of {seen} lines could not be read"));
    }
    if xl > 0 {
        output::note(format_args!("{name}: CAN XL frames are not shown: {xl}"));
    }
    if let Some(what) = &reader.extras().unfinished {
        output::note(format_args!("{name}: {what}"));
    }
    if frames == 0 && seen > 0 && !stopped.load(Ordering::Relaxed) {
        let like = "its lines are like `(1700000000.123456) vcan0 123#00`";
        return Err(Failure::run(format!(
            "{name}: there is no frame in {seen} lines; a candump log is read: {like}"
        )));
    }
    Ok(())
}

/// How often it is looked whether a classic frame waits in vain for its other half.
const SETTLE: Duration = Duration::from_millis(20);

/// The time, on the clock of received frames.
fn now() -> Micros {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Micros(u64::try_from(since.as_micros()).unwrap_or(u64::MAX))
}

/// Shows a bus until somebody says stop, or it is closed.
fn live(
    bus: &Bus,
    show: &mut Show<impl Write>,
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
        let patience = if show.is_waiting() { SETTLE } else { LOOK };
        match bus.wait(Some(patience)).and_then(|ready| if ready { bus.receive(&mut inbox) } else { Ok(0) }) {
            Ok(0) => match show.handle_time(now()).and_then(|flow| show.flush().map(|()| flow)) {
                Ok(Flow::More) => continue,
                Ok(Flow::Enough) => break Ok(()),
                Err(error) => break written(Err(error)),
            },
            Ok(_) => down = false,
            Err(error) if error.may_pass() => {
                if !std::mem::replace(&mut down, true) {
                    output::note(format_args!("gateway: {error}; waiting"));
                }
                std::thread::sleep(LOOK);
                continue;
            }
            // What was missed until then is said all the same.
            Err(error) => break Err(Failure::run(error)),
        }
        // When nothing more comes, the end comes all the same.
        end = end.or_else(|| Some(Instant::now() + Duration::from_nanos(to?)));
        let mut received = inbox.frames();
        let flow = received.try_fold(Flow::More, |flow, received| match flow {
            Flow::More => {
                let time = Timestamp { nanos: received.at_nanos, nine_digits: false };
                show.frame(&Record { time, interface: bus.name(), frame: received.frame, direction: None })
            }
            Flow::Enough => Ok(Flow::Enough),
        });
        match flow.and_then(|flow| show.flush().map(|()| flow)) {
            Ok(Flow::More) => {}
            Ok(Flow::Enough) => break Ok(()),
            Err(error) => break written(Err(error)),
        }
    };
    if inbox.dropped() > 0 {
        let (name, dropped) = (bus.name(), inbox.dropped());
        show.dropped(name, dropped.into());
        output::note(format_args!(
            "{name}: {dropped} frames are missing: they came faster than they were shown"
        ));
    }
    done
}
