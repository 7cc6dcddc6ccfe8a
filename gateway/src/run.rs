//! `skinbus run` and `skinbus demo`.

mod controlled;
mod show;

use std::net::SocketAddr;
use std::panic::{self, AssertUnwindSafe};
use std::path::{Path, PathBuf};
use std::time::Duration;

use analysis::fit::verdict::FitSummary;
use analysis::fit::{assess_worst_case, last_reply_bound_us};
use bench::bus::time::BusTimeChoice;
use bench::emulate::EmulatedCells;
use bench::processes::create_memory_file;
use bench::record::{self, CandumpOutput};
use bench::remote::Remote;
use bench::run::{self, RunOptions};
use bench::summary::Summary;
use clap::Args;
use model::scenario::{DEFAULT_DURATION, Scenario};
use protocol::bus::{BusKind, GATEWAY_RECEIVE_BUFFER_BYTES, KindChoice, KindChoices};
use protocol::document;
use protocol::input::can_be_read_again;
use protocol::skin::{CellName, Skin};
use protocol::time::Span;
use protocol::usage::{Failure, command_line, eprint_lines, shell_quoted_os};
use trace::recording::series::{AttachedFile, SplitLimits};

use super::arguments::{
    BusKinds, BusTimeOption, ProcessOptions, bus_names, cells_per_process, environment_number, find_cell,
    parse_address, parse_duration, parse_time,
};
use super::buses;
use super::output::{self, OverwriteOption, check_distinct_files, print_note, print_table};
use super::print::to_pretty_json;
use super::robot_file::{SkinRobot, urdf_path};
use super::view::{PageOptions, PageProcess};
use show::TableStyle;

/// Skin and scenario of the demonstration.
const DEMO_SKIN_TOML: &str = include_str!("../examples/ur5-253.toml");
const DEMO_SCENARIO_TOML: &str = include_str!("../examples/demo.toml");

/// Maximum duration in s of a run with `--view` or `--control`.
const MAX_VIEW_DURATION_S: f64 = 24.0 * 3600.0;

/// Log of the demonstration's frames.
const DEMO_LOG: &str = "skinbus-demo.log";

/// Options that `skinbus run` and `skinbus demo` share.
#[derive(Args, Debug)]
struct CommonOptions {
    /// End after this time: 10, 10s or 2min [default: the scenario's duration, or 10s]
    #[arg(long, value_name = "TIME", value_parser = parse_duration, allow_negative_numbers = true)]
    duration: Option<f64>,
    /// Write the results as JSON, even if the run fails; docs/reference/summary.md explains the keys
    #[arg(long, value_name = "FILE")]
    summary: Option<PathBuf>,
    /// Show only the table at the end, without progress
    #[arg(long, short)]
    quiet: bool,
    /// Print all rows of the table, including those whose values are as expected
    #[arg(long, short)]
    verbose: bool,
    /// Show the skin live in a browser, on a page that is served until the run ends; see docs/how-to/view.md. Without
    /// --duration, the run then ends only with Ctrl-C
    #[arg(long)]
    view: bool,
    /// Address at which the page is served [default: 127.0.0.1, a free port]
    #[arg(long, value_name = "ADDRESS:PORT", value_parser = parse_address, requires = "view")]
    listen: Option<SocketAddr>,
    #[command(flatten)]
    recording: RecordingArguments,
}

/// Texts of the skin and the scenario as they were read, and the robot of the skin.
struct RunTexts {
    skin: String,
    scenario: Option<String>,
    robot: SkinRobot,
}

