//! `skinbus dump`.

mod show;
mod table;

use std::io::{self, BufWriter, Write};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use analysis::stats::StatsReport;
use bench::bus::listen::now;
use clap::Args;
use model::decode::pick::{FrameFilter, FrameSelector, IdMask, NodeSelector};
use protocol::bus::BusOptions;
use protocol::can::Format;
use protocol::candump::{Record, Timestamp};
use protocol::skin::Skin;
use protocol::stop::{self, InterruptibleWriter};
use protocol::usage::{Failure, ignore_broken_pipe, print_text};
use serde::Serialize;
use trace::capture::{CaptureEntry, NoteKind, Reader, RecordingExtras, Topic};

use self::show::{FrameOutput, OutputStyle};
use super::arguments::{BusKinds, OptionValue, one_of_values, parse_time_ns};
use super::input::{
    self, BusReceiver, LossCounts, POLL_TIMEOUT, is_file, is_path, location, no_frame_failure,
    note_skin_difference, open_capture, skin_found_so_far, stop_flag,
};
use super::output;
use super::print::{comma_separated, to_pretty_json};

/// Show the traffic of a bus or a capture, decoded beside the raw frames
///
/// Prints one line per frame: the frame as `candump -L` prints it, a tab, a verdict, and the decoded frame. Verdicts:
/// ok; segment, a frame of a packet on a classic bus before the last; foreign, not a packet of this protocol; length,
/// CRC or incomplete, a damaged packet under an identifier that carries packets; meaning, a packet of unknown meaning.
/// So `cut -f1` gives a candump log. A capture is a candump log or an MCAP recording; unreadable lines are reported on
/// standard error, and the rest is shown. With --json each line is an object whose keys end in their unit; with
/// --stats, tables at the end replace the lines.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus dump vcan0 --kind torque --cell 12
  skinbus dump vcan0 vcan1 --id 200:600 -n 3
  skinbus dump run.mcap --bus vcan1 --cell 5
  skinbus dump run.log --kind joints,sync --from 2 --to 2.5
  skinbus dump run.mcap --contact --json | jq -c 'select(.kind == \"torque\") | [.node, .epoch, .values.torque_nm]'
  skinbus dump run.mcap run-*.mcap --stats
  skinbus dump can0 --stats --to 10
  candump -L can0 | skinbus dump - -n 100")]
pub(crate) struct DumpCommand {
    /// Names of buses to listen to; or candump logs or MCAP recordings; - for standard input. A name means a file if one
    /// exists. The parts of a split recording are read as one, in any order
    #[arg(required = true, value_name = "BUS|FILE")]
    sources: Vec<PathBuf>,
    /// Show only frames of these kinds: command, sum, torque, sensors, network, configure, configured, stimulus, wire
    /// (simulated wires), foreign (of other protocols, or damaged), damaged; or of one command: halt, joints, sync,
    /// resume, report
    #[arg(long, value_name = "KIND", value_delimiter = ',')]
    kind: Vec<FrameSelector>,
    /// Show only packets from or to these nodes: a node id, BUS:NODE, gateway or everyone
    #[arg(long, value_name = "[BUS:]NODE", value_delimiter = ',')]
    cell: Vec<NodeSelector>,
    /// Show only frames of these buses
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    bus: Vec<String>,
    /// Show only frames with this identifier, in hexadecimal: 3 digits for 11 bits, 8 digits for 29. A second number
    /// is the mask of the bits to compare
    #[arg(long, value_name = "ID[:MASK]", value_delimiter = ',')]
    id: Vec<IdMask>,
    /// Show only frames that belong to touches: torques and sums that are not zero, stimuli and reported sensor values
    /// with a force or a proximity, heartbeats of cells in contact
    #[arg(long)]
    contact: bool,
    /// Show frames from this time on: seconds since the start of the run, or since the first frame of a log
    #[arg(long, value_name = "S", value_parser = parse_time_ns, allow_negative_numbers = true)]
    from: Option<u64>,
    /// Show frames before this time, in seconds as for --from; a live dump ends there
    #[arg(long, value_name = "S", value_parser = parse_time_ns, allow_negative_numbers = true)]
    to: Option<u64>,
    /// End after showing or counting this many frames
    #[arg(long, short = 'n', value_name = "COUNT")]
    count: Option<u64>,
    /// Print the bus and the time, in seconds since the start of the run or since the first frame of a log, instead of
    /// the raw frame
    #[arg(long, conflicts_with_all = ["json", "stats"])]
    brief: bool,
    /// Print one JSON object per line; with --stats, one in total
    #[arg(long, short)]
    json: bool,
    /// Print tables at the end instead of lines: frames and rates by kind, gaps, losses, damaged frames, a line for
    /// each cell and for each foreign identifier
    ///
    /// Counts a live bus until --to, --count or Ctrl-C. Other filters would hide frames, and so falsify losses and
    /// unanswered joints messages: only --bus, --from, --to and --count are allowed.
    #[arg(long, conflicts_with_all = ["kind", "cell", "id", "contact"])]
    stats: bool,
    /// Frame format of the packets: FD, classic, or auto for both
    #[arg(long, value_parser = one_of_values(ANY_FORMAT), default_value = "auto")]
    format: PacketFormat,
    /// Skin file that gives the units of torques and positions [default: the skin in the recording]
    ///
    /// Without a skin, torques are decoded as Q3.12, and joints as revolute.
    #[arg(long, value_name = "SKIN", conflicts_with = "stats")]
    skin: Option<PathBuf>,
    /// If a bus does not exist yet, wait for it instead of failing
    #[arg(long)]
    wait: bool,
    #[command(flatten)]
    kinds: BusKinds,
}

