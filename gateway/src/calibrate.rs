//! `skinbus calibrate`.

mod picture;
mod recorded;

use std::path::PathBuf;
use std::thread;

use bench::bus::time::BusTimeChoice;
use bench::record::{self, McapOutput};
use bench::run::{self, RunOptions};
use bench::summary::Outcome;
use calibration::motion::MotionPlan;
use calibration::neighbors::Spacing;
use calibration::observe::Observations;
use calibration::plan::{PlanBounds, plan_motion};
use calibration::write::calibrated_text;
use calibration::{Calibration, Settings, calibrate};
use clap::Args;
use model::accelerometer::kinematics::UPRIGHT_GRAVITY;
use model::accelerometer::sensor::{DataSheet, DataSheetInput};
use model::decode::{Decoded, Decoder};
use model::scenario::Scenario;
use protocol::bus::GATEWAY_RECEIVE_BUFFER_BYTES;
use protocol::document::{self, KeyPath};
use protocol::fixed::{Q1_14, Q3_12, Q5_10, Q9_6};
use protocol::id::CellId;
use protocol::parameters::{Events, Sensing};
use protocol::skin::{ControllerKind, Skin};
use protocol::time::{Micros, Span};
use protocol::usage::{Failure, print_text};
use trace::capture::{CaptureEntry, Reader};
use trace::recording::series::{AttachedFile, SplitLimits};

use super::arguments::{BusKinds, bus_names, parse_duration};
use super::input::no_frame_failure;
use super::output::{OverwriteOption, check_distinct_files, print_beside_files, print_note};
use super::print::{count_with_noun, to_pretty_json};
use super::robot_file::{SkinRobot, urdf_path};

/// Estimate the poses of cells from their accelerometers while the robot moves
///
/// Moves the robot through poses and swings within its limits and records the cells' accelerations. Estimates for each
/// cell the joint that moves it, its position and orientation, and the bias and gain of its sensor, each with its
/// uncertainty. Simulated cells get accelerometers with the errors of a data sheet. With --recording, uses a recording
/// instead, also of a robot that another program moved. Exit code 0: all cells are reliable; 1: some are not, or the
/// command failed; 2: wrong use or configuration.
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  skinbus calibrate skin.toml -o found.toml && skinbus commission found.toml
  skinbus calibrate skin.toml --recording run.mcap --page found.html
  skinbus calibrate skin.toml --dry-run > motion.json")]
pub(crate) struct CalibrateCommand {
    /// The skin file (TOML); the positions and normals of its cells may be wrong
    skin: PathBuf,
    /// Write a copy of the skin file with the estimated poses of the cells
    #[arg(long, short, value_name = "FILE")]
    output: Option<PathBuf>,
    /// Use this recording or candump log instead of moving the robot; for a split recording, give the option for each
    /// part
    #[arg(long, value_name = "FILE", num_args = 1.., conflicts_with_all = ["record", "no_spawn", "dry_run"])]
    recording: Vec<PathBuf>,
    /// Record the calibration run in this file
    #[arg(long, value_name = "FILE.mcap")]
    record: Option<PathBuf>,
    /// Write the result as an HTML page with a 3D view: a line joins the old and the new position of each cell
    #[arg(long, value_name = "FILE.html")]
    page: Option<PathBuf>,
    /// Start pose of the robot: a position in rad or m for each joint, separated by spaces. Default: the middle of the
    /// limits
    #[arg(long, value_name = "POSITIONS", allow_hyphen_values = true)]
    start: Option<String>,
    /// Maximum distance of each joint from the start pose, in rad or m; choose it so that the robot hits nothing
    #[arg(long, value_name = "RAD", default_value_t = 1.0)]
    within: f64,
    /// Maximum duration of the motion
    #[arg(long, value_name = "TIME", default_value = "150s", value_parser = parse_duration)]
    duration: f64,
    /// Distance in mm between cells that a wire connects; knowing it makes the estimated positions more accurate
    #[arg(long, value_name = "MM")]
    spacing: Option<f64>,
    /// Also estimate the zero offset of each joint's encoder
    #[arg(long)]
    zero_offsets: bool,
    /// Data sheet of the accelerometers as TOML, with the keys of a scenario's [sensors.acceleration]. Default: a
    /// BMA250
    #[arg(long, value_name = "FILE")]
    data_sheet: Option<PathBuf>,
    /// Print the planned motion as JSON, and do not move the robot
    #[arg(long)]
    dry_run: bool,
    /// Do not start cells: use the real or simulated cells that are already on the buses
    #[arg(long)]
    no_spawn: bool,
    #[command(flatten)]
    kinds: BusKinds,
    /// Do not show progress
    #[arg(long, short)]
    quiet: bool,
    /// Print one JSON object instead of text
    #[arg(long, short)]
    json: bool,
    #[command(flatten)]
    overwrite: OverwriteOption,
}

