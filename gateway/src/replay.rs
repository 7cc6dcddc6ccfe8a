//! `skinbus replay`.

use std::path::PathBuf;
use std::time::Duration;

use bench::replay::comparator::StepHistogram;
use bench::replay::player::ReplaySpeed;
use bench::replay::replay_plan::{SenderFilter, reason};
use bench::replay::report::{ReplyComparison, Summary};
use bench::replay::survey::TimeRange;
use bench::replay::{ReplayError, ReplayOptions, SpawnOptions, replay};
use clap::Args;
use protocol::usage::{Failure, printable, printable_lines};

use super::arguments::{
    BusKinds, BusTimeOption, OptionValue, cells_per_process, environment_number, one_of_values, parse_time_ns,
};
use super::output::{self, OverwriteOption, check_distinct_files, print_table};
use super::print::{
    GREEN, KeyValueTable, RESET_COLOUR, YELLOW, comma_separated, format_quantiles, hanging_indent,
    or_else_text, to_pretty_json,
};

/// Receive buffer in bytes: all cells may answer a report at once.
const RECEIVE_BUFFER_BYTES: u32 = 8 << 20;

/// Time before a frame is due during which the sender spins instead of sleeping.
const SPIN_TIME: Duration = Duration::from_micros(100);

/// Time in ms to wait for room on a full bus before a frame is refused.
const SEND_TIMEOUT_MS: u32 = 100;

/// Send a capture on a bus, and compare the answers of the cells with the recorded ones
///
/// Sends frames at the capture's own times, or as fast as the bus accepts them. With --only inputs, the cells on the
/// bus answer; with --expect, their answers must equal the recorded ones, bit for bit or within a tolerance.
/// docs/how-to/replay.md explains the comparison. Exit code 0: everything was sent, and all answers were right; 1:
/// otherwise; 2: wrong use.
#[derive(Args, Debug)]
#[command(mut_args(|arg| match arg.get_id().as_str() {
    "cells_per_process" => arg.requires("spawn"),
    _ => arg,
}))]
#[command(after_help = "Examples:
  skinbus replay run.log --only inputs --speed 0.5
  skinbus replay run.mcap --expect --spawn --lockstep
  skinbus replay run.mcap run-*.mcap --expect --spawn --lockstep
  skinbus replay foreign.log --map can0=vcan0 --speed max --loop 10")]
pub(crate) struct ReplayCommand {
    /// Candump log or MCAP recording to send; the parts of a split recording are read as one, in any order
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    #[command(flatten)]
    kinds: BusKinds,
    #[command(flatten)]
    time: BusTimeOption,
    #[command(flatten)]
    frames: FrameOptions,
    /// Send everything N times; 0 repeats until Ctrl-C
    #[arg(long = "loop", value_name = "N", default_value_t = 1)]
    passes: u32,
    /// Speed relative to the recorded times, 0.1 to 100; or max, to send as fast as the bus accepts frames
    #[arg(long, value_name = "X", default_value = "1", value_parser = speed, allow_negative_numbers = true)]
    speed: ReplaySpeed,
    /// Send each joints message only after every cell has answered the one before, so that the result does not depend
    /// on the machine
    #[arg(long)]
    lockstep: bool,
    /// Compare the cells' answers with the recorded ones; with --speed max this implies --lockstep
    #[arg(long)]
    expect: bool,
    /// Accept torques that differ by up to this many steps (in Q3.12: 1/4096 Nm), and count them
    #[arg(long, value_name = "STEPS", default_value_t = 0, requires = "expect")]
    tolerance: u16,
    /// Start the cells as processes, and end them afterwards
    #[arg(long)]
    spawn: bool,
    /// Skin file of the started cells [default: the skin in the recording]
    #[arg(long, value_name = "SKIN")]
    skin: Option<PathBuf>,
    /// Switch cells that use their own sensors to test mode, so that they use the recorded stimuli instead
    #[arg(long)]
    test_mode: bool,
    /// Write the results as JSON, - for standard output; docs/how-to/replay.md explains the keys
    #[arg(long, value_name = "FILE")]
    summary: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
    #[command(flatten)]
    shown: OutputOptions,
}

/// Output options of a replay.
#[derive(Args, Debug)]
struct OutputOptions {
    /// Show only the table at the end, without progress
    #[arg(long, short)]
    quiet: bool,
}

/// Options for the selection and the destination of frames.
#[derive(Args, Debug)]
struct FrameOptions {
    /// Send the frames of the recorded bus FROM on the bus TO
    #[arg(long, value_name = "FROM=TO", value_parser = parse_route)]
    map: Vec<(String, String)>,
    /// Send only frames of these recorded buses
    #[arg(long, value_name = "NAME", value_delimiter = ',')]
    bus: Vec<String>,
    /// Send only these frames: inputs are commands, configuration and stimuli. Default: inputs with --expect,
    /// --lockstep or --spawn, else all
    #[arg(long, value_parser = one_of_values(SENDER_FILTERS))]
    only: Option<SenderFilter>,
    /// Begin at this time: seconds since the start of the run, or since the first frame of a log. If only inputs are
    /// sent, the cells are first set to the state that they had at this time
    #[arg(long, value_name = "S", value_parser = parse_time_ns, allow_negative_numbers = true)]
    from: Option<u64>,
    /// End before this time, in seconds as for --from
    #[arg(long, value_name = "S", value_parser = parse_time_ns, allow_negative_numbers = true)]
    to: Option<u64>,
}