/// Options for a recording, besides candump text.
#[derive(Args, Debug)]
struct RecordingArguments {
    /// Record the run as MCAP: frames, joints, torques, touches, timing; docs/reference/recording.md lists the topics
    #[arg(long, value_name = "FILE.mcap")]
    record: Option<PathBuf>,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

/// Limit of size or age at which a new file of a recording is started.
#[derive(Clone, Copy, Debug)]
enum SplitLimit {
    Bytes(u64),
    Age(Duration),
}

fn limit(text: &str) -> Result<SplitLimit, String> {
    let allowed =
        "use a size of at least 1MB, such as 500MB or 2GiB, or a time of at least 1s, such as 90s or 10min";
    let unit = text.trim_start_matches(|letter: char| letter.is_ascii_digit());
    let number: Option<u64> = text.strip_suffix(unit).and_then(|number| number.parse().ok());
    let bytes = [("MB", 1_000_000), ("MiB", 1 << 20), ("GB", 1_000_000_000), ("GiB", 1 << 30)];
    let each = bytes.iter().find(|(name, _)| *name == unit).map(|(_, each)| each);
    if let Some(bytes) = each.and_then(|each| number?.checked_mul(*each)).filter(|bytes| *bytes > 0) {
        return Ok(SplitLimit::Bytes(bytes));
    }
    // Refuse a number without a unit, because it may mean either.
    let age = parse_time(text).filter(|seconds| *seconds >= 1.0 && !unit.is_empty());
    let age = age.and_then(|seconds| Duration::try_from_secs_f64(seconds).ok());
    age.map(SplitLimit::Age).ok_or_else(|| allowed.to_owned())
}

impl RecordingArguments {
    /// Returns the outputs of the recording, with the files attached.
    fn options(
        &self,
        candump: Option<CandumpOutput>,
        files: RunTexts,
        limits: &[SplitLimit],
    ) -> record::RecordOptions {
        let mut split = SplitLimits::default();
        for &limit in limits {
            match limit {
                SplitLimit::Bytes(bytes) => split.bytes = bytes,
                SplitLimit::Age(age) => split.age = age,
            }
        }
        let mcap = self.record.clone().map(|path| {
            let file = |name: &str, media_type, text: String| AttachedFile {
                name: name.to_owned(),
                media_type,
                bytes: text.into_bytes(),
            };
            let mut attachments = vec![file("skin.toml", "application/toml", files.skin)];
            attachments.extend(files.scenario.map(|text| file("scenario.toml", "application/toml", text)));
            attachments.extend(files.robot.urdf.map(|text| file("robot.urdf", "application/xml", text)));
            let command_line = command_line();
            record::McapOutput { path, split, attachments, robot: files.robot.robot, command_line }
        });
        record::RecordOptions { candump, mcap, force: self.overwrite.overwrite }
    }
}

fn demo_bus_kinds_help() -> String {
    format!("Bus kind: {} (socketcan if vcan0 exists, else embedded) [default: embedded]", BusKind::choices())
}

/// Run a demonstration: 253 cells on a robot arm, some of them touched
///
/// Needs no setup: the cells are processes on an embedded bus of the demonstration's own, unless SKINBUS_DIR names a
/// directory, so any number of demonstrations and runs can go on side by side. Prints the command that shows the frames
/// on its bus, and the path of its candump log. Exit codes are those of `skinbus run`.
#[derive(Args, Debug)]
#[command(
    after_help = "Example:\n  skinbus demo --duration 5",
    mut_arg("bus_kind", |arg| arg.help(demo_bus_kinds_help()))
)]
pub(crate) struct DemoCommand {
    #[command(flatten)]
    common: CommonOptions,
    /// Candump log of the frames [default: skinbus-demo.log; if it exists, skinbus-demo-1.log, ...]
    #[arg(long, value_name = "FILE")]
    candump: Option<PathBuf>,
    #[command(flatten)]
    kinds: BusKinds,
    #[command(flatten)]
    time: BusTimeOption,
}

/// Run a bench: cells, buses, the control loop
///
/// Starts the skin's cells as processes, unless they run already (--no-spawn), runs the control loop for the scenario's
/// duration, and prints a table of results. Ctrl-C ends the run early, with the table. The sockets of embedded buses
/// are in SKINBUS_DIR, if that is set: give benches that run side by side a directory each. Exit code 0: the run came
/// to its end; 1: it ended early, a bus was lost at its end, or its recording is incomplete; 2: wrong use or
/// configuration; 3: the robot was halted at the end; 4: the external controller was absent at the end, and the robot
/// was not halted; 5: a process of cells failed.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus run gateway/examples/ur5-253.toml --scenario gateway/examples/demo.toml
  skinbus run skin.toml --duration 60 --no-spawn --candump run.log --summary run.json")]