/// Frame format of packets, or `None` if unknown in advance.
type PacketFormat = Option<Format>;

const ANY_FORMAT: &[OptionValue<PacketFormat>] = &[
    ("auto", "Accept packets in both formats", None),
    ("fd", "Each packet is one CAN FD frame", Some(Format::Fd)),
    ("classic", "Each packet is two to four classic frames", Some(Format::Classic)),
];

impl DumpCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let is_capture = self.is_capture()?;
        self.check_no_skin()?;
        let mut title = comma_separated(self.sources.iter().map(|source| source.display()));
        let out = io::stdout();
        let colour = output::is_coloured(&out);
        let how = match (self.stats, self.json, self.brief) {
            (true, _, _) => OutputStyle::Stats(Box::default()),
            (false, true, _) => OutputStyle::Json,
            (false, false, true) => OutputStyle::Brief { colour },
            (false, false, false) => OutputStyle::Lines { colour },
        };
        let pick = FrameFilter {
            kinds: self.kind.clone(),
            parties: self.cell.clone(),
            buses: self.bus.clone(),
            ids: self.id.clone(),
            from: self.from,
            to: self.to,
        };
        pick.check_consistency().map_err(Failure::usage_error)?;
        if !is_capture {
            let names: Vec<_> = self.sources.iter().map(|source| source.display().to_string()).collect();
            if let Some(other) = pick.bus_names().find(|bus| !names.iter().any(|name| name == bus)) {
                let names = comma_separated(&names);
                return Err(Failure::usage_error(format!(
                    "bus {other} is not one of the buses to dump ({names}): name it too"
                )));
            }
            if let Some(file) = self.sources.iter().find(|source| self.wait && is_path(source)) {
                let file = file.display();
                return Err(Failure::usage_error(format!(
                    "--wait is only for buses, and the file {file} does not exist"
                )));
            }
        } else if self.wait {
            return Err(Failure::usage_error(format!(
                "--wait is only for buses, but {title} is a file: leave it out"
            )));
        }
        let max = self.count.unwrap_or(u64::MAX);
        let to_out = BufWriter::new(InterruptibleWriter::new(&out));
        let mut show = FrameOutput::new(to_out, self.format, pick, self.contact, how, max);
        if let Some(path) = &self.skin {
            let skin = Skin::read(path).map_err(Failure::usage_error)?;
            note_skin_difference(&self.sources, path, &skin);
            show.set_units(&skin);
        }
        let (what, extras, done) = if is_capture {
            let mut reader = open_capture(&self.sources, |file| Box::new(file))?;
            reader.name().clone_into(&mut title);
            if self.skin.is_none() && !self.stats {
                let instead = "torques are decoded as Q3.12 and joints as revolute, because the skin is \
                               unknown: name it with --skin";
                if let Some(skin) = skin_found_so_far(&reader, instead) {
                    show.set_units(&skin);
                }
            }
            reader.extras().run_began().into_iter().for_each(|zero| show.set_zero_time(zero));
            let done = show_capture(&mut reader, &mut show);
            (input::format_name(&reader), Some(reader.extras().clone()), done)
        } else {
            // Signals must be caught before the dump reports that it listens.
            let stopped = stop_flag()?;
            let kinds = self.kinds.kinds_of_any_buses()?;
            let until = self.wait.then_some(&*stopped);
            let mut receive_ends =
                input::open_bus_receivers(&self.sources, &kinds, self.format, &BusOptions::default(), until)?;
            ("live", None, show_live(&mut receive_ends, &mut show, self.to, &stopped))
        };
        ignore_broken_pipe(show.finish().and_then(|()| show.flush()))?;
        if let (Ok(End::OfInput), Some(absent)) = (&done, show.absent_text()) {
            output::print_note(if is_capture {
                format!("{title} contains no frame {absent}")
            } else {
                format!("no frame {absent} came")
            });
        }
        let report = show.report();
        drop(show);
        if let Some(report) = report {
            // Show the counts even if the dump ended with an error.
            print_text(&match self.json {
                true => statistics_json(&title, what, &report, extras.as_ref())?,
                false => table::report_text(&title, what, &report, extras.as_ref()),
            })?;
        }
        done.map(|_| ())
    }

    /// Refuses a skin, whose buses may have been meant.
    fn check_no_skin(&self) -> Result<(), Failure> {
        let is_toml = |path: &&PathBuf| is_file(path) && path.extension().is_some_and(|end| end == "toml");
        let Some((file, skin)) =
            self.sources.iter().find(is_toml).and_then(|it| Some((it, Skin::read(it).ok()?)))
        else {
            return Ok(());
        };
        let (file, buses) =
            (file.display(), skin.buses.iter().map(|bus| bus.name.as_str()).collect::<Vec<_>>());
        Err(Failure::usage_error(format!(
            "{file} is a skin, which contains no frames; to follow its buses, run `skinbus dump {} --skin {file}`",
            buses.join(" ")
        )))
    }

    /// Returns true if the sources are a capture, false if they are buses.
    fn is_capture(&self) -> Result<bool, Failure> {
        let sources = &self.sources;
        let other = sources.iter().find(|source| !is_file(source));
        if let (Some(bus), Some(file)) = (other, sources.iter().find(|source| is_file(source))) {
            let (bus, file) = (bus.display(), file.display());
            return Err(Failure::usage_error(format!(
                "{file} is a file, but {bus} is not: name only the parts of one recording, or only buses"
            )));
        }
        if let Some(folder) = sources.iter().find(|source| source.is_dir()) {
            let folder = folder.display();
            return Err(Failure::usage_error(format!(
                "{folder} is a directory: name a candump log or buses"
            )));
        }
        Ok(other.is_none())
    }
}