const SENDER_FILTERS: &[OptionValue<SenderFilter>] = &[
    ("inputs", "Commands, configuration and stimuli", SenderFilter::Inputs),
    ("replies", "Frames from cells", SenderFilter::Replies),
    ("all", "Everything", SenderFilter::All),
];

fn parse_route(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((from, to)) if !from.is_empty() && !to.is_empty() => Ok((from.to_owned(), to.to_owned())),
        _ => Err("use a recorded bus and the bus to send its frames on, such as vcan0=vcan1".to_owned()),
    }
}

fn speed(text: &str) -> Result<ReplaySpeed, String> {
    match text.parse::<f64>() {
        _ if text == "max" => Ok(ReplaySpeed::Max),
        Ok(speed) if (0.1..=100.0).contains(&speed) => Ok(ReplaySpeed::Timed(speed)),
        _ => Err("use a number from 0.1 to 100, or max".to_owned()),
    }
}

impl ReplayCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let options = self.options()?;
        let read = self.files.iter().chain(&self.skin).map(PathBuf::as_path);
        check_distinct_files([("--summary", self.summary.as_deref())], read)?;
        // Create the file before the replay, so that an error of the file is reported first.
        let file = self.summary.as_ref().map(|path| self.overwrite.create("--summary", path)).transpose()?;
        let failure = |error: ReplayError| Failure::with_code(error.exit_code(), error);
        let summary = replay(&options).map_err(failure)?;
        let json = to_pretty_json(&summary)?;
        let write = |(whole, file)| output::write_and_finish("--summary", whole, file, &json);
        let written = file.map_or(Ok(()), write);
        let files = [self.summary.as_deref()];
        print_table(files, |is_coloured| table(&summary, is_coloured)).and(written)?;
        summary.failure_reason(self.shown.quiet).map_or(Ok(()), |why| Err(Failure::run_error(why)))
    }

    fn options(&self) -> Result<ReplayOptions, Failure> {
        let answered = [("--expect", self.expect), ("--lockstep", self.lockstep), ("--spawn", self.spawn)];
        let needs = answered.into_iter().find_map(|(name, given)| given.then_some(name));
        if let Some(skin) = self.skin.as_ref().filter(|_| !self.spawn) {
            let skin = skin.display();
            return Err(Failure::usage_error(format!(
                "--skin {skin} is for the cells that --spawn starts: add --spawn"
            )));
        }
        let only = match (self.frames.only, needs) {
            (Some(SenderFilter::Replies | SenderFilter::All), Some(name)) => {
                return Err(Failure::usage_error(format!(
                    "{name} makes cells answer, but --only would send recorded answers too: leave out one of the \
                     two options"
                )));
            }
            (None, Some(_)) => SenderFilter::Inputs,
            (only, _) => only.unwrap_or(SenderFilter::All),
        };
        if let (Some(from), Some(to)) = (self.frames.from, self.frames.to)
            && from >= to
        {
            let [from, to] = [from, to].map(|nanos| Duration::from_nanos(nanos).as_secs_f64());
            return Err(Failure::usage_error(format!("--from {from} must be before --to {to}")));
        }
        let timeout_ms = environment_number("SKINBUS_SEND_TIMEOUT_MS", 1..=60_000)?;
        Ok(ReplayOptions {
            files: self.files.clone(),
            kinds: self.kinds.kinds_of_any_buses()?,
            bus_time: self.time.choice(),
            only,
            buses: self.frames.bus.clone(),
            map: self.frames.map.clone(),
            part: TimeRange { from: self.frames.from, to: self.frames.to },
            passes: (self.passes > 0).then_some(self.passes),
            pace: self.speed,
            spin: SPIN_TIME,
            lockstep: self.lockstep || (self.expect && matches!(self.speed, ReplaySpeed::Max)),
            expect: self.expect.then_some(self.tolerance),
            spawn: self
                .spawn
                .then_some(SpawnOptions { skin: self.skin.clone(), cells_per_process: cells_per_process()? }),
            test_mode: self.test_mode,
            timeout: Duration::from_millis(timeout_ms.unwrap_or(SEND_TIMEOUT_MS).into()),
            receive_buffer: RECEIVE_BUFFER_BYTES as usize,
            quiet: self.shown.quiet,
        })
    }
}