pub(crate) struct RunCommand {
    /// Skin file (TOML) that describes the robot, buses and cells
    skin: PathBuf,
    /// Scenario file (TOML): touches, motion and faults [default: nothing touches the skin]
    #[arg(long, value_name = "FILE")]
    scenario: Option<PathBuf>,
    #[command(flatten)]
    common: CommonOptions,
    /// Split the recording: start a new file (FILE-1.mcap, ...) at this size or age, such as 500MB, 2GiB, 90s or 10min;
    /// give it twice for both
    #[arg(long, value_name = "SIZE|TIME", requires = "record", value_parser = limit)]
    record_split: Vec<SplitLimit>,
    #[command(flatten)]
    processes: ProcessOptions,
    #[command(flatten)]
    page: PageOptions,
    /// Write all frames to a candump log, which `tail -f` can follow during the run
    #[arg(long, value_name = "FILE")]
    candump: Option<PathBuf>,
    #[command(flatten)]
    kinds: BusKinds,
    #[command(flatten)]
    time: BusTimeOption,
    /// Let a program control the run: read commands from standard input, and write events to standard output;
    /// docs/reference/control.md describes them. The run ends when the input ends, or after --duration [default: a day]
    #[arg(long)]
    control: bool,
    /// Do not start cells, because real or simulated cells are already on the buses
    #[arg(long)]
    no_spawn: bool,
    /// Keep the parameters of started cells in this directory for later runs
    #[arg(long, value_name = "DIR")]
    flash: Option<PathBuf>,
    /// Cell firmware (for the micro:bit) that --emulate runs; docs/how-to/firmware.md explains how to build it
    #[arg(long, value_name = "ELF", requires = "emulate")]
    firmware: Option<PathBuf>,
    /// Run these cells (NODE or BUS:NODE) as firmware in QEMU instead of as processes. They are commissioned at the
    /// start, keep their flash in --flash if given, and end with the run
    #[arg(
        long,
        value_name = "[BUS:]N,...",
        requires = "firmware",
        conflicts_with = "no_spawn",
        value_delimiter = ','
    )]
    emulate: Vec<CellName>,
}

impl DemoCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let (_file, skin_file) = create_memory_file(DEMO_SKIN_TOML.as_bytes()).map_err(Failure::run_error)?;
        let skin = Skin::parse("the demonstration's skin", DEMO_SKIN_TOML).map_err(Failure::usage_error)?;
        let scenario = Scenario::parse("the demonstration's scenario", DEMO_SCENARIO_TOML, &skin)
            .map_err(Failure::usage_error)?;
        let mut options = self.common.options(skin_file, skin, scenario, false);
        options.cells_per_process = cells_per_process()?;
        options.bus_time = self.time.choice();
        options.kinds = self
            .kinds
            .kinds_or_default(KindChoice::Only(BusKind::Embedded))?
            .restrict_to(bus_names(&options.skin))
            .map_err(Failure::usage_error)?;
        let kind = options.kinds.kind_of("vcan0").resolve("vcan0");
        let given = std::env::var_os("SKINBUS_DIR").filter(|given| !given.is_empty()).map(PathBuf::from);
        let own = given.is_none() && !kind.is_interface();
        let buses = own.then(|| buses::private_directory("demo")).transpose()?;
        options.directory = buses.as_ref().map(|buses| buses.path().to_owned()).or(given);
        let place = options.directory.as_ref();
        let place = place.map(|path| format!("SKINBUS_DIR={} ", shell_quoted_os(path.as_os_str())));
        let place = place.filter(|_| !kind.is_interface()).unwrap_or_default();
        options.announced.push(format!(
            "to see the decoded frames, run in another shell: {place}skinbus dump vcan0 --bus-kind {kind}"
        ));
        let CommonOptions { recording, summary, verbose, view, listen, .. } = self.common;
        let numbered = self.candump.is_none();
        let path = self.candump.unwrap_or_else(|| DEMO_LOG.into());
        let candump = Some(CandumpOutput { path, numbered });
        let robot = match recording.record {
            Some(_) => SkinRobot::read(&options.skin, None)?,
            None => SkinRobot::default(),
        };
        let files = RunTexts {
            skin: DEMO_SKIN_TOML.to_owned(),
            scenario: Some(DEMO_SCENARIO_TOML.to_owned()),
            robot,
        };
        options.record = recording.options(candump, files, &[]);
        announce_bus_time(&mut options);
        let page = view.then(|| PageProcess::start(&options, listen, &PageOptions::default())).transpose()?;
        let remotes = RunRemotes { page, is_controlled: false };
        run_bench(&options, (summary.as_deref(), recording.overwrite), verbose, &[], remotes)
    }
}