impl CalibrateCommand {
    pub(crate) fn run(self) -> Result<(), Failure> {
        let text = document::read_text(&self.skin).map_err(Failure::usage_error)?;
        let skin = Skin::parse(&self.skin.display().to_string(), &text).map_err(Failure::usage_error)?;
        let settings = self.settings(&skin)?;
        let written = [
            ("-o", self.output.as_deref()),
            ("--record", self.record.as_deref()),
            ("--page", self.page.as_deref()),
        ];
        check_distinct_files(
            written,
            [self.skin.as_path()].into_iter().chain(self.recording.iter().map(PathBuf::as_path)),
        )?;
        for (option, path) in written {
            path.map_or(Ok(()), |path| self.overwrite.check_writable(option, path))?;
        }
        let calibration = if self.recording.is_empty() {
            let motion = plan_motion(&skin, &settings.bounds, &settings.sheet, settings.gravity);
            let motion = motion.map_err(Failure::usage_error)?;
            if self.dry_run {
                return print_text(&to_pretty_json(&motion)?);
            }
            self.record_and_calibrate(&skin, &text, &settings, motion)?
        } else {
            calibrate_capture(&self.recording, &skin, &settings)?
        };
        if let Some(path) = &self.output {
            let new = calibrated_text(&skin, &text, &calibration).map_err(Failure::usage_error)?;
            self.overwrite.write("-o", path, &new)?;
        }
        let shown = if self.json { to_pretty_json(&calibration)? } else { report_text(&skin, &calibration) };
        print_beside_files([self.output.as_deref(), self.page.as_deref()], &shown)?;
        if let Some(path) = &self.page {
            let page = picture::calibration_page(&self.skin, &skin, &calibration);
            self.overwrite.write("--page", path, &page)?;
        }
        match calibration.summary.troubled {
            0 => Ok(()),
            troubled => Err(Failure::run_error(format!(
                "{}: {} of {} are unreliable; see the reasons above",
                skin.name,
                troubled,
                count_with_noun(skin.cells.len(), "cell")
            ))),
        }
    }

    fn settings(&self, skin: &Skin) -> Result<Settings, Failure> {
        let mut bounds =
            PlanBounds { within: self.within, length_s: self.duration, ..PlanBounds::from_skin(skin) };
        if !(0.05..=6.3).contains(&self.within) {
            return Err(Failure::usage_error(format!("--within {}: use 0.05 to 6.3 rad or m", self.within)));
        }
        if let Some(start) = &self.start {
            let number = |word: &str| {
                let number = word.parse::<f64>().ok().filter(|number| number.is_finite());
                number.ok_or_else(|| {
                    Failure::usage_error(format!(
                        "--start {word}: each position must be a number, in rad or m"
                    ))
                })
            };
            bounds.center = start.split_whitespace().map(number).collect::<Result<_, _>>()?;
        }
        let sheet = match &self.data_sheet {
            Some(path) => {
                let text = document::read_text(path).map_err(Failure::usage_error)?;
                let sheet = |given: DataSheetInput| given.data_sheet(&KeyPath::root());
                document::parse(&path.display().to_string(), &text, sheet).map_err(Failure::usage_error)?
            }
            None => DataSheet::default(),
        };
        let spacing = self.spacing.map(|mm| {
            let fits = (1.0..=1_000.0).contains(&mm);
            let wrong = || Failure::usage_error(format!("--spacing {mm}: use 1 to 1000 mm"));
            fits.then(|| Spacing::with_distance(mm * 1e-3)).ok_or_else(wrong)
        });
        let threads = thread::available_parallelism().map_or(1, usize::from);
        let (spacing, zero_offsets) = (spacing.transpose()?, self.zero_offsets);
        Ok(Settings { sheet, gravity: UPRIGHT_GRAVITY, spacing, zero_offsets, threads, bounds })
    }