fn statistics_json(
    source: &str,
    format: &str,
    report: &StatsReport,
    extras: Option<&RecordingExtras>,
) -> Result<String, Failure> {
    #[derive(Serialize)]
    struct DumpStatistics<'a> {
        source: &'a str,
        format: &'a str,
        #[serde(flatten)]
        report: &'a StatsReport,
        other_topics: &'a [Topic],
        attachments: Vec<&'a str>,
    }
    let other_topics = extras.map_or(&[][..], |extras| &extras.topics);
    let attachments = extras.iter().flat_map(|extras| &extras.attachments).map(|(name, _)| name.as_str());
    let whole = DumpStatistics { source, format, report, other_topics, attachments: attachments.collect() };
    to_pretty_json(&whole)
}

/// Reason why a dump ended without an error.
#[derive(Clone, Copy, Debug, Eq, PartialEq)]
enum End {
    /// The capture was read whole; or a live dump ended as requested.
    OfInput,
    /// The reader of the output has closed it; or the reading of a capture was interrupted.
    Early,
}

impl End {
    /// Returns how a dump ended whose output may have been closed.
    fn of_output(done: io::Result<()>) -> Result<Self, Failure> {
        let end = if done.is_ok() { Self::OfInput } else { Self::Early };
        ignore_broken_pipe(done).map(|()| end)
    }
}