impl RunCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let name = |path: &Path| path.display().to_string();
        let skin_text = document::read_text(&self.skin).map_err(Failure::usage_error)?;
        let skin = Skin::parse(&name(&self.skin), &skin_text).map_err(Failure::usage_error)?;
        let scenario_text =
            self.scenario.as_deref().map(document::read_text).transpose().map_err(Failure::usage_error)?;
        let scenario = match (&self.scenario, &scenario_text) {
            (Some(path), Some(text)) => {
                Scenario::parse(&name(path), text, &skin).map_err(Failure::usage_error)?
            }
            _ => Scenario::idle(DEFAULT_DURATION),
        };
        let urdf = self.common.recording.record.as_ref().and(skin.robot.urdf.as_deref());
        let urdf = urdf.map(|urdf| urdf_path(&self.skin, urdf));
        let robot = match self.common.recording.record {
            Some(_) => SkinRobot::read(&skin, urdf.as_deref())?,
            None => SkinRobot::default(),
        };
        let read = [Some(self.skin.clone()), self.scenario.clone(), urdf];
        let read: Vec<_> = read.into_iter().flatten().collect();
        // If the skin can be read only once, cells read a copy of it in memory.
        let (_file, skin_file) = if can_be_read_again(&self.skin) {
            (None, self.skin)
        } else {
            let (file, path) = create_memory_file(skin_text.as_bytes()).map_err(Failure::run_error)?;
            (Some(file), path)
        };
        for remark in scenario.warnings(&skin) {
            print_note(format_args!("remark: {remark}"));
        }
        let mut options = self.common.options(skin_file, skin, scenario, self.control);
        let CommonOptions { recording, summary, verbose, view, listen, .. } = self.common;
        options.kinds = self.kinds.kinds_of_buses(bus_names(&options.skin))?;
        let candump = self.candump.map(|path| CandumpOutput { path, numbered: false });
        let files = RunTexts { skin: skin_text, scenario: scenario_text, robot };
        options.record = recording.options(candump, files, &self.record_split);
        options.spawn = !self.no_spawn;
        options.bus_time = self.time.choice();
        options.flash = self.flash;
        options.emulated = emulated(self.firmware, &self.emulate, &options.skin)?;
        // The kernel grants twice the size, or less without the privilege.
        let bytes = environment_number("SKINBUS_RECEIVE_BUFFER", 0..=1 << 30)?;
        options.receive_buffer = bytes.unwrap_or(GATEWAY_RECEIVE_BUFFER_BYTES) as usize;
        options.cells_per_process = self.processes.cells_per_process.into();
        announce_bus_time(&mut options);
        let page = view.then(|| PageProcess::start(&options, listen, &self.page)).transpose()?;
        let remotes = RunRemotes { page, is_controlled: self.control };
        run_bench(&options, (summary.as_deref(), recording.overwrite), verbose, &read, remotes)
    }
}

/// Announces the bit rates of timed buses, and the worst case that is to be compared with the measured load.
fn announce_bus_time(options: &mut RunOptions) {
    let RunOptions { skin, bus_time, announced, .. } = options;
    for (index, bus) in skin.buses.iter().enumerate() {
        let Some(time) = bus_time.served_time(bus) else { continue };
        let worst = assess_worst_case(skin, index, time.rates);
        let worst = worst.map_or_else(String::new, |rated| format!("; {}", FitSummary::worst_case(&rated)));
        announced.push(format!("{}: frames take time: {time}{worst}", bus.name));
    }
}

/// Adds the upper bounds for the last replies on timed buses, at the bit rates of their servers.
fn add_reply_bounds(summary: &mut Summary, skin: &Skin) {
    for bus in &mut summary.buses {
        let rates = bus.timed.as_ref().and_then(|timed| timed.rates.parse().ok());
        let known = rates.zip(skin.bus_index(&bus.name));
        bus.last_reply_bound_us = known.and_then(|(rates, index)| last_reply_bound_us(skin, index, rates));
    }
}

/// Returns the cells to emulate and their firmware, if any.
fn emulated(
    firmware: Option<PathBuf>,
    named: &[CellName],
    skin: &Skin,
) -> Result<Option<EmulatedCells>, Failure> {
    let Some(firmware) = firmware else { return Ok(None) };
    let mut cells = Vec::new();
    for named in named {
        let cell = find_cell(skin, named, "--emulate")?;
        if cells.contains(&cell) {
            return Err(Failure::usage_error(format!(
                "--emulate {named} is given twice: name each cell once"
            )));
        }
        cells.push(cell);
    }
    Ok(Some(EmulatedCells { firmware, cells }))
}