    /// Moves the robot, and evaluates the recording.
    fn record_and_calibrate(
        &self,
        skin: &Skin,
        text: &str,
        settings: &Settings,
        motion: MotionPlan,
    ) -> Result<Calibration, Failure> {
        if matches!(skin.controller.kind, ControllerKind::External { .. }) {
            return Err(Failure::usage_error(
                "[controller] kind = \"external\": another program moves this robot; record a run with \
                 `skinbus run --record`, and give the recording with --recording",
            ));
        }
        let folder = tempfile::tempdir().map_err(Failure::run_error)?;
        let path = self.record.clone().unwrap_or_else(|| folder.path().join("calibration.mcap"));
        let mut options = self.options(skin, text, settings, motion, path.clone())?;
        let seconds = options.scenario.duration.0 / 1_000_000;
        let within = self.within;
        options.announced.push(format!(
            "the robot will move for {seconds} s around its start pose, each joint by at most {within} rad or m"
        ));
        let summary =
            run::run(&options, Vec::new()).map_err(|error| Failure::with_code(error.exit_code(), error))?;
        let mut complaints = summary.end_messages(self.quiet);
        if summary.outcome != Outcome::Done {
            let last = complaints.pop().unwrap_or_else(|| "the run ended too early".to_owned());
            return Err(Failure::run_error(last));
        }
        complaints.iter().for_each(|line| print_note(format_args!("skinbus: {line}")));
        if summary.control.ticks_skipped > 0 {
            let (ticks, broadcasts) = (summary.control.ticks_skipped, summary.control.broadcasts_skipped);
            print_note(format_args!(
                "the control loop skipped {ticks} ticks, and with them {broadcasts} joint broadcasts"
            ));
        }
        calibrate_capture(&[path], skin, settings)
    }

    /// Returns the options of a run in which each cell sends all its accelerations.
    fn options(
        &self,
        skin: &Skin,
        text: &str,
        settings: &Settings,
        motion: MotionPlan,
        path: PathBuf,
    ) -> Result<RunOptions, Failure> {
        let urdf = skin.robot.urdf.as_deref().map(|urdf| urdf_path(&self.skin, urdf));
        let robot = SkinRobot::read(skin, urdf.as_deref())?;
        let attached = |name: &str, media_type, text: String| AttachedFile {
            name: name.to_owned(),
            media_type,
            bytes: text.into_bytes(),
        };
        let mut attachments = vec![attached("skin.toml", "application/toml", text.to_owned())];
        attachments.extend(robot.urdf.map(|text| attached("robot.urdf", "application/xml", text)));
        let command_line = protocol::usage::command_line();
        let mcap =
            McapOutput { path, split: SplitLimits::default(), attachments, robot: robot.robot, command_line };
        let length_us = (motion.length_s() * 1e6).round();
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "20 to 3600 s: checked")]
        let mut scenario = Scenario::idle(Span(length_us as u64));
        scenario.motion.start = motion.state_at(0.0).position;
        scenario.sensors.acceleration = (!self.no_spawn).then_some(settings.sheet);
        let mut sensing = skin.clone();
        sensing.buses.iter_mut().for_each(|bus| bus.sensing = Sensing::Event);
        // Every acceleration is an event, and no other value is.
        sensing.events = Events {
            contact: Q5_10::MAX,
            proximity: Q1_14::MAX,
            temperature: Q9_6::MAX,
            acceleration: Q3_12::ZERO,
            ..Events::default()
        };
        Ok(RunOptions {
            skin_file: self.skin.clone(),
            skin: sensing,
            scenario,
            kinds: self.kinds.kinds_of_buses(bus_names(skin))?,
            directory: None,
            // Cells are to be calibrated, not the bus.
            bus_time: BusTimeChoice::None,
            spawn: !self.no_spawn,
            emulated: None,
            // One process per bus: cells that share a machine do not affect the result.
            cells_per_process: usize::from(CellId::MAX.get()),
            flash: None,
            receive_buffer: GATEWAY_RECEIVE_BUFFER_BYTES as usize,
            record: record::RecordOptions {
                candump: None,
                mcap: Some(mcap),
                force: self.overwrite.overwrite,
            },
            quiet: self.quiet,
            planned: Some(motion),
            announced: Vec::new(),
        })
    }
}