/// Formats the result of the replay: one line and a table.
fn table(summary: &Summary, is_coloured: bool) -> String {
    let ended = match (&summary.failure, summary.interrupted) {
        (Some(_), _) => "failed",
        (None, true) => "interrupted",
        (None, false) => "done",
    };
    let mut rows = KeyValueTable::new(&summary.file, format!("{:.1} s, {ended}", summary.duration_s), "");
    let (is_well, first) = summary.result_line();
    let first_line = hanging_indent("", &printable(&first), rows.width_in_columns());
    let first_line = match is_coloured {
        true if is_well => format!("{GREEN}{first_line}{RESET_COLOUR}\n"),
        true => format!("{YELLOW}{first_line}{RESET_COLOUR}\n"),
        false => format!("{first_line}\n"),
    };
    rows.add_section("frames", "", "");
    rows.add_row("sent", summary.sent, "");
    rows.add_row_unless_zero("refused", summary.refused, "the queue of a bus stayed full");
    rows.add_row_unless_zero("lost", summary.lost, "a bus was down");
    for (reason, count) in &summary.skipped {
        rows.add_row("not sent", count, skip_reason_words(reason));
    }
    rows.add_row_unless_zero("sent without delay", summary.sent_at_once, "their time stamps go backwards");
    if let (Some(late), Some(idle)) = (&summary.late_us, &summary.idle_late_us) {
        rows.add_section("lateness", "50 % / 90 % / 99 % / max, µs", "");
        rows.add_row(
            "frames sent",
            format_quantiles(late),
            format!("before the replay: {}", format_quantiles(idle)),
        );
    }
    if summary.buses.len() > 1 || summary.buses.iter().any(|bus| bus.capture != bus.name) {
        for bus in &summary.buses {
            let from = if bus.capture == bus.name { String::new() } else { format!("from {}", bus.capture) };
            rows.add_section(
                format!("{} ({})", bus.name, bus.kind),
                format!("{} sent", bus.frames.sent),
                from,
            );
        }
    }
    if let Some(lockstep) = &summary.lockstep {
        let silent = comma_separated(&lockstep.silent_cells);
        let silent = if silent.is_empty() { "all answered".to_owned() } else { format!("silent: {silent}") };
        rows.add_section("lockstep", silent, format!("{} joints messages retried", lockstep.retried));
    }
    if let Some(expect) = &summary.expect {
        comparison_rows(&mut rows, expect);
    }
    let first = summary.expect.as_ref().and_then(|expect| expect.first.as_ref());
    first_line
        + &rows.to_text()
        + &or_else_text(first.map(|first| format!("{}\n", printable_lines(&first.text))), "")
}

/// Words for a reason of not sending frames; the summary has the reason itself.
fn skip_reason_words(reason: &'static str) -> &'static str {
    match reason {
        reason::BEFORE_PART => "recorded before --from",
        reason::AFTER_PART => "recorded at --to or later",
        reason::BUS_NOT_SELECTED => "of buses that are not replayed",
        reason::NO_INPUT => "from cells or other programs",
        reason::NO_REPLY => "not from cells",
        reason::ERROR_FRAME => "error frames",
        reason::SIMULATED_WIRE => "of simulated wires",
        reason::BUS_ADDED_LATER => "of buses that were added to the capture later",
        reason::NOTE_BETWEEN_FRAMES => "notes, not frames",
        other => other,
    }
}

fn comparison_rows(rows: &mut KeyValueTable, expect: &ReplyComparison) {
    let tally = &expect.tally;
    rows.add_section("replies", "compared with the recording", "");
    let within = format!("{} of them within the tolerance of {} steps", tally.tolerated, expect.tolerance);
    rows.add_row("equal", tally.equal, if tally.tolerated > 0 { &within } else { "bit for bit" });
    rows.add_row("different", tally.different, "");
    difference_rows(rows, "torque", &tally.torque_words, 0);
    difference_rows(rows, "sum", &tally.sum_words, 1);
    let late = match expect.joints_skipped {
        0 => String::new(),
        skipped => format!("cells skipped {skipped} late joints messages"),
    };
    rows.add_row("missing", tally.missing, late);
    rows.add_row("extra", tally.extra, "not in the recording");
    rows.add_row_unless_zero("not requested", tally.not_requested, "a bus refused the joints message");
    for (reason, count) in tally.lacking.reason_counts() {
        rows.add_row("not recorded", count, reason);
    }
    rows.add_row_unless_zero(
        "lost by the recorder",
        expect.recording_dropped,
        "inputs among them could not be sent",
    );
    rows.add_row_unless_zero(
        "unknown configurations",
        expect.unchecked_cells,
        "changed before the recording began",
    );
}

/// Adds rows on words that differ by more than `usual` steps, if there are any: the number of words for each
/// difference.
fn difference_rows(rows: &mut KeyValueTable, what: &str, steps: &StepHistogram, usual: usize) {
    let counts = steps.by_steps.iter().enumerate().skip(1);
    let found: Vec<_> = counts.filter(|(_, count)| **count > 0).collect();
    let Some((worst, _)) = found.last().filter(|(worst, _)| *worst > usual) else { return };
    let last = steps.by_steps.len() - 1;
    let of = format!("of {}, by at most {} steps", steps.by_steps.iter().sum::<u64>(), steps.max);
    for (by, count) in &found {
        let more = if *by == last { " or more" } else { "" };
        let beside = if by == worst { &of } else { "" };
        rows.add_row(format!("{what} words that differ by {by}{more}"), count, beside);
    }
}