impl CommonOptions {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 1e13: checked")]
    fn options(
        &self,
        skin_file: PathBuf,
        skin: Skin,
        mut scenario: Scenario,
        is_controlled: bool,
    ) -> RunOptions {
        let until_stopped = (self.view || is_controlled).then_some(MAX_VIEW_DURATION_S);
        if let Some(seconds) = self.duration.or(until_stopped) {
            scenario.duration = Span((seconds * 1e6) as u64);
        }
        RunOptions {
            skin_file,
            skin,
            scenario,
            kinds: KindChoices::default(),
            directory: None,
            bus_time: BusTimeChoice::Described,
            spawn: true,
            emulated: None,
            cells_per_process: 1,
            flash: None,
            receive_buffer: GATEWAY_RECEIVE_BUFFER_BYTES as usize,
            record: record::RecordOptions::default(),
            quiet: self.quiet,
            planned: None,
            announced: Vec::new(),
        }
    }
}

/// Programs that control a run.
struct RunRemotes {
    /// The page, if it is served.
    page: Option<(PageProcess, Remote)>,
    /// True to read commands from standard input.
    is_controlled: bool,
}

fn run_bench(
    options: &RunOptions,
    (summary_file, overwrite): (Option<&Path>, OverwriteOption),
    is_verbose: bool,
    read: &[PathBuf],
    remotes: RunRemotes,
) -> Result<(), Failure> {
    let written = [
        ("--candump", options.record.candump.as_ref().map(|candump| candump.path.as_path())),
        ("--record", options.record.mcap.as_ref().map(|mcap| mcap.path.as_path())),
        ("--summary", summary_file),
    ];
    check_distinct_files(written, read.iter().map(PathBuf::as_path))?;
    let RunRemotes { page, is_controlled } = remotes;
    if is_controlled {
        controlled::check_standard_output(&written)?;
    }
    // Create the file before the run, so that an error of the file is reported first.
    let summary = summary_file.map(|path| overwrite.create("--summary", path)).transpose()?;
    let channel = is_controlled.then(|| controlled::start_channel(options)).transpose()?;
    let (page, page_remote) = page.unzip();
    let (channel, channel_remote) = channel.unzip();
    let remotes = page_remote.into_iter().chain(channel_remote).collect();
    // The summary reports a panic too.
    let ended = panic::catch_unwind(AssertUnwindSafe(|| run::run(options, remotes)));
    drop(page);
    let (mut ended, panicked) = match ended {
        Ok(Ok(ended)) => (ended, None),
        Ok(Err(error)) => {
            let failure = Failure::with_code(error.exit_code(), error);
            return controlled::end_channel(channel, None, Err(failure));
        }
        Err(panic) => {
            (Summary::for_failed_start(&options.skin, "the gateway crashed".to_owned()), Some(panic))
        }
    };
    add_reply_bounds(&mut ended, &options.skin);
    let unwritten = summary.and_then(|(whole, file)| {
        to_pretty_json(&ended)
            .and_then(|text| output::write_and_finish("--summary", whole, file, &text))
            .err()
    });
    if let Some(panic) = panicked {
        let failure = Failure::run_error("the gateway crashed");
        let _ = controlled::end_channel(channel, Some(&ended), Err(failure));
        panic::resume_unwind(panic);
    }
    let table =
        |is_coloured| show::format_summary(&ended, TableStyle { is_verbose, is_coloured, columns: None });
    let printed = if ended.control.ticks == 0 {
        Ok(())
    } else if is_controlled {
        // Standard output has events only.
        if is_verbose {
            eprint_lines(&table(false));
        }
        Ok(())
    } else {
        print_table(written.map(|(_, path)| path), table)
    };
    // The failure prints the last line itself; each other message is one line.
    let mut lines = ended.end_messages(options.quiet);
    let lost: Vec<_> = unwritten.into_iter().chain(printed.err()).collect();
    let code = if lost.is_empty() { ended.outcome.exit_code() } else { 1 };
    lines.extend(lost.iter().map(ToString::to_string));
    let last = lines.pop();
    for line in lines {
        print_note(format_args!("skinbus: {line}"));
    }
    controlled::end_channel(
        channel,
        Some(&ended),
        last.map_or(Ok(()), |last| Err(Failure::with_code(code, last))),
    )
}