/// Reads the accelerations of a skin's cells from a capture, and calibrates the skin.
fn calibrate_capture(files: &[PathBuf], skin: &Skin, settings: &Settings) -> Result<Calibration, Failure> {
    let mut reader = Reader::open_all(files).map_err(Failure::usage_error)?;
    let name = reader.name().to_owned();
    if let Some(Ok(own)) = reader.extras().skin() {
        recorded::check_same_skin(&name, skin, &own)?;
    }
    let mut seen = Observations::new(skin);
    let mut decoder = Decoder::new(None);
    let mut has_frames = false;
    while let Some(entry) = reader.next().map_err(Failure::run_error)? {
        let CaptureEntry::Frame(record) = entry else { continue };
        has_frames = true;
        let at = Micros(record.time.nanos / 1_000);
        if let (Decoded::Message(message), Some(bus)) =
            (decoder.decode(at, record.interface, &record.frame), skin.bus_index(record.interface))
        {
            seen.record(bus, at, &message);
        }
    }
    if !has_frames {
        return Err(no_frame_failure(&reader));
    }
    if seen.cells.iter().all(Vec::is_empty) {
        return Err(Failure::usage_error(format!(
            "{name}: no cell of the skin sent an acceleration; record a bus with sensing = \"event\" and [events] \
             acceleration_g = 0"
        )));
    }
    calibrate(skin, &seen, settings).map_err(|refusal| Failure::run_error(format_args!("{name}: {refusal}")))
}

/// Returns the result as text.
fn report_text(skin: &Skin, calibration: &Calibration) -> String {
    let summary = &calibration.summary;
    let mut lines = vec![format!(
        "{}: {}, {} poses found, {} cells unreliable",
        skin.name,
        count_with_noun(summary.cells, "cell"),
        summary.determined,
        summary.troubled
    )];
    if let (Some(mm), Some(degrees), Some(mg)) =
        (summary.position_mm, summary.orientation_deg, summary.noise_mg)
    {
        lines.push(format!(
            "pose uncertainty {mm:.2} mm and {degrees:.2} degrees (median of the 95 % limits); standard \
             deviation of the readings: {mg:.1} mg"
        ));
    }
    lines.push(summary.joints.to_string());
    let changes =
        calibration.cells.iter().filter(|cell| cell.is_pose_written()).filter_map(|cell| cell.found);
    let mut moved: Vec<_> = changes.filter_map(|found| Some((found.moved_mm?, found.turned_deg?))).collect();
    moved.sort_by(|one, other| one.0.total_cmp(&other.0));
    if let (Some(middle), Some(most)) = (moved.get(moved.len() / 2), moved.last()) {
        let (middle, most) = (middle.0, most.0);
        lines.push(format!(
            "distance from the poses in the skin: median {middle:.2} mm, at most {most:.2} mm"
        ));
    }
    if summary.wires > 0 {
        lines.push(format!("{} improved the positions", count_with_noun(summary.wires, "wire")));
    }
    lines.extend(calibration.zero_offsets.iter().flatten().map(ToString::to_string));
    for cell in &calibration.cells {
        let name = format!("{}:{}", cell.bus, cell.node);
        lines.extend(cell.troubles.iter().map(|trouble| format!("cell {name}: {trouble}")));
    }
    lines.join("\n") + "\n"
}