/// Shows the frames of a capture.
fn show_capture(reader: &mut Reader, show: &mut FrameOutput<impl Write>) -> Result<End, Failure> {
    let name = reader.name().to_owned();
    let (mut frames, mut missing) = (0_u64, LossCounts::default());
    let done = loop {
        if reader.is_drained()
            && let Err(error) = show.flush()
        {
            break Err(error);
        }
        match reader.next().map_err(Failure::run_error)? {
            None => break Ok(()),
            Some(CaptureEntry::Frame(record)) => {
                frames += 1;
                if let Err(error) = show.add_frame(&record) {
                    break Err(error);
                }
                if show.is_limit_reached() {
                    break Ok(());
                }
            }
            Some(CaptureEntry::Note(note)) => {
                missing.count(&note);
                let place = location(&name, note.line);
                match note.kind {
                    NoteKind::Text | NoteKind::CanXl => {}
                    NoteKind::Dropped(lost) => {
                        show.count_dropped(note.interface, lost);
                        output::print_note(format_args!(
                            "{place}: {lost} frames are missing here, because the recorder lost them"
                        ));
                    }
                    NoteKind::Unreadable(why) => output::print_note(format_args!("{place}: {why}")),
                }
            }
        }
    };
    let end = End::of_output(done)?;
    if !reader.has_times() {
        show.disable_rates();
    }
    // Missing frames have been reported at their places, so they are not reported again at the end.
    missing.frames = 0;
    missing.print_counts(reader, "not shown");
    let is_interrupted = stop::stop_flag().load(Ordering::Relaxed);
    if frames == 0 && !is_interrupted {
        return Err(no_frame_failure(reader));
    }
    Ok(if is_interrupted { End::Early } else { end })
}

/// Interval between checks whether frames that wait for the rest of their packet have timed out.
const PACKET_TIMEOUT_CHECK_INTERVAL: Duration = Duration::from_millis(20);

/// Shows buses until a signal, or until one is closed.
fn show_live(
    receive_ends: &mut [BusReceiver],
    show: &mut FrameOutput<impl Write>,
    to: Option<u64>,
    stopped: &AtomicBool,
) -> Result<End, Failure> {
    // A bus on which nothing is sent ends too.
    let time_limit = |from: Instant| to.map(|to| from + Duration::from_nanos(to));
    let (mut end, mut has_begun) = (time_limit(Instant::now()), false);
    let done = loop {
        if stopped.load(Ordering::Relaxed) || end.is_some_and(|end| Instant::now() >= end) {
            break Ok(End::OfInput);
        }
        match show_received(receive_ends, show) {
            // Report the frames that were lost until then before returning the error.
            Err(failure) => break Err(failure),
            // If the reader of the output has read enough, end the dump without an error.
            Ok(Err(error)) => break End::of_output(Err(error)),
            // Times count from the first frame.
            Ok(Ok(true)) if !has_begun => (end, has_begun) = (time_limit(Instant::now()), true),
            Ok(Ok(_)) => {}
        }
        if show.is_limit_reached() {
            break Ok(End::OfInput);
        }
    };
    for receive_end in receive_ends {
        match receive_end.report_missing_frames("shown") {
            0 => {}
            missing => show.count_dropped(receive_end.bus().name(), missing),
        }
    }
    done
}

/// Waits for frames and shows them. Returns true if any arrived, or the error of the output.
fn show_received(
    receive_ends: &mut [BusReceiver],
    show: &mut FrameOutput<impl Write>,
) -> Result<io::Result<bool>, Failure> {
    let wait = if show.is_waiting() { PACKET_TIMEOUT_CHECK_INTERVAL } else { POLL_TIMEOUT };
    // With a single bus, the receiving call waits too, which takes one system call instead of two.
    let is_alone = receive_ends.len() == 1;
    if !is_alone {
        input::wait(receive_ends, wait)?;
    }
    let mut any = false;
    for receive_end in receive_ends {
        if !receive_end.receive(if is_alone { wait } else { Duration::ZERO }).map_err(Failure::run_error)? {
            continue;
        }
        any = true;
        let shown = receive_end.frames().try_for_each(|received| {
            if show.is_limit_reached() {
                return Ok(());
            }
            let time = Timestamp::with_six_digits(received.at_nanos);
            let interface = receive_end.bus().name();
            show.add_frame(&Record { time, interface, frame: received.frame, direction: None })
        });
        if let Err(error) = shown {
            return Ok(Err(error));
        }
    }
    let settled = if any { Ok(()) } else { show.handle_time(now()) };
    Ok(settled.and_then(|()| show.flush()).map(|()| any))
}
